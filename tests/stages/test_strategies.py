"""Strategies are recovered where they are known, and not invented where there is one."""

import dataclasses
import itertools
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import represent_jax as rj
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError, UsageError
from represent_jax.methods import demonstrators
from represent_jax.stages import policy_mixture, strategies
from represent_jax.stages.motion_clusters import MotionConfig
from represent_jax.stages.policy_mixture import Model
from represent_jax.stages.strategies import StrategiesConfig

ROOT = Path(__file__).parents[2]
KEY = jax.random.PRNGKey(0)
CONFIG = StrategiesConfig()
OF_MOTION = StrategiesConfig(motion=MotionConfig(num_features=256, num_resamples=20))


def _pool(num_strategies, each=4, num_steps=200):
    """A noisy double integrator under linear policies that differ in where they hold it."""
    pool = []
    for j in range(each):
        for strategy in range(num_strategies):
            rng = np.random.default_rng(100 * strategy + j)
            obs, actions = [rng.normal(size=2)], []
            for _ in range(num_steps):
                x, v = obs[-1]
                actions.append(-(x - 1.5 * strategy) - v + 0.3 * rng.normal())
                obs.append(np.array([x + 0.1 * v, v + 0.1 * actions[-1]]))
            pool.append(
                Trajectory(np.array(obs), np.array(actions)[:, None], None, False, strategy)
            )
    return pool


def _swing(frequency, seed, strategy=0, num_steps=500):
    """A noisy oscillator without actions; people differ in how fast they swing."""
    rng = np.random.default_rng(seed)
    time = np.arange(num_steps + 1) * 0.1 * frequency + rng.uniform(0, 2 * np.pi)
    obs = np.stack([np.sin(time), np.cos(time)], axis=1) + 0.02 * rng.normal(size=(time.size, 2))
    return Trajectory(obs, None, None, False, strategy)


def _swings(num_strategies, each=4):
    frequencies = 3.0 + 1.4 * np.arange(num_strategies)
    return [_swing(f, 10 * i + j, i) for j in range(each) for i, f in enumerate(frequencies)]


@pytest.mark.parametrize("num_strategies", [1, 2, 3, 5, 8])
@pytest.mark.parametrize(("make", "config"), [(_pool, CONFIG), (_swings, OF_MOTION)])
def test_as_many_strategies_as_there_are(make, config, num_strategies):
    pool = make(num_strategies)
    found = strategies.infer(KEY, pool, config)
    assert found.num_strategies == num_strategies
    # Numbered by first appearance, which is the order of the pool.
    assert found.labels.tolist() == [t.strategy for t in pool]
    np.testing.assert_allclose(found.probabilities.sum(axis=1), 1.0)
    assert found.confidence.min() > 0.9


@pytest.mark.parametrize(("make", "config"), [(_pool, CONFIG), (_swings, OF_MOTION)])
def test_the_number_may_be_given_and_order_does_not_matter(make, config):
    pool = make(3)
    two = strategies.infer(KEY, pool, dataclasses.replace(config, num_strategies=2))
    assert two.num_strategies == 2 and two.probabilities.shape == (12, 2)
    order = np.random.default_rng(0).permutation(len(pool))
    found = strategies.infer(KEY, [pool[i] for i in order], config)
    known = np.array([pool[i].strategy for i in order])
    assert strategies.adjusted_rand(found.labels, known) == 1.0
    assert list(dict.fromkeys(found.labels.tolist())) == [0, 1, 2]


