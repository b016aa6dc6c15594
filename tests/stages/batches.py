"""Trajectories by hand."""

import jax.numpy as jnp
import numpy as np

from represent_jax.data.trajectories import TrajectoryBatch


def make(obs, lengths=None):
    """Makes a batch of trajectories through `obs`, `[num, steps + 1, dim]`."""
    num, steps_plus_one, _ = obs.shape
    horizon = steps_plus_one - 1
    lengths = np.full(num, horizon) if lengths is None else np.asarray(lengths)
    return TrajectoryBatch(
        obs=jnp.asarray(obs, jnp.float32),
        actions=jnp.zeros((num, horizon, 1)),
        rewards=jnp.zeros((num, horizon)),
        mask=jnp.asarray(np.arange(horizon) < lengths[:, None], jnp.float32),
        strategy=jnp.zeros(num, jnp.int32),
        noise_level=jnp.zeros(num),
    )
