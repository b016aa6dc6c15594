import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import base

from represent_jax.agents.rollout import (
    learned_returns,
    rollout,
    rollout_recurrent,
    true_returns,
)
from represent_jax.envs.episode import Episode

KEY = jax.random.PRNGKey(0)
HORIZON = 4


class Counter(base.Env):
    """Counts up from 0 and pays the count it leaves; past its end, everything is NaN."""

    observation_size = 2
    action_size = 1
    backend = "counter"
    horizon = HORIZON

    def __init__(self, end):
        self.end = end

    def reset(self, rng, where=True):
        zero = jnp.zeros(())
        return base.State(zero, jnp.zeros(2), zero, zero)

    def step(self, state, action):
        count = state.pipeline_state
        after = jnp.where(count >= self.end, jnp.nan, count + 1.0)
        return state.replace(
            pipeline_state=after,
            obs=jnp.array([after, -after]),
            reward=jnp.where(count >= self.end, jnp.nan, count),
            done=(after == self.end).astype(jnp.float32),
        )


def policy(params, obs_t, key):
    return params + 0.1 * obs_t[..., :1]


def run(end=100, noise_levels=(0.0, 0.0), **options):
    env = Episode(Counter(end), auto_reset=False, **options)
    go = jax.jit(lambda key: rollout(env, policy, 0.25, key, jnp.array(noise_levels)))
    return go(KEY)


def test_episodes_to_the_horizon():
    batch = run()
    np.testing.assert_array_equal(batch.obs[..., 0], [[0, 1, 2, 3, 4]] * 2)
    np.testing.assert_array_equal(batch.obs[..., 1], -batch.obs[..., 0])
    np.testing.assert_allclose(batch.actions[..., 0], [[0.25, 0.35, 0.45, 0.55]] * 2, rtol=1e-6)
    np.testing.assert_array_equal(batch.rewards, [[0, 1, 2, 3]] * 2)
    np.testing.assert_array_equal(batch.mask, np.ones((2, 4)))
    np.testing.assert_array_equal(batch.strategy, [0, 0])
    np.testing.assert_array_equal(true_returns(batch), [6, 6])


def test_after_termination_rows_are_masked_and_repeat_the_final_observation():
    batch = run(end=2)
    np.testing.assert_array_equal(batch.obs[..., 0], [[0, 1, 2, 2, 2]] * 2)
    np.testing.assert_allclose(batch.actions[..., 0], [[0.25, 0.35, 0, 0]] * 2, rtol=1e-6)
    np.testing.assert_array_equal(batch.rewards, [[0, 1, 0, 0]] * 2)
    np.testing.assert_array_equal(batch.mask, [[1, 1, 0, 0]] * 2)
    np.testing.assert_array_equal(true_returns(batch), [1, 1])


def test_termination_at_the_last_step_keeps_it():
    batch = run(end=HORIZON)
    np.testing.assert_array_equal(batch.mask, np.ones((2, 4)))
    np.testing.assert_array_equal(true_returns(batch), [6, 6])


def test_another_horizon():
    batch = run(horizon=2)
    assert batch.obs.shape == (2, 3, 2)
    np.testing.assert_array_equal(true_returns(batch), [1, 1])


def test_learned_return_is_the_masked_sum_over_what_transitions_store():
    def reward(params, obs_t, action_t, next_obs_t):
        return params * next_obs_t[..., 0] + obs_t[..., 1] + 10.0 * action_t[..., 0]

    # 2 (1 + 2) - (0 + 1) + 10 (0.25 + 0.35)
    np.testing.assert_allclose(learned_returns(run(end=2), reward, 2.0), [11, 11], rtol=1e-6)


def test_each_episode_has_its_noise_level():
    batch = run(noise_levels=(0.0, 1.0))
    np.testing.assert_array_equal(batch.noise_level, [0.0, 1.0])
    drawn = 0.25 + 0.1 * np.arange(HORIZON)
    np.testing.assert_allclose(batch.actions[0, :, 0], drawn, rtol=1e-6)
    assert np.all(np.abs(batch.actions[1, :, 0] - drawn) > 1e-3)
    assert np.all(np.abs(batch.actions) <= 1.0)


def counting_policy(params, carry, obs_t, key):
    """Acts by the number of its steps, whatever it sees."""
    return {"steps": carry["steps"] + 1}, params * carry["steps"][:, None]


@pytest.mark.parametrize("end", [100, 2])
def test_a_hidden_state_of_each_episode_is_carried_from_step_to_step(end):
    env = Episode(Counter(end), auto_reset=False)
    start = {"steps": jnp.array([0, 3])}
    go = jax.jit(
        lambda carry: rollout_recurrent(env, counting_policy, 0.1, carry, KEY, jnp.zeros(2))
    )
    batch = go(start)
    running = np.arange(HORIZON) < end
    expected = np.array([[0.0, 0.1, 0.2, 0.3], [0.3, 0.4, 0.5, 0.6]]) * running
    np.testing.assert_allclose(batch.actions[..., 0], expected, rtol=1e-6)
    np.testing.assert_array_equal(batch.mask, [running] * 2)
    np.testing.assert_array_equal(true_returns(batch), [np.sum(np.arange(HORIZON) * running)] * 2)


def test_a_hidden_state_sees_observations_and_its_own_keys():
    def summing_policy(params, carry, obs_t, key):
        carry = carry + obs_t[:, 0]
        return carry, jnp.stack([0.01 * carry], axis=-1) + jax.random.uniform(key) * params

    env = Episode(Counter(100), auto_reset=False)

    def actions(params):
        batch = rollout_recurrent(env, summing_policy, params, jnp.zeros(1), KEY, jnp.zeros(1))
        return batch.actions[0, :, 0]

    # Sums of 0; 0, 1; 0, 1, 2; 0, 1, 2, 3.
    np.testing.assert_allclose(actions(0.0), [0.0, 0.01, 0.03, 0.06], rtol=1e-6)
    drawn = np.asarray(actions(0.5) - actions(0.0))
    assert len(np.unique(drawn)) == HORIZON


def test_environments_that_reset_themselves_are_refused():
    env = Episode(Counter(2))
    with pytest.raises(ValueError, match="auto_reset"):
        rollout(env, policy, 0.25, KEY, jnp.zeros(2))
    with pytest.raises(ValueError, match="auto_reset"):
        rollout_recurrent(env, counting_policy, 0.1, {"steps": jnp.zeros(2)}, KEY, jnp.zeros(2))