def test_labels_and_rewards_are_not_looked_at():
    pool = _pool(2)
    hidden = [dataclasses.replace(t, strategy=0, rewards=np.ones(t.length)) for t in pool]
    for one, other in zip(
        strategies.infer(KEY, pool, CONFIG), strategies.infer(KEY, hidden, CONFIG), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_overdispersion_is_one_where_the_model_is_right_and_more_where_halves_differ():
    def pool(bend, num=20, num_steps=200):
        made = []
        for seed in range(num):
            rng = np.random.default_rng(seed)
            obs = rng.normal(size=(num_steps + 1, 3))
            half = np.repeat([-bend, bend], num_steps // 2)
            actions = obs[:-1] @ np.ones((3, 2)) + half[:, None] + rng.normal(size=(num_steps, 2))
            made.append(Trajectory(obs, actions, None, False, 0))
        return made

    right, bent = (strategies.infer(KEY, pool(bend), CONFIG) for bend in (0.0, 0.5))
    assert right.overdispersion == pytest.approx(1.0, abs=0.25)
    assert right.num_strategies == 1
    assert bent.overdispersion > 5.0


def test_a_glimpse_of_a_strategy_is_less_certain():
    pool = _pool(2)
    pool[5] = dataclasses.replace(pool[5], obs=pool[5].obs[:3], actions=pool[5].actions[:2])
    found = strategies.infer(KEY, pool, CONFIG)
    assert np.argmin(found.confidence) == 5 and found.confidence[5] < 1.0 - 1e-6


def test_actions_that_never_vary_are_of_one_strategy():
    pool = [dataclasses.replace(t, actions=np.ones_like(t.actions)) for t in _pool(2)]
    assert strategies.infer(KEY, pool, CONFIG).num_strategies == 1


def test_one_trajectory_of_one_step():
    one = Trajectory(np.zeros((2, 3)), np.ones((1, 2)), None, False, 0)
    found = strategies.infer(KEY, [one], CONFIG)
    assert found.labels.tolist() == [0] and found.confidence.tolist() == [1.0]


def test_evidence_is_that_of_the_multivariate_t():
    # With weights integrated out, a group's actions covary by their rows' products.
    pool = _pool(2, each=1, num_steps=6)
    halves, pooled = policy_mixture.moments_of(pool)
    moments = halves.summed(1)
    model = Model(pooled.step, pooled.noise, float(moments.weight.sum()) + 3.0, 1.0)
    obs = np.concatenate([t.obs[:-1] for t in pool]).astype(float)
    obs = (obs - obs.mean(axis=0)) / obs.std(axis=0)
    covariance = obs.T @ obs / len(obs) + 1e-3 * np.eye(2)
    distance = np.einsum("ni,ij,nj->n", obs, np.linalg.inv(covariance), obs) / 2
    root = np.sqrt(1.0 / np.maximum(1.0, distance))[:, None]
    rows = root * np.concatenate([np.ones((12, 1)), obs], axis=1)
    actions = np.concatenate([t.actions for t in pool]).astype(float)
    actions = root * (actions - actions.mean(axis=0)) / actions.std(axis=0)
    actions -= rows @ np.linalg.solve(rows.T @ rows + pooled.step, rows.T @ actions)

    def expected(labels):
        same = np.kron(labels[:, None] == labels[None, :], np.ones((6, 6)))
        scale = np.eye(12) + same * (rows @ np.linalg.inv(pooled.step) @ rows.T)
        inner = pooled.noise[0, 0] + (actions.T @ np.linalg.solve(scale, actions))[0, 0]
        density = -0.5 * np.linalg.slogdet(scale)[1] - 0.5 * model.degrees * np.log(inner)
        return density + model.log_prior(np.bincount(labels))

    one, two = np.array([0, 0]), np.array([0, 1])
    found = [policy_mixture.log_joint(labels, moments, model) for labels in (one, two)]
    assert found[1] - found[0] == pytest.approx(expected(two) - expected(one))


def test_the_search_finds_the_best_of_all_divisions():
    halves, pooled = policy_mixture.moments_of(_pool(2, each=3, num_steps=20))
    moments = halves.summed(1)
    model = Model(pooled.step, pooled.noise, float(moments.weight.sum()) + 3.0, 1.0)
    start = policy_mixture.merge(moments, model, [2])[0]
    found = policy_mixture.settle(start, moments, model)
    every = [np.array([0, *rest]) for rest in itertools.product((0, 1), repeat=5) if any(rest)]
    best = max(policy_mixture.log_joint(labels, moments, model) for labels in every)
    assert policy_mixture.log_joint(found, moments, model) == pytest.approx(best)


@pytest.mark.parametrize(
    ("name", "first", "number"),
    [("half_cheetah", 2, 2), ("half_cheetah", 3, 3), ("hopper", 2, 2), ("franka_kitchen", 2, 2)],
)
def test_shipped_demonstrations_with_labels_hidden(name, first, number):
    shipped = rj.load_demonstrations(name)
    pool = [t for t in shipped.trajectories if t.strategy < first]
    found = strategies.infer(KEY, pool, CONFIG)
    assert found.num_strategies == number
    assert found.labels.tolist() == [t.strategy for t in pool]


def test_the_double_pendulum_doubts_what_it_has_wrong():
    shipped = rj.load_demonstrations("inverted_double_pendulum")
    found = strategies.infer(KEY, shipped.trajectories, CONFIG)
    known = np.array([t.strategy for t in shipped.trajectories])
    assert found.num_strategies == 2 and strategies.purity(found.labels, known) >= 0.95
    wrong = np.flatnonzero(found.labels != known)
    assert set(np.argsort(found.confidence)[: len(wrong)]) == set(wrong)


def test_without_actions_shipped_demonstrations_are_told_apart_by_motion():
    shipped = rj.load_demonstrations("hopper")
    pool = [dataclasses.replace(t, actions=None) for t in shipped.trajectories]
    found = strategies.infer(KEY, pool, OF_MOTION)
    assert found.labels.tolist() == [t.strategy for t in pool]


def test_agents_of_a_test_set():
    pool = demonstrators.by_agent(rj.load_demonstrations("half_cheetah_test"))
    # Nine snapshots of three skills, two trajectories each.
    assert [t.strategy for t in pool.trajectories] == np.repeat(np.arange(27), 2).tolist()
    some = [t for t in pool.trajectories if t.strategy in (3, 13, 26)]
    assert strategies.infer(KEY, some, CONFIG).labels.tolist() == [0, 0, 1, 1, 2, 2]
    with pytest.raises(RepresentError, match="test_trajectories_per_skill"):
        demonstrators.by_agent(dataclasses.replace(pool, metadata={}))


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
        strategies.infer(KEY, [_swing(3.0, 0), short], OF_MOTION)
    with pytest.raises(RepresentError, match="at most 1"):
        strategies.infer(KEY, _pool(1, each=1), dataclasses.replace(CONFIG, num_strategies=2))
    with pytest.raises(RepresentError, match="at most 1, as many as are told apart, found 3"):
        alike = dataclasses.replace(OF_MOTION, num_strategies=3)
        strategies.infer(KEY, [_swing(3.0, 0)] * 4, alike)
    with pytest.raises(UsageError, match="prior_steps"):
        StrategiesConfig(prior_steps=(1.0, 0.0))
    with pytest.raises(UsageError, match="bandwidth"):
        MotionConfig(bandwidth=0.0)


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
