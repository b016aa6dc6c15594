"""The documentation's own robot: run as it is printed, on both engines, against Gymnasium's."""

import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pages
import pytest
from brax.envs import base

import represent_jax as rj
from represent_jax.envs import registry
from represent_jax.physics import PhysicsState


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The names that the page leaves behind."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("page"))
        known = {name: task for name, task in registry._TASKS.items() if name != "swimmer"}
        patch.setattr(registry, "_TASKS", known)
        yield pages.run_page("own_robot.md")


def test_both_engines_agree(page):
    ours, theirs = page["states"]["mujoco"], page["states"]["mjx"]
    np.testing.assert_allclose(ours.obs, theirs.obs, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(ours.reward, theirs.reward, rtol=1e-3, atol=1e-4)


def test_it_is_gymnasiums_swimmer(page):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Version 4 is called outdated.
        gym = gymnasium.make("Swimmer-v4").unwrapped
    env = rj.make_env("swimmer", "mujoco")
    assert env.observation_size == gym.observation_space.shape[0]
    assert env.engine.dt == pytest.approx(gym.dt)
    step, zero, rng = jax.jit(env.step), jnp.zeros(()), np.random.default_rng(0)
    gym.reset(seed=0)
    for _ in range(20):
        data = gym.data
        qpos, qvel, warmstart = (np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart))
        gym.set_state(qpos, qvel)
        data.qacc_warmstart[:] = warmstart
        action = rng.uniform(-1.0, 1.0, 2).astype(np.float32)
        obs, reward, *_ = gym.step(action)
        physics = PhysicsState(qpos, qvel, jnp.zeros(0), warmstart, {})
        after = step(base.State(physics, zero, zero, zero), action)
        np.testing.assert_allclose(after.obs, obs, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(after.reward, reward, rtol=1e-3, atol=1e-4)


def test_its_rewards_are_learned(page):
    obs, actions = page["obs"], page["actions"]
    assert page["demonstrations"].num_strategies == 2
    by_target = {
        target: np.asarray(page["reward"](obs[:-1], actions, obs[1:], target=target))
        for target in ("task", "strategy_1", "strategy_2")
    }
    assert all(np.isfinite(rewards).all() for rewards in by_target.values())
    assert np.any(by_target["strategy_1"] != by_target["strategy_2"])
