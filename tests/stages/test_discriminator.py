"""Importance weights, logits, and what a discriminator update does, in closed form."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.errors import UsageError
from represent_jax.stages import discriminator
from represent_jax.types import Transition

CONFIG = discriminator.DiscriminatorConfig(hidden_sizes=(8,), gradient_penalty=0.0)


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
    module, _ = discriminator._networks(config)
    inputs = obs_dim if config.state_only else 2 * obs_dim + action_dim
    key_g, key_h = jax.random.split(key)
    return discriminator.RewardParams(
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
    found = discriminator.importance_weight(jnp.float32(log_prob), jnp.float32(eta), 6)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_importance_weight_of_clean_rows_is_one_and_of_noisy_ones_bounded():
    log_prob = jnp.linspace(-50.0, 50.0, 101)
    np.testing.assert_allclose(
        discriminator.importance_weight(log_prob, jnp.zeros(101), 3), 1.0, rtol=1e-5
    )
    noisy = discriminator.importance_weight(log_prob, jnp.full(101, 0.25), 3)
    assert float(noisy.max()) <= 1.0 / 0.75 + 1e-5


def test_advantage_is_g_plus_discounted_potential_difference():
    rows = _transition(jax.random.PRNGKey(0))
    params = _params(jax.random.PRNGKey(1))
    module, _ = discriminator._networks(CONFIG)
    g = module.apply(params.g, rows.next_obs_t)[:, 0]
    h, next_h = (module.apply(params.h, x)[:, 0] for x in (rows.obs_t, rows.next_obs_t))
    expected = g + CONFIG.shaping_discount * next_h - h
    np.testing.assert_allclose(discriminator.advantage(params, rows, CONFIG), expected, rtol=1e-5)
    ended = rows._replace(discount_t=jnp.zeros(16))
    np.testing.assert_allclose(discriminator.advantage(params, ended, CONFIG), g - h, rtol=1e-5)


def test_state_only_reward_ignores_actions_and_the_other_does_not():
    rows = _transition(jax.random.PRNGKey(0))
    for state_only in (True, False):
        config = dataclasses.replace(CONFIG, state_only=state_only)
        params = _params(jax.random.PRNGKey(1), config)
        one = discriminator.reward(params, rows.obs_t, rows.action_t, rows.next_obs_t, config)
        other = discriminator.reward(params, rows.obs_t, -rows.action_t, rows.next_obs_t, config)
        assert bool(jnp.all(one == other)) is state_only


def test_loss_is_the_weighted_cross_entropy():
    expert, policy = (_transition(jax.random.PRNGKey(i)) for i in (0, 1))
    params = _params(jax.random.PRNGKey(2))
    log_expert, log_policy = jnp.full(16, 0.5), jnp.full(16, -0.25)
    rows = discriminator.Rows(expert, policy, log_expert, log_policy)
    loss, metrics = discriminator.loss(params, rows, jax.random.PRNGKey(3), CONFIG)
    d_expert = jax.nn.sigmoid(discriminator.advantage(params, expert, CONFIG) - log_expert)
    d_policy = jax.nn.sigmoid(discriminator.advantage(params, policy, CONFIG) - log_policy)
    expected = -0.5 * (jnp.mean(jnp.log(d_expert)) + jnp.mean(jnp.log(1.0 - d_policy)))
    np.testing.assert_allclose(loss, expected, rtol=1e-4)
    assert float(metrics["gradient_penalty"]) == 0.0


def test_without_demonstrated_actions_the_loss_is_that_of_f_alone():
    expert, policy = (_transition(jax.random.PRNGKey(i)) for i in (0, 1))
    noise = jnp.full(16, 0.25)
    expert = expert._replace(action_t=None)
    policy = policy._replace(noise_level_t=noise)
    params = discriminator.init(jax.random.PRNGKey(2), expert, CONFIG).params
    log_policy = jnp.linspace(-1.0, 1.0, 16)
    rows = discriminator.Rows(expert, policy, None, log_policy)
    loss, _ = discriminator.loss(params, rows, jax.random.PRNGKey(3), CONFIG)
    f_expert, f_policy = (discriminator.advantage(params, of, CONFIG) for of in (expert, policy))
    weight = discriminator.importance_weight(log_policy, noise, 2)
    expected = -0.5 * jnp.mean(jnp.log(jax.nn.sigmoid(f_expert)))
    expected -= 0.5 * jnp.mean(weight * jnp.log(1.0 - jax.nn.sigmoid(f_policy)))
    np.testing.assert_allclose(loss, expected, rtol=1e-4)


def test_discriminator_learns_to_tell_two_clouds_apart():
    key = jax.random.PRNGKey(0)
    expert, policy = _transition(key, 256), _transition(jax.random.PRNGKey(9), 256)
    expert = expert._replace(next_obs_t=expert.next_obs_t + 3.0)
    config = dataclasses.replace(CONFIG, learning_rate=1e-2, gradient_penalty=0.1)
    params = _params(jax.random.PRNGKey(1), config)
    _, optimizer = discriminator._networks(config)
    state = discriminator.DiscriminatorState(params, optimizer.init((params.g, params.h)))
    rows = discriminator.Rows(expert, policy, jnp.zeros(256), jnp.zeros(256))
    rows = jax.tree.map(lambda x: jnp.stack([x] * 10), rows)
    update = jax.jit(lambda state, key: discriminator.update(state, rows, key, config))
    for i in range(10):
        state, metrics = update(state, jax.random.PRNGKey(i))
    assert float(metrics["accuracy_expert"]) > 0.95
    assert float(metrics["accuracy_policy"]) > 0.95


def test_bad_settings_are_named():
    with pytest.raises(UsageError, match="gradient_penalty"):
        discriminator.DiscriminatorConfig(gradient_penalty=-1.0)
    with pytest.raises(UsageError, match="batch_size"):
        discriminator.DiscriminatorConfig(batch_size=0)


def test_inputs_far_from_demonstrations_are_bounded():
    params = _params(jax.random.PRNGKey(0))
    far = jnp.full((1, 3), 28.0)
    edge = jnp.full((1, 3), discriminator.INPUT_CLIP)
    at_far, at_edge = (
        discriminator.reward(params, obs, jnp.zeros((1, 2)), obs, CONFIG) for obs in (far, edge)
    )
    np.testing.assert_array_equal(at_far, at_edge)


def test_statistics_are_those_of_the_demonstrations():
    rows = _transition(jax.random.PRNGKey(0), 512)
    state = discriminator.init(jax.random.PRNGKey(1), rows, CONFIG)
    np.testing.assert_allclose(state.params.mean, rows.obs_t.mean(axis=0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(state.params.std, rows.obs_t.std(axis=0) + 1e-2, rtol=1e-5)
