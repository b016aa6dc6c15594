"""The rewards of Eq. 1: what they see, what they pay, and where that ends."""

import dataclasses
import functools

import batches
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.errors import UsageError
from represent_jax.stages import decomposition
from represent_jax.stages.regression_config import RegressionConfig

CONFIG = RegressionConfig(hidden_sizes=(16, 16), kernel_scale=0.1)


def draw(obs_dim, num_strategies, config):
    keys = jax.random.split(jax.random.PRNGKey(0))
    return decomposition.draw(*keys, obs_dim, 1, num_strategies, config)


def test_reward_is_task_plus_weighted_strategy():
    config = dataclasses.replace(CONFIG, strategy_weight=0.5, ensemble_size=2)
    rewards = draw(3, 2, config)
    obs = jax.random.normal(jax.random.PRNGKey(1), (7, 3))
    task = decomposition.reward(rewards, obs, None, obs, config)
    head = jax.tree.map(lambda leaf: leaf[:, 1], rewards.strategies)
    own = decomposition.head_reward(head, obs, config)
    found = decomposition.reward(rewards, obs, None, obs, config, strategy=1)
    np.testing.assert_allclose(found, task + 0.5 * own, rtol=1e-6)


def test_task_reward_sees_its_entries_and_strategies_see_all():
    config = dataclasses.replace(CONFIG, task_entries=(2, 0), include_action=True)
    rewards = draw(3, 2, config)
    row = jax.random.normal(jax.random.PRNGKey(1), (3,))
    action = jnp.array([0.3])

    def slopes(strategy):
        reward = functools.partial(decomposition.reward, rewards, config=config, strategy=strategy)
        by = jax.grad(lambda *rows: reward(*rows), argnums=(0, 1, 2))(row, action, row)
        return [np.abs(slope) > 0.0 for slope in by]

    before, by_action, after = slopes(None)
    assert not before.any() and not by_action.any()
    np.testing.assert_array_equal(after, [True, False, True])
    assert all(seen.all() for seen in slopes(1))


def test_task_entries_outside_the_observation_are_refused():
    config = dataclasses.replace(CONFIG, task_entries=(0, 3))
    with pytest.raises(UsageError, match=r"task_entries.*size 3.*\(0, 3\)"):
        draw(3, 2, config)
    with pytest.raises(UsageError, match="task_entries"):
        dataclasses.replace(CONFIG, task_entries=(-1,))


def test_bounded_rewards_pay_nothing_for_going_beyond_what_was_rolled_out():
    config = dataclasses.replace(CONFIG, input_quantile=1.0)
    noisy = batches.make(np.random.default_rng(0).normal(size=(3, 21, 2)), lengths=[19, 19, 19])
    # Past the end of an episode nothing was rolled out.
    noisy = jax.tree.map(lambda x: x[None], noisy._replace(obs=noisy.obs.at[:, -1].set(1e6)))
    rewards = decomposition.bound(draw(2, 1, config), noisy, noisy, config)
    reached = noisy.obs[:, :, 1:-1].reshape(-1, 2)
    np.testing.assert_allclose(rewards.bounds.high, reached.max(axis=0))
    np.testing.assert_allclose(rewards.bounds.low, reached.min(axis=0))
    for edge, beyond in ((rewards.bounds.high, 5.0), (rewards.bounds.low, -5.0)):
        for strategy in (None, 0):
            there = decomposition.reward(rewards, None, None, edge, config, strategy)
            farther = decomposition.reward(rewards, None, None, edge + beyond, config, strategy)
            np.testing.assert_array_equal(farther, there)
    assert jax.tree.map(jnp.shape, rewards) == jax.tree.map(
        jnp.shape, decomposition.example(2, 1, 1, config)
    )


