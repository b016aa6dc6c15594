"""Behavioural cloning of a linear policy, whose best fit is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.agents import cloning
from represent_jax.agents.sac import PolicyParams
from represent_jax.types import Transition

SLOPE = 0.5


def _log_prob(policy, obs_t, action_t):
    return -0.5 * jnp.sum(jnp.square(action_t - policy.policy * obs_t), axis=-1)


@pytest.fixture
def demonstrations():
    obs_t = jnp.linspace(-1.0, 1.0, 201)[:, None]
    nothing = jnp.zeros(201)
    return Transition(obs_t, SLOPE * obs_t, obs_t, nothing, nothing, nothing)


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
def test_noise_on_observations_shrinks_a_linear_clone_as_it_must(demonstrations, noise):
    policy = PolicyParams(None, jnp.float32(0.0))
    clone = jax.jit(
        lambda key: cloning.clone(
            key, policy, _log_prob, demonstrations, 3_000, noise, learning_rate=1e-2
        )
    )
    found = clone(jax.random.PRNGKey(0)).policy
    variance = float(jnp.mean(jnp.square(demonstrations.obs_t)))
    np.testing.assert_allclose(found, SLOPE * variance / (variance + noise**2), atol=0.01)
