"""The multi-layer perceptron of rewards and clones, with the initial kernels of their releases."""

import jax
import jax.numpy as jnp
from flax import linen

from represent_jax.types import Params


class Mlp(linen.Module):
    """ReLU layers and a linear output.

    Attributes:
      hidden_sizes: units of the hidden layers.
      kernel_scale: standard deviation of initial kernels.
      num_outputs: size of the output; None drops its axis.
    """

    hidden_sizes: tuple[int, ...]
    kernel_scale: float
    num_outputs: int | None = None

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        kernel_init = jax.nn.initializers.normal(self.kernel_scale)
        for size in self.hidden_sizes:
            x = linen.relu(linen.Dense(size, kernel_init=kernel_init)(x))
        x = linen.Dense(self.num_outputs or 1, kernel_init=kernel_init)(x)
        return x[..., 0] if self.num_outputs is None else x


def squared_kernels(params: Params) -> jax.Array:
    """Sum of all squared kernels, biases left out, `[]`."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return sum(jnp.sum(jnp.square(leaf)) for path, leaf in leaves if path[-1].key == "kernel")
