"""Phase 1: importance weights, logits, and what a discriminator update does, in closed form."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.errors import UsageError
from represent_jax.stages import airl
from represent_jax.types import Transition

CONFIG = airl.AirlConfig(hidden_sizes=(8,), gradient_penalty=0.0)


def _transition(key, batch=16, obs_dim=3, action_dim=2, discount=1.0):
    keys = jax.random.split(key, 3)
    return Transition(
        obs_t=jax.random.normal(keys[0], (batch, obs_dim)),
        action_t=jnp.tanh(jax.random.normal(keys[1], (batch, action_dim))),
        next_obs_t=jax.random.normal(keys[2], (batch, obs_dim)),
        reward_t=jnp.zeros(batch),
        discount_t=jnp.full(batch, discount),
        noise_level_t=jnp.zeros(batch),
    )


def _params(key, config=CONFIG, obs_dim=3, action_dim=2):
    module, _ = airl._networks(config)
    inputs = obs_dim if config.state_only else 2 * obs_dim + action_dim
    key_g, key_h = jax.random.split(key)
    return airl.RewardParams(
        g=module.init(key_g, jnp.zeros(inputs)),
        h=module.init(key_h, jnp.zeros(obs_dim)),
        mean=jnp.zeros(obs_dim),
        std=jnp.ones(obs_dim),
    )


@pytest.mark.parametrize("log_prob", [-30.0, -3.0, 0.0, 4.0, 30.0])
@pytest.mark.parametrize("eta", [0.0, 0.05, 0.25, 1.0])
def test_importance_weight_is_ssrrs_ratio(log_prob, eta):
    density, uniform = np.exp(np.float64(log_prob)), 0.5**6
    expected = density / (eta * uniform + (1.0 - eta) * density)
    found = airl.importance_weight(jnp.float32(log_prob), jnp.float32(eta), 6)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_importance_weight_of_clean_rows_is_one_and_of_noisy_ones_bounded():
    log_prob = jnp.linspace(-50.0, 50.0, 101)
    np.testing.assert_allclose(airl.importance_weight(log_prob, jnp.zeros(101), 3), 1.0, rtol=1e-5)
    noisy = airl.importance_weight(log_prob, jnp.full(101, 0.25), 3)
    assert float(noisy.max()) <= 1.0 / 0.75 + 1e-5


def test_advantage_is_g_plus_discounted_potential_difference():
    rows = _transition(jax.random.PRNGKey(0))
    params = _params(jax.random.PRNGKey(1))
    module, _ = airl._networks(CONFIG)
    g = module.apply(params.g, rows.next_obs_t)[:, 0]
    h, next_h = (module.apply(params.h, x)[:, 0] for x in (rows.obs_t, rows.next_obs_t))
    expected = g + CONFIG.shaping_discount * next_h - h
    np.testing.assert_allclose(airl.advantage(params, rows, CONFIG), expected, rtol=1e-5)
    ended = rows._replace(discount_t=jnp.zeros(16))
    np.testing.assert_allclose(airl.advantage(params, ended, CONFIG), g - h, rtol=1e-5)


def test_state_only_reward_ignores_actions_and_the_other_does_not():
    rows = _transition(jax.random.PRNGKey(0))
    for state_only in (True, False):
        config = dataclasses.replace(CONFIG, state_only=state_only)
        params = _params(jax.random.PRNGKey(1), config)
        one = airl.reward(params, rows.obs_t, rows.action_t, rows.next_obs_t, config)
        other = airl.reward(params, rows.obs_t, -rows.action_t, rows.next_obs_t, config)
        assert bool(jnp.all(one == other)) is state_only


def test_loss_is_the_weighted_cross_entropy():
    expert, policy = (_transition(jax.random.PRNGKey(i)) for i in (0, 1))
    params = _params(jax.random.PRNGKey(2))
    log_expert, log_policy = jnp.full(16, 0.5), jnp.full(16, -0.25)
    loss, metrics = airl.discriminator_loss(
        params, expert, policy, log_expert, log_policy, jax.random.PRNGKey(3), CONFIG
    )
    d_expert = jax.nn.sigmoid(airl.advantage(params, expert, CONFIG) - log_expert)
    d_policy = jax.nn.sigmoid(airl.advantage(params, policy, CONFIG) - log_policy)
    expected = -0.5 * (jnp.mean(jnp.log(d_expert)) + jnp.mean(jnp.log(1.0 - d_policy)))
    np.testing.assert_allclose(loss, expected, rtol=1e-4)
    assert float(metrics["gradient_penalty"]) == 0.0


def test_discriminator_learns_to_tell_two_clouds_apart():
    key = jax.random.PRNGKey(0)
    expert, policy = _transition(key, 256), _transition(jax.random.PRNGKey(9), 256)
    expert = expert._replace(next_obs_t=expert.next_obs_t + 3.0)
    config = dataclasses.replace(CONFIG, learning_rate=1e-2, gradient_penalty=0.1)
    params = _params(jax.random.PRNGKey(1), config)
    _, optimizer = airl._networks(config)
    zeros = jnp.zeros(256)

    @jax.jit
    def update(nets, opt, key):
        def loss_fn(nets):
            whole = params._replace(g=nets[0], h=nets[1])
            return airl.discriminator_loss(whole, expert, policy, zeros, zeros, key, config)

        (_, metrics), grads = jax.value_and_grad(loss_fn, has_aux=True)(nets)
        updates, opt = optimizer.update(grads, opt, nets)
        return jax.tree.map(jnp.add, nets, updates), opt, metrics

    nets = (params.g, params.h)
    opt = optimizer.init(nets)
    for i in range(100):
        nets, opt, metrics = update(nets, opt, jax.random.PRNGKey(i))
    assert float(metrics["accuracy_expert"]) > 0.95
    assert float(metrics["accuracy_policy"]) > 0.95


def test_bad_settings_are_named():
    with pytest.raises(UsageError, match="gradient_penalty"):
        airl.AirlConfig(gradient_penalty=-1.0)
    with pytest.raises(UsageError, match="env_steps"):
        airl.AirlConfig(env_steps=0)
