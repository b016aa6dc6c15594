import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import probes
import pytest

from represent_jax.agents import ppo, sac
from represent_jax.envs.episode import Episode
from represent_jax.errors import UsageError
from represent_jax.runs import checkpoint

CONFIG = ppo.PpoConfig(
    num_envs=16,
    unroll_length=8,
    num_epochs=4,
    num_minibatches=2,
    hidden_sizes=(16, 16),
    learning_rate=3e-3,
    discount=probes.DISCOUNT,
    entropy_weight=0.0,
)
SMALL = dataclasses.replace(CONFIG, num_envs=4, unroll_length=3, num_epochs=2)
KEY = jax.random.PRNGKey(0)


def episode(name, auto_reset=True):
    return Episode(probes.ProbeEnv(probes.PROBES[name]), auto_reset=auto_reset)


def assert_close(a, b, rtol=1e-5, atol=1e-6):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=rtol, atol=atol)


@functools.cache
def trained():
    """Learners of all probes, trained as one population."""

    def member(probe, key):
        env = Episode(probes.ProbeEnv(probe))
        state = ppo.init(key, env, CONFIG)
        state, metrics = ppo.train(state, env, CONFIG, num_steps=250)
        return state.learner, metrics

    keys = jax.random.split(KEY, len(probes.PROBES))
    learners, _ = jax.jit(jax.vmap(member))(probes.stack(probes.PROBES.values()), keys)
    return {
        name: jax.tree.map(lambda leaf, i=i: leaf[i], learners)
        for i, name in enumerate(probes.PROBES)
    }


@pytest.mark.parametrize(("name", "x", "expected"), probes.VALUES)
def test_critic_knows_the_value(name, x, expected):
    value = ppo.value(trained()[name], jnp.array([x]), 1, CONFIG)
    assert value == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(("name", "x", "expected"), probes.ACTIONS)
def test_policy_takes_the_best_action(name, x, expected):
    policy = ppo.policy_of(trained()[name])
    action = ppo.act(policy, jnp.array([x]), KEY, CONFIG, 1, deterministic=True)
    assert action[0] == pytest.approx(expected, abs=0.1)
