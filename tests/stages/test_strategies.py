"""Strategies are recovered where they are known, and not invented where there is one."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import represent_jax as rj
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError, UsageError
from represent_jax.stages import strategies
from represent_jax.stages.strategies import StrategiesConfig

ROOT = Path(__file__).parents[2]
KEY = jax.random.PRNGKey(0)
CONFIG = StrategiesConfig(num_features=256, num_resamples=20)


def _swing(frequency, seed, strategy=0, num_steps=500):
    """A noisy oscillator; people differ in how fast they swing."""
    rng = np.random.default_rng(seed)
    time = np.arange(num_steps + 1) * 0.1 * frequency + rng.uniform(0, 2 * np.pi)
    obs = np.stack([np.sin(time), np.cos(time)], axis=1) + 0.02 * rng.normal(size=(time.size, 2))
    zeros = np.zeros((num_steps, 1))
    return Trajectory(obs, zeros, zeros[:, 0], False, strategy)


def _pool(num_strategies, each=4):
    frequencies = 3.0 + 1.4 * np.arange(num_strategies)
    return [_swing(f, 10 * i + j, i) for j in range(each) for i, f in enumerate(frequencies)]


@pytest.mark.parametrize("num_strategies", [1, 2, 3, 5, 8])
def test_oscillators_of_as_many_frequencies(num_strategies):
    pool = _pool(num_strategies)
    found = strategies.infer(KEY, pool, CONFIG)
    assert found.num_strategies == num_strategies
    # Numbered by first appearance, which is the order of the pool.
    assert found.labels.tolist() == [t.strategy for t in pool]
    np.testing.assert_allclose(found.probabilities.sum(axis=1), 1.0)
    assert found.confidence.min() > 0.9 and found.strengths[0] == 1.0


def test_the_number_may_be_given_and_order_does_not_matter():
    pool = _pool(3)
    two = strategies.infer(KEY, pool, dataclasses.replace(CONFIG, num_strategies=2))
    assert two.num_strategies == 2
    order = np.random.default_rng(0).permutation(len(pool))
    found = strategies.infer(KEY, [pool[i] for i in order], CONFIG)
    known = np.array([pool[i].strategy for i in order])
    assert strategies.adjusted_rand(found.labels, known) == 1.0


@pytest.mark.parametrize(
    ("name", "first", "number"), [("half_cheetah", 2, 2), ("half_cheetah", 3, 3), ("hopper", 2, 2)]
)
def test_shipped_demonstrations_with_labels_hidden(name, first, number):
    shipped = rj.load_demonstrations(name)
    pool = [t for t in shipped.trajectories if t.strategy < first]
    found = strategies.infer(KEY, pool, CONFIG)
    assert found.num_strategies == number
    assert found.labels.tolist() == [t.strategy for t in pool]


def test_the_double_pendulum_is_recovered_up_to_its_two_sides():
    shipped = rj.load_demonstrations("inverted_double_pendulum")
    found = strategies.infer(KEY, shipped.trajectories, StrategiesConfig())
    known = np.array([t.strategy for t in shipped.trajectories])
    assert strategies.purity(found.labels, known) >= 0.95


def test_agreement_of_partitions():
    known = np.array([0, 0, 0, 1, 1, 1])
    assert strategies.purity(np.array([1, 1, 1, 0, 0, 0]), known) == 1.0
    assert strategies.adjusted_rand(np.array([1, 1, 1, 0, 0, 0]), known) == 1.0
    assert strategies.purity(np.array([0, 0, 1, 1, 1, 1]), known) == pytest.approx(5 / 6)
    # Pairs together in both 4, in one 7, in the other 6, of 15: (4 - 2.8) / (6.5 - 2.8).
    shifted = np.array([0, 0, 1, 1, 1, 1])
    assert strategies.adjusted_rand(shifted, known) == pytest.approx(1.2 / 3.7)
    assert strategies.adjusted_rand(np.zeros(6, int), known) == 0.0


def test_what_cannot_be_told_is_an_error():
    short = _swing(3.0, 0, num_steps=1)
    with pytest.raises(RepresentError, match="trajectory 1: expected at least 2 steps, found 1"):
        strategies.infer(KEY, [_swing(3.0, 0), short], CONFIG)
    with pytest.raises(RepresentError, match="at most 1"):
        strategies.infer(KEY, [_swing(3.0, 0)], dataclasses.replace(CONFIG, num_strategies=2))
    with pytest.raises(UsageError, match="bandwidth"):
        StrategiesConfig(bandwidth=0.0)


def test_labelled_demonstrations_keep_all_else():
    pool = Demonstrations("own", [dataclasses.replace(t, strategy=0) for t in _pool(2)], {"a": 1})
    labelled = rj.infer_strategies(pool)
    assert labelled.num_strategies == 2 and labelled.metadata["a"] == 1
    assert len(labelled.metadata["inferred_strategies"]["confidence"]) == 8
    assert all(
        np.array_equal(a.obs, b.obs)
        for a, b in zip(pool.trajectories, labelled.trajectories, strict=True)
    )


def test_launcher_writes_the_file_that_was_labelled_by_hand(tmp_path):
    out = tmp_path / "labelled.npz"
    command = [sys.executable, "-m", "experiments.infer_strategies", "--demonstrations=hopper"]
    shown = subprocess.run(
        [*command, "--compare", f"--out={out}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert shown.returncode == 0, shown.stderr
    assert "purity 1.000, adjusted Rand index 1.000" in shown.stdout
    labelled, known = rj.load_demonstrations(out), rj.load_demonstrations("hopper")
    assert [t.strategy for t in labelled.trajectories] == [t.strategy for t in known.trajectories]
