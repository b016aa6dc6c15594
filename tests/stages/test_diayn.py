"""Demonstrators: the diversity reward in closed form, and skills that learn to differ."""

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.stages import diayn


def test_diversity_reward_is_log_ratio_to_the_uniform_prior():
    posterior = jnp.array([[0.5, 0.5], [0.9, 0.1], [1e-9, 1.0]])
    skill = jnp.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    found = diayn.diversity_reward(jnp.log(posterior), skill, floor=-5.0)
    np.testing.assert_allclose(found, [0.0, np.log(1.8), -5.0], atol=1e-6)


def test_a_floor_of_zero_never_punishes():
    log_posterior = jax.nn.log_softmax(jax.random.normal(jax.random.PRNGKey(0), (100, 3)))
    skill = jax.nn.one_hot(jnp.arange(100) % 3, 3)
    assert float(diayn.diversity_reward(log_posterior, skill, 0.0).min()) >= 0.0
