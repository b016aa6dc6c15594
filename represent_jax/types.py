"""Types that cross more than one floor of the package."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import jax

Metrics = Mapping[str, jax.Array]
Params = object
Carry = object


class Transition(NamedTuple):
    """What one environment step leaves behind; every field may have leading batch axes.

    Attributes:
      obs_t: observation before the step, `[..., obs_dim]`.
      action_t: the action that was executed (after noise), `[..., action_dim]`; None throughout
        demonstrations of states alone.
      next_obs_t: the true observation after the step, never that of a reset, `[..., obs_dim]`.
      reward_t: the environment's own reward, `[...]`.
      discount_t: 0 where the task terminated, 1 elsewhere (also at the time limit), `[...]`.
      noise_level_t: probability with which the action was replaced by a uniform one, `[...]`.
    """

    obs_t: jax.Array
    action_t: jax.Array | None
    next_obs_t: jax.Array
    reward_t: jax.Array
    discount_t: jax.Array
    noise_level_t: jax.Array


class RewardFn(Protocol):
    """A reward as a pure function of its parameters and of what a transition stores."""

    def __call__(
        self, params: Params, obs_t: jax.Array, action_t: jax.Array, next_obs_t: jax.Array
    ) -> jax.Array:
        """Returns the reward of each row, `[...]`."""


class PolicyFn(Protocol):
    """A policy as a pure function of its parameters."""

    def __call__(self, params: Params, obs_t: jax.Array, key: jax.Array) -> jax.Array:
        """Returns an action in [-1, 1] for each row, `[..., action_dim]`."""


class RecurrentPolicyFn(Protocol):
    """A policy with a hidden state as a pure function of its parameters."""

    def __call__(
        self, params: Params, carry: Carry, obs_t: jax.Array, key: jax.Array
    ) -> tuple[Carry, jax.Array]:
        """Returns the next hidden states and an action in [-1, 1] for each row.

        Args:
          params: parameters.
          carry: hidden state of each row, leaves `[num_rows, ...]`.
          obs_t: observations, `[num_rows, obs_dim]`.
          key: PRNG key.
        """
