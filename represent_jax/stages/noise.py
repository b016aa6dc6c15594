"""Phase 2, first half: rollouts of every strategy's policy at many noise levels.

With probability eta the whole action is replaced by a uniform one (SSRR, Chen et al., 2020), so
that performance falls as eta rises; the initial reward of Phase 1 says by how much.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from represent_jax.agents import rollout as rollouts
from represent_jax.config import later, require
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.envs.episode import Episode
from represent_jax.types import Params, PolicyFn, RewardFn


@dataclasses.dataclass(frozen=True)
class NoiseConfig:
    """Settings of the noisy rollouts.

    Attributes:
      num_levels: number of noise levels.
      level_step: distance between two levels; the first is 0.
      trajectories_per_level: episodes at each level.
      actions: what Phase 1's policy does where noise lets it: "sampled" actions, as SSRR's does, or
        their "mode". For whoever makes `run`'s policy function; see `methods.pipeline.run_noise`.
      action_size: random actions are uniform in [-action_size, action_size]; 1 is all there is. For
        whoever makes `run`'s `Episode`, as its `noise_size`.
    """

    num_levels: int = 20
    level_step: float = 0.05
    trajectories_per_level: int = 5
    actions: str = later("sampled")
    action_size: float = later(1.0)

    def __post_init__(self) -> None:
        require(self.num_levels >= 5, "num_levels", "at least 5", self.num_levels)
        require(
            self.trajectories_per_level >= 1,
            "trajectories_per_level",
            "at least 1",
            self.trajectories_per_level,
        )
        require(self.actions in ("mode", "sampled"), "actions", "'mode' or 'sampled'", self.actions)
        require(0.0 < self.action_size <= 1.0, "action_size", "in (0, 1]", self.action_size)
        highest = highest_level(self)
        require(0.0 < highest <= 1.0, "level_step", "highest level in (0, 1]", highest)


class NoisyData(NamedTuple):
    """Noisy rollouts of one strategy.

    Attributes:
      trajectories: all episodes, level by level, `[num_levels * trajectories_per_level]`.
      levels: `[num_levels]`.
      returns: initial reward of each episode, `[num_levels, trajectories_per_level]`.
    """

    trajectories: TrajectoryBatch
    levels: jax.Array
    returns: jax.Array


def highest_level(config: NoiseConfig) -> float:
    """The highest noise level; the lowest is 0."""
    return config.level_step * (config.num_levels - 1)


def levels_of(config: NoiseConfig) -> jax.Array:
    """The noise levels, `[num_levels]`."""
    return config.level_step * jnp.arange(config.num_levels, dtype=jnp.float32)


def run(
    key: jax.Array,
    env: Episode,
    policy: PolicyFn,
    policy_params: Params,
    reward_fn: RewardFn,
    reward_params: Params,
    config: NoiseConfig,
) -> NoisyData:
    """Rolls out one strategy at every level; vmap over strategies.

    Args:
      key: PRNG key.
      env: episodes without auto-reset.
      policy, policy_params: Phase 1's policy.
      reward_fn, reward_params: Phase 1's reward.
      config: settings.
    """
    levels = levels_of(config)
    each = jnp.repeat(levels, config.trajectories_per_level)
    batch = rollouts.rollout(env, policy, policy_params, key, each)
    returns = judge(batch, reward_fn, reward_params)
    return NoisyData(batch, levels, returns.reshape(config.num_levels, -1))


def judge(batch: TrajectoryBatch, reward_fn: RewardFn, reward_params: Params) -> jax.Array:
    """What the initial reward makes of rollouts, `[num_trajectories]`.

    An episode that ends early is judged as if it stayed in its last state until the horizon:
    the initial reward is known up to a constant, and a sum over fewer steps would turn that
    constant into a preference for short or for long episodes.
    """
    whole = batch._replace(mask=jnp.ones_like(batch.mask))
    return rollouts.learned_returns(whole, reward_fn, reward_params)
