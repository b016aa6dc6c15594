"""The initial reward of noisy rollouts, with and without its floor."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import represent_jax as rj
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.methods import pipeline
from represent_jax.methods.config import make_problem
from represent_jax.methods.population import stack
from represent_jax.methods.presets import make_config
from represent_jax.runs import open_run
from represent_jax.stages import airl, noise

CONFIG = make_config("smoke", "half_cheetah")
LEVELS, REPEATS, STEPS = 5, 2, 20


@pytest.fixture(scope="module")
def given():
    env = rj.make_env("half_cheetah", "mujoco")
    problem = make_problem(CONFIG, env, rj.load_demonstrations("half_cheetah"))
    demonstrations = pipeline.transitions_of(problem.lessons)

    def first(key, rows):
        return airl.finish(airl.init(key, problem.env, rows, CONFIG.airl))

    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    output = jax.jit(jax.vmap(first))(keys, stack(demonstrations))
    # Around the demonstrations at low levels, far from them at high ones.
    far = jnp.repeat(jnp.linspace(0.5, 40.0, LEVELS), REPEATS)[None, :, None, None]
    shape = (2, LEVELS * REPEATS, STEPS + 1, env.observation_size)
    obs = far * jax.random.normal(jax.random.PRNGKey(1), shape)
    zeros = jnp.zeros(shape[:3])[..., :-1]
    actions = jnp.zeros((*zeros.shape, env.action_size))
    # Rollouts that ended half way are judged as if they had stayed.
    mask = jnp.where(jnp.arange(STEPS) < STEPS // 2, 1.0, 0.0) + zeros
    labels = jnp.zeros(zeros.shape[:2])
    batch = TrajectoryBatch(obs, actions, zeros, mask, labels.astype(jnp.int32), labels)
    returns = jnp.zeros((2, LEVELS, REPEATS))
    levels = jnp.tile(jnp.linspace(0.0, 0.8, LEVELS), (2, 1))
    return problem, output, noise.NoisyData(batch, levels, returns), demonstrations


def test_no_step_counts_less_than_the_demonstrated_quantile(given):
    _, first, noisy, demonstrations = given
    found = pipeline.floored_returns(CONFIG, demonstrations, first, noisy)
    assert found.shape == noisy.returns.shape
    cut = 0
    for i, rows in enumerate(demonstrations):
        params = jax.tree.map(lambda x, i=i: x[i], first.reward)
        shown = airl.reward(params, rows.obs_t, None, rows.next_obs_t, CONFIG.airl)
        worst = np.quantile(shown, CONFIG.curve.reward_floor)
        reached = noisy.trajectories.obs[i, :, 1:]
        plain = airl.reward(params, reached, None, reached, CONFIG.airl)
        cut += int((plain < worst).sum())
        expected = jnp.maximum(plain, worst).sum(axis=-1).reshape(LEVELS, REPEATS)
        np.testing.assert_allclose(found[i], expected, rtol=1e-4, atol=1e-4)
    assert 0 < cut < noisy.trajectories.mask.size


def test_curves_are_of_the_floored_returns_unless_told_otherwise(given):
    problem, first, noisy, demonstrations = given
    falling = jnp.tile(jnp.linspace(1.0, 0.0, LEVELS)[:, None], (2, 1, REPEATS))
    noisy = noisy._replace(returns=falling)
    plain = dataclasses.replace(CONFIG, curve=dataclasses.replace(CONFIG.curve, reward_floor=None))
    curves = pipeline.fit_curves(plain, problem, first, noisy)
    np.testing.assert_allclose(curves.scaled_returns, falling[..., 0], atol=1e-6)
    floored = pipeline.floored_returns(CONFIG, demonstrations, first, noisy)
    typical = np.median(floored, axis=-1)
    low, high = typical.min(axis=1, keepdims=True), typical.max(axis=1, keepdims=True)
    curves = pipeline.fit_curves(CONFIG, problem, first, noisy)
    np.testing.assert_allclose(curves.scaled_returns, (typical - low) / (high - low), atol=1e-5)


@pytest.mark.parametrize("actions", ["mode", "sampled"])
def test_rollouts_without_noise_are_of_the_mode_or_of_samples(given, tmp_path, actions):
    problem, first, _, _ = given
    config = dataclasses.replace(CONFIG, noise=dataclasses.replace(CONFIG.noise, actions=actions))
    with open_run(tmp_path / "run", config) as run:
        noisy = pipeline.run_noise(jax.random.PRNGKey(3), config, problem, first, run)
    clean = jax.tree.map(lambda x: x[:, : CONFIG.noise.trajectories_per_level], noisy.trajectories)

    def mode_of(policy, obs_t):
        key = jax.random.PRNGKey(0)
        return airl.act(policy, obs_t, key, CONFIG.airl, problem.env.action_size, True)

    modes = jax.vmap(mode_of)(first.policy, clean.obs[..., :-1, :])
    off = float(jnp.max(jnp.abs(clean.actions - modes)))
    assert off < 1e-4 if actions == "mode" else off > 0.01


def test_bounded_rewards_are_found_again(given, tmp_path):
    problem, first, noisy, _ = given
    bounded = dataclasses.replace(
        CONFIG.regression, input_quantile=0.99, within_demonstrations=True
    )
    config = dataclasses.replace(CONFIG, regression=bounded)
    curves = pipeline.fit_curves(config, problem, first, noisy)
    with open_run(tmp_path / "run", config) as run:
        fitted, found = (
            pipeline.run_regression(
                jax.random.PRNGKey(2), config, problem, noisy, curves, run, checkpoint_seconds=60.0
            )
            for _ in range(2)
        )
    assert fitted.bounds is not None and fitted.task_range is not None
    jax.tree.map(np.testing.assert_array_equal, fitted, found)
