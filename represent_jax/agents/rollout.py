"""Whole episodes of a policy, many at once, in one compiled program."""

import jax
import jax.numpy as jnp

from represent_jax.data.trajectories import TrajectoryBatch, returns
from represent_jax.envs.episode import Episode
from represent_jax.types import Carry, Params, PolicyFn, RecurrentPolicyFn, RewardFn


def rollout(
    env: Episode,
    policy: PolicyFn,
    params: Params,
    key: jax.Array,
    noise_levels: jax.Array,
) -> TrajectoryBatch:
    """Runs one episode for each noise level.

    Args:
      env: episodes without auto-reset.
      policy: the policy, applied to a batch of observations.
      params: its parameters.
      key: PRNG key.
      noise_levels: action noise of each episode, `[num_episodes]`.

    Returns:
      Trajectories padded to the horizon; `strategy` is 0 throughout.

    Raises:
      ValueError: the environment resets itself.
    """

    def stateless(params, carry, obs_t, key):
        return carry, policy(params, obs_t, key)

    return rollout_recurrent(env, stateless, params, (), key, noise_levels)


def rollout_recurrent(
    env: Episode,
    policy: RecurrentPolicyFn,
    params: Params,
    carry: Carry,
    key: jax.Array,
    noise_levels: jax.Array,
) -> TrajectoryBatch:
    """Runs one episode for each noise level with a policy that has a hidden state.

    Args:
      env: episodes without auto-reset.
      policy: the policy, applied to a batch of hidden states and observations.
      params: its parameters.
      carry: its hidden states at the beginning, leaves `[num_episodes, ...]`.
      key: PRNG key.
      noise_levels: action noise of each episode, `[num_episodes]`.

    Returns:
      Trajectories padded to the horizon; `strategy` is 0 throughout.

    Raises:
      ValueError: the environment resets itself.
    """
    if env.auto_reset:
        raise ValueError("rollout: the environment must not reset itself (auto_reset=False)")
    num_episodes = noise_levels.shape[0]
    key_reset, key_act = jax.random.split(key)
    start = jax.vmap(env.reset)(jax.random.split(key_reset, num_episodes), noise_levels)

    def body(before, key):
        state, carry, running = before
        carry, action = policy(params, carry, state.obs, key)
        after = jax.vmap(env.step)(state, action)
        keep = running[:, None] > 0.0
        obs = jnp.where(keep, after.obs, state.obs)
        rows = (
            obs,
            jnp.where(keep, after.info["executed_action"], 0.0),
            jnp.where(running > 0.0, after.reward, 0.0),
            running,
        )
        return (after.replace(obs=obs), carry, running * (1.0 - after.done)), rows

    running = jnp.ones(num_episodes)
    keys = jax.random.split(key_act, env.horizon)
    _, rows = jax.lax.scan(body, (start, carry, running), keys)
    next_obs, actions, rewards, mask = (jnp.swapaxes(x, 0, 1) for x in rows)
    return TrajectoryBatch(
        obs=jnp.concatenate([start.obs[:, None], next_obs], axis=1),
        actions=actions,
        rewards=rewards,
        mask=mask,
        strategy=jnp.zeros(num_episodes, jnp.int32),
        noise_level=noise_levels,
    )


def true_returns(batch: TrajectoryBatch) -> jax.Array:
    """Undiscounted return under the environment's reward, `[num_episodes]`."""
    return returns(batch)


def learned_returns(batch: TrajectoryBatch, reward_fn: RewardFn, params: Params) -> jax.Array:
    """Undiscounted return under a learned reward, `[num_episodes]`."""
    reward_t = reward_fn(params, batch.obs[:, :-1], batch.actions, batch.obs[:, 1:])
    return jnp.sum(reward_t * batch.mask, axis=-1)
