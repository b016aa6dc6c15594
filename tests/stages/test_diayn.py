"""Demonstrators: the diversity reward in closed form, and skills that learn to differ."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.envs import Episode, make_env
from represent_jax.errors import UsageError
from represent_jax.stages import diayn


def test_diversity_reward_is_log_ratio_to_the_uniform_prior():
    posterior = jnp.array([[0.5, 0.5], [0.9, 0.1], [1e-9, 1.0]])
    skill = jnp.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    found = diayn.diversity_reward(jnp.log(posterior), skill, floor=-5.0, ceiling=1.0)
    np.testing.assert_allclose(found, [0.0, np.log(1.8), -5.0], atol=1e-6)


def test_a_floor_of_zero_never_punishes():
    log_posterior = jax.nn.log_softmax(jax.random.normal(jax.random.PRNGKey(0), (100, 3)))
    skill = jax.nn.one_hot(jnp.arange(100) % 3, 3)
    assert float(diayn.diversity_reward(log_posterior, skill, 0.0, 1.0).min()) >= 0.0


def test_bad_settings_are_named():
    with pytest.raises(UsageError, match="diversity_floor: expected below diversity_ceiling"):
        diayn.DiaynConfig(diversity_floor=1.0)
    env = Episode(make_env("inverted_double_pendulum", "mujoco"), 10)
    config = diayn.DiaynConfig(discriminator_obs=(0, 99))
    with pytest.raises(UsageError, match=r"discriminator_obs: .*size 11, found \(0, 99\)"):
        diayn.init(jax.random.PRNGKey(0), env, config)


def test_staggered_episodes_know_their_horizon():
    env = Episode(make_env("inverted_double_pendulum", "mujoco"), 10)
    sac = dataclasses.replace(
        diayn.DiaynConfig().sac,
        num_envs=64,
        buffer_capacity=640,
        warmup_env_steps=64,
        staggered=True,
    )
    config = diayn.DiaynConfig(sac=sac)
    state = jax.jit(lambda key: diayn.init(key, env, config))(jax.random.PRNGKey(0))
    assert set(np.unique(state.sac.env_state.info["steps"])) == set(range(10))
