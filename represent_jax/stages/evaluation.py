"""How returns of the same trajectories agree: learned with true, one reward's with another's."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Correlation(NamedTuple):
    """Agreement of learned with true returns.

    Attributes:
      pearson: linear correlation, `[]`.
      spearman: rank correlation, `[]`.
    """

    pearson: jax.Array
    spearman: jax.Array


def correlate(true_returns: jax.Array, learned_returns: jax.Array) -> Correlation:
    """Correlates returns of the same trajectories, both `[num_trajectories]`.

    NaN where either side is constant or fewer than two trajectories are given.
    """
    return Correlation(
        pearson(true_returns, learned_returns),
        pearson(_ranks(true_returns), _ranks(learned_returns)),
    )


def pearson(a: jax.Array, b: jax.Array) -> jax.Array:
    """Pearson's correlation of two vectors, `[]`."""
    a, b = a - jnp.mean(a), b - jnp.mean(b)
    return jnp.sum(a * b) / jnp.sqrt(jnp.sum(a * a) * jnp.sum(b * b))


def slope(a: jax.Array, b: jax.Array) -> jax.Array:
    """By how much `b` rises for one unit of `a`, by least squares, `[]`; both `[num]`.

    NaN where `a` is constant.
    """
    a = a - jnp.mean(a)
    return jnp.sum(a * b) / jnp.sum(a * a)


def _ranks(values: jax.Array) -> jax.Array:
    """Ranks from 0, ties sharing their mean rank."""
    below = jnp.sum(values[:, None] > values[None, :], axis=1)
    equal = jnp.sum(values[:, None] == values[None, :], axis=1)
    return below + 0.5 * (equal - 1)