@pytest.mark.parametrize("quantile", [None, 1.0])
def test_the_task_reward_falls_beyond_what_was_demonstrated(quantile):
    config = dataclasses.replace(
        CONFIG, task_entries=(0, 2), within_demonstrations=True, input_quantile=quantile
    )
    random = np.random.default_rng(0)
    noisy = batches.make(random.uniform(-3.0, 3.0, size=(3, 21, 3)))
    demonstrations = batches.make(random.uniform(-1.0, 1.0, size=(2, 21, 3)) * [1.0, 1.0, 0.5])
    noisy, alone = (jax.tree.map(lambda x: x[None], one) for one in (noisy, demonstrations))
    rewards = decomposition.bound(draw(3, 1, config), noisy, alone, config)
    fitted = rewards._replace(task_range=None, own_bounds=None)
    states = demonstrations.obs[:, 1:].reshape(-1, 3)
    low, high = states.min(axis=0), states.max(axis=0)

    def fall(obs):
        at_edge = obs.at[..., jnp.array([0, 2])].set(
            jnp.clip(obs, low, high)[..., jnp.array([0, 2])]
        )
        before = decomposition.reward(fitted, None, None, at_edge, config)
        return before - decomposition.reward(rewards, None, None, obs, config)

    np.testing.assert_array_equal(fall(states), 0.0)
    earned = decomposition.reward(fitted, None, None, states, config)
    most = earned.max() - earned.min()
    width = (high - low)[0]
    edge = jnp.array([high[0], 0.0, 0.0])
    for share in (0.25, 0.5):
        beyond = edge + jnp.array([share * width, 0.0, 0.0])
        np.testing.assert_allclose(fall(beyond), share * most, rtol=1e-3)
    np.testing.assert_allclose(fall(edge + 50.0), most, rtol=1e-3)
    # What is not of the task may go where it will.
    np.testing.assert_allclose(fall(jnp.array([0.0, 50.0, 0.0])), 0.0, atol=1e-9)
    assert jax.tree.map(jnp.shape, rewards) == jax.tree.map(
        jnp.shape, decomposition.example(3, 1, 1, config)
    )


def test_the_task_reward_is_as_fitted_where_demonstrations_went_farther_than_noisy_rollouts():
    config = dataclasses.replace(CONFIG, within_demonstrations=True, input_quantile=1.0)
    random = np.random.default_rng(0)
    both = [batches.make(random.uniform(-far, far, size=(2, 21, 3))) for far in (0.5, 1.0)]
    noisy, demonstrations = (jax.tree.map(lambda x: x[None], one) for one in both)
    rewards = decomposition.bound(draw(3, 1, config), noisy, demonstrations, config)
    fitted = rewards._replace(bounds=None, task_range=None)
    states = demonstrations.obs[0, :, 1:]
    np.testing.assert_array_equal(
        decomposition.reward(rewards, None, None, states, config),
        decomposition.reward(fitted, None, None, states, config),
    )


def test_the_task_reward_is_finite_where_demonstrations_change_nothing_that_it_sees():
    config = dataclasses.replace(CONFIG, task_entries=(1,), within_demonstrations=True)
    obs = np.random.default_rng(0).normal(size=(2, 21, 2))
    still = obs * [1.0, 0.0]
    noisy, alone = (jax.tree.map(lambda x: x[None], batches.make(one)) for one in (obs, still))
    rewards = decomposition.bound(draw(2, 1, config), noisy, alone, config)
    reward = decomposition.reward(rewards, None, None, noisy.obs[0, :, 1:], config)
    np.testing.assert_array_equal(reward, np.full(reward.shape, reward[0, 0]))
    assert np.isfinite(reward).all()


def test_a_strategy_is_paid_for_nothing_that_it_did_not_show():
    config = dataclasses.replace(CONFIG, within_demonstrations=True)
    random = np.random.default_rng(0)
    # The second strategy goes twice as far.
    both = [batches.make(random.uniform(-far, far, size=(2, 21, 3))) for far in (1.0, 2.0)]
    both = jax.tree.map(lambda *x: jnp.stack(x), *both)
    rewards = decomposition.bound(draw(3, 2, config), both, both, config)
    fitted = rewards._replace(task_range=None, own_bounds=None)

    def own(rewards, obs, strategy):
        with_own = decomposition.reward(rewards, None, None, obs, config, strategy)
        return with_own - decomposition.reward(rewards, None, None, obs, config)

    beyond = jnp.array([[1.5, -1.5, 0.5], [9.0, 0.0, 0.0]])
    for strategy in range(2):
        shown = both.obs[strategy, :, 1:].reshape(-1, 3)
        np.testing.assert_allclose(
            own(rewards, shown, strategy), own(fitted, shown, strategy), atol=1e-7
        )
        edge = jnp.clip(beyond, shown.min(axis=0), shown.max(axis=0))
        found, expected = own(rewards, beyond, strategy), own(fitted, edge, strategy)
        np.testing.assert_allclose(found, expected, atol=1e-7)
