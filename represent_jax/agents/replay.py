"""A ring buffer of transitions as a pytree and three pure functions.

Brax's queue keeps its insert position with the data and rolls the whole buffer when it is full;
here the position is apart, so that a population vmapped over `data` shares one position and an
insert stays a slice update.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from represent_jax.types import Transition


class ReplayBuffer(NamedTuple):
    """Stored transitions, one flat row each.

    Attributes:
      data: `[capacity, row_size]`.
      inserted: rows ever inserted, `[]` int32; row `inserted % capacity` is written next.
    """

    data: jax.Array
    inserted: jax.Array


def init(capacity: int, obs_dim: int, action_dim: int) -> ReplayBuffer:
    """Makes an empty buffer."""
    row_size = 2 * obs_dim + action_dim + 3
    return ReplayBuffer(jnp.zeros((capacity, row_size)), jnp.zeros((), jnp.int32))


def insert(buffer: ReplayBuffer, transitions: Transition) -> ReplayBuffer:
    """Writes a batch over the oldest rows.

    Raises:
      ValueError: the capacity is not a multiple of the batch size.
    """
    rows = _flatten(transitions)
    capacity, batch_size = buffer.data.shape[0], rows.shape[0]
    if capacity % batch_size:
        raise ValueError(f"capacity {capacity} is not a multiple of the batch size {batch_size}")
    position = buffer.inserted % capacity
    data = jax.lax.dynamic_update_slice_in_dim(buffer.data, rows, position, axis=0)
    return ReplayBuffer(data, buffer.inserted + batch_size)


def sample(
    buffer: ReplayBuffer, key: jax.Array, shape: tuple[int, ...], obs_dim: int, action_dim: int
) -> Transition:
    """Draws transitions uniformly with replacement, with leading axes `shape`."""
    size = jnp.minimum(buffer.inserted, buffer.data.shape[0])
    index = jax.random.randint(key, shape, 0, size)
    return _unflatten(buffer.data[index], obs_dim, action_dim)


def _flatten(t: Transition) -> jax.Array:
    scalars = jnp.stack([t.reward_t, t.discount_t, t.noise_level_t], axis=-1)
    return jnp.concatenate([t.obs_t, t.action_t, t.next_obs_t, scalars], axis=-1)


def _unflatten(rows: jax.Array, obs_dim: int, action_dim: int) -> Transition:
    cuts = (obs_dim, obs_dim + action_dim, 2 * obs_dim + action_dim)
    obs_t, action_t, next_obs_t, scalars = jnp.split(rows, cuts, axis=-1)
    reward_t, discount_t, noise_level_t = jnp.moveaxis(scalars, -1, 0)
    return Transition(obs_t, action_t, next_obs_t, reward_t, discount_t, noise_level_t)
