"""Both engines against the installed Gymnasium, step by step from the same states.

Relative error is measured as |ours - Gym's| / max(1, |Gym's|), component by component: entries
below 1 in size (angles, heights) are compared absolutely. States are rounded to float32 before
Gym steps from them, so that both sides start from the very same numbers.
"""

import functools
import warnings
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from brax.envs import base

from represent_jax.envs import make_env
from represent_jax.physics import PhysicsState

NUM_STEPS = 200
GYM = {
    "hopper": ("Hopper-v4", {"terminate_when_unhealthy": False}),
    "half_cheetah": ("HalfCheetah-v4", {}),
    "inverted_double_pendulum": ("InvertedDoublePendulum-v4", {}),
}


class Steps(NamedTuple):
    """Gym's steps, `[NUM_STEPS, ...]`, and whether it would have terminated after each."""

    qpos: np.ndarray
    qvel: np.ndarray
    qacc_warmstart: np.ndarray
    actions: np.ndarray
    next_obs: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray


@functools.cache
def make_gym(name):
    gym_name, options = GYM[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # v4 is what the tasks copy, and is called outdated
        return gymnasium.make(gym_name, **options).unwrapped


@functools.cache
def gym_steps(name):
    """A random rollout; it goes on after a fall, and starts afresh half way."""
    env = make_gym(name)
    rng = np.random.default_rng(0)
    rows = []
    for i in range(NUM_STEPS):
        if i in (0, NUM_STEPS // 2):
            env.reset(seed=i)
        data = env.data
        qpos, qvel, warmstart = (np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart))
        env.set_state(qpos, qvel)
        data.qacc_warmstart[:] = warmstart
        action = rng.uniform(-1.0, 1.0, env.model.nu).astype(np.float32)
        obs, reward, terminated, _, _ = env.step(action)
        rows.append((qpos, qvel, warmstart, action, obs, reward, terminated))
    return Steps(*(np.stack(column) for column in zip(*rows, strict=True)))


@functools.cache
def our_steps(name, backend):
    env = make_env(name, backend)
    steps = gym_steps(name)
    zero = jnp.zeros(())

    @jax.jit
    @jax.vmap
    def step(qpos, qvel, warmstart, action):
        physics = PhysicsState(qpos, qvel, jnp.zeros(0), warmstart, {})
        after = env.step(base.State(physics, zero, zero, zero), action)
        return after.obs, after.reward, env.task.terminated(after.pipeline_state)

    return jax.device_get(step(steps.qpos, steps.qvel, steps.qacc_warmstart, steps.actions))


def relative_error(ours, gyms):
    return np.abs(ours - gyms) / np.maximum(1.0, np.abs(gyms))


@pytest.fixture(autouse=True)
def log_elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings into the working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", GYM)
def test_mujoco_is_gym(name):
    steps = gym_steps(name)
    obs, rewards, terminated = our_steps(name, "mujoco")
    assert relative_error(obs, steps.next_obs).max() <= 1e-4
    assert relative_error(rewards, steps.rewards).max() <= 1e-4
    if name == "inverted_double_pendulum":
        np.testing.assert_array_equal(terminated, steps.terminated)
        assert 0 < np.sum(terminated) < NUM_STEPS


# Single precision and a solver cut short: most steps agree to five digits and more, the few in
# which a contact or a limit opens or closes differ by more. Bounds on (median, 99 % quantile,
# maximum) of the largest error in each step; they also hold for the thousands of steps that
# `python -m experiments.benchmark --sections=solver` looks at.
MJX_BOUNDS = {
    "hopper": (2e-6, 5e-5, 1e-3),
    "half_cheetah": (1e-5, 5e-4, 1e-2),
    "inverted_double_pendulum": (2e-6, 5e-5, 5e-4),
}


@pytest.mark.parametrize("name", GYM)
def test_mjx_is_near_gym(name):
    steps = gym_steps(name)
    obs, rewards, _ = our_steps(name, "mjx")
    for error in (
        relative_error(obs, steps.next_obs).max(axis=-1),
        relative_error(rewards, steps.rewards),
    ):
        measured = np.median(error), np.quantile(error, 0.99), error.max()
        assert np.all(np.array(measured) <= MJX_BOUNDS[name]), measured


@pytest.mark.parametrize("name", GYM)
def test_first_observation_is_gyms(name):
    gym, env = make_gym(name), make_env(name, "mujoco")
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    qpos, qvel = np.float64(state.pipeline_state.qpos), np.float64(state.pipeline_state.qvel)
    gym.reset(seed=0)
    gym.set_state(qpos, qvel)
    np.testing.assert_allclose(state.obs, gym._get_obs(), rtol=1e-5, atol=1e-5)
    assert env.observation_size == gym.observation_space.shape[0]
    assert env.action_size == gym.action_space.shape[0]
    assert env.engine.dt == pytest.approx(gym.dt)
    assert env.horizon == gymnasium.spec(GYM[name][0]).max_episode_steps == 1000


# Spread of the positions and of the velocities around the reference pose, with their laws.
RESETS = {
    "hopper": (scipy.stats.uniform(-5e-3, 1e-2), scipy.stats.uniform(-5e-3, 1e-2)),
    "half_cheetah": (scipy.stats.uniform(-0.1, 0.2), scipy.stats.norm(scale=0.1)),
    "inverted_double_pendulum": (scipy.stats.uniform(-0.1, 0.2), scipy.stats.norm(scale=0.1)),
}


@pytest.mark.parametrize("name", GYM)
def test_reset_distribution_is_gyms(name):
    gym, env = make_gym(name), make_env(name, "mujoco")
    keys = jax.random.split(jax.random.PRNGKey(0), 300)
    qpos, qvel = jax.vmap(lambda key: env.task.reset(key, env._init_qpos))(keys)
    gyms = []
    for seed in range(300):
        gym.reset(seed=seed)
        gyms.append((gym.data.qpos.copy(), gym.data.qvel.copy()))
    gym_qpos, gym_qvel = (np.stack(x) for x in zip(*gyms, strict=True))
    np.testing.assert_allclose(env._init_qpos, gym.init_qpos)
    qpos_law, qvel_law = RESETS[name]
    for ours, theirs, law in (
        (qpos - gym.init_qpos, gym_qpos - gym.init_qpos, qpos_law),
        (qvel, gym_qvel, qvel_law),
    ):
        for joint in range(ours.shape[1]):
            assert scipy.stats.kstest(ours[:, joint], law.cdf).pvalue > 1e-3
            assert scipy.stats.ks_2samp(ours[:, joint], theirs[:, joint]).pvalue > 1e-3
        # Joints are drawn independently: correlations of 300 draws stay below 4 sigma.
        correlation = np.corrcoef(ours.T) - np.eye(ours.shape[1])
        assert np.abs(correlation).max() < 4.0 / np.sqrt(300)
