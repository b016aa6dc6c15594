"""The rewards of Eq. 1, R^i = R^0 + alpha_i R~^i: what they are made of, see and pay.

They are fitted in `stages.regression`. Where they were not fitted they are an extrapolation, which
agents follow; `bound` says where that ends.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from represent_jax.config import require_entries
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.stages.mlp import Mlp
from represent_jax.stages.regression_config import RegressionConfig
from represent_jax.types import Params


class Bounds(NamedTuple):
    """What of an input rewards see: nothing below `low` and nothing above `high`, `[input_dim]`."""

    low: jax.Array
    high: jax.Array


class TaskRange(NamedTuple):
    """Where R^0 is as fitted; beyond, it is what it is at the edge, less what it falls.

    Attributes:
      low, high: of what R^0 sees, in the demonstrations, `[task_input_dim]`.
      slope: what it loses for a unit of distance from there, `[]`: `most` over the largest width.
      most: the most that it loses, `[]`: what it differs by between demonstrated states.
    """

    low: jax.Array
    high: jax.Array
    slope: jax.Array
    most: jax.Array


class Rewards(NamedTuple):
    """Parameters of all rewards.

    Attributes:
      task: R^0, leaves `[ensemble, ...]`.
      strategies: R~^1 to R~^M, leaves `[ensemble, num_strategies, ...]`.
      bounds: of their inputs; None without, and while they are fitted, since within the data they
        change next to nothing.
      task_range, own_bounds: of R^0, and of every R~^i `[num_strategies, input_dim]`; None without,
        and while they are fitted.
    """

    task: Params
    strategies: Params
    bounds: Bounds | None = None
    task_range: TaskRange | None = None
    own_bounds: Bounds | None = None


class View(NamedTuple):
    """One reward of all, of the same shape for R^0 and every R^i.

    Attributes:
      task, own: parameters of R^0 and of one R~^i, leaves `[ensemble, ...]`.
      strategy_weight: 0 for R^0, alpha_i for R^i, `[]`.
      bounds: of the inputs.
      task_range, own_bounds: of R^0 and of the R~^i.
    """

    task: Params
    own: Params
    strategy_weight: jax.Array
    bounds: Bounds | None = None
    task_range: TaskRange | None = None
    own_bounds: Bounds | None = None


@functools.lru_cache
def network(config: RegressionConfig) -> Mlp:
    """The network of every head."""
    return Mlp(config.hidden_sizes, config.kernel_scale)


def check_entries(config: RegressionConfig, obs_dim: int) -> None:
    """Raises a UsageError where R^0 is to see entries that an observation does not have."""
    require_entries(config.task_entries, obs_dim, "task_entries")


def draw(
    key_task: jax.Array,
    key_strategies: jax.Array,
    obs_dim: int,
    action_dim: int,
    num_strategies: int,
    config: RegressionConfig,
) -> Rewards:
    """Draws all heads of all ensemble members.

    Raises:
      UsageError: R^0 is to see entries that an observation does not have.
    """
    check_entries(config, obs_dim)
    input_dim = _input_dim(obs_dim, action_dim, config)

    def head(key, input_dim):
        return network(config).init(key, jnp.zeros(input_dim))

    keys = jax.random.split(key_task, config.ensemble_size)
    task = jax.vmap(lambda key: head(key, len(config.task_entries) or input_dim))(keys)
    keys = jax.random.split(key_strategies, (config.ensemble_size, num_strategies))
    strategies = jax.vmap(jax.vmap(lambda key: head(key, input_dim)))(keys)
    return Rewards(task, strategies)


def example(
    obs_dim: int, action_dim: int, num_strategies: int, config: RegressionConfig
) -> Rewards:
    """The shapes of what `bound` returns, for a checkpoint to be read into."""
    sizes = (obs_dim, action_dim, num_strategies)
    key = jax.random.PRNGKey(0)
    rewards = jax.eval_shape(lambda key: draw(key, key, *sizes, config), key)
    input_dim = _input_dim(obs_dim, action_dim, config)
    if config.input_quantile is not None:
        edge = jax.ShapeDtypeStruct((input_dim,), jnp.float32)
        rewards = rewards._replace(bounds=Bounds(edge, edge))
    if config.within_demonstrations:
        edge = jax.ShapeDtypeStruct((len(config.task_entries) or input_dim,), jnp.float32)
        number = jax.ShapeDtypeStruct((), jnp.float32)
        edges = jax.ShapeDtypeStruct((num_strategies, input_dim), jnp.float32)
        rewards = rewards._replace(
            task_range=TaskRange(edge, edge, number, number), own_bounds=Bounds(edges, edges)
        )
    return rewards


def bound(
    rewards: Rewards,
    noisy: TrajectoryBatch,
    demonstrations: TrajectoryBatch,
    config: RegressionConfig,
) -> Rewards:
    """Gives fitted rewards the bounds of their inputs, where there are to be any.

    Args:
      rewards: as fitted.
      noisy, demonstrations: what they were fitted on, `[num_strategies, num_trajectories]`.
      config: settings.
    """
    if config.input_quantile is not None:
        levels = jnp.array([1.0 - config.input_quantile, config.input_quantile])
        edges = jnp.nanquantile(_rows_of(noisy, config), levels, axis=0)
        rewards = rewards._replace(bounds=Bounds(*edges))
    if config.within_demonstrations:
        rows = jax.vmap(lambda batch: _rows_of(batch, config))(demonstrations)
        rewards = rewards._replace(
            task_range=_task_range(rewards, rows, config),
            own_bounds=Bounds(jnp.nanmin(rows, axis=1), jnp.nanmax(rows, axis=1)),
        )
    return rewards


def _rows_of(batch: TrajectoryBatch, config: RegressionConfig) -> jax.Array:
    """Inputs of all steps, `[rows, input_dim]`; NaN where an episode was over."""
    inputs = inputs_of(batch.obs[..., :-1, :], batch.actions, batch.obs[..., 1:, :], config)
    return jnp.where(batch.mask[..., None] > 0, inputs, jnp.nan).reshape(-1, inputs.shape[-1])


def _task_range(rewards: Rewards, rows: jax.Array, config: RegressionConfig) -> TaskRange:
    """Where demonstrations, `[num_strategies, rows, input_dim]`, left what R^0 sees."""
    rows = task_inputs_of(rows.reshape(-1, rows.shape[-1]), config)
    earned = head_reward(rewards.task, rows, config)
    most = jnp.nanmax(earned) - jnp.nanmin(earned)
    low, high = jnp.nanmin(rows, axis=0), jnp.nanmax(rows, axis=0)
    width = jnp.max(high - low)
    # What no demonstration changes says nothing of where the task ends.
    slope = jnp.where(width > 0.0, most / jnp.where(width > 0.0, width, 1.0), 0.0)
    return TaskRange(low, high, slope, most)


def inputs_of(
    obs_t: jax.Array, action_t: jax.Array | None, next_obs_t: jax.Array, config: RegressionConfig
) -> jax.Array:
    """What a R~^i sees: the state that the action led to, and on request what came before."""
    if not config.include_action:
        return next_obs_t
    return jnp.concatenate([next_obs_t, obs_t, action_t], axis=-1)


def task_inputs_of(inputs: jax.Array, config: RegressionConfig) -> jax.Array:
    """What R^0 sees of it, `[..., task_input_dim]`."""
    return inputs[..., config.task_entries] if config.task_entries else inputs


def view(rewards: Rewards, strategy: int | None, config: RegressionConfig) -> View:
    """Picks R^0 (`strategy=None`) or R^i (counted from 0)."""
    i = strategy or 0
    own = jax.tree.map(lambda leaf: leaf[:, i], rewards.strategies)
    own_bounds = jax.tree.map(lambda leaf: leaf[i], rewards.own_bounds)
    weight = jnp.float32(0.0 if strategy is None else config.strategy_weight)
    return View(rewards.task, own, weight, rewards.bounds, rewards.task_range, own_bounds)


def view_reward(
    view: View,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: RegressionConfig,
) -> jax.Array:
    """R^0 or R^i, `[...]`."""
    inputs = inputs_of(obs_t, action_t, next_obs_t, config)
    seen = inputs if view.bounds is None else jnp.clip(inputs, *view.bounds)
    task = _task_reward(view, inputs, seen, config)
    own_inputs = seen if view.own_bounds is None else jnp.clip(seen, *view.own_bounds)
    return task + view.strategy_weight * head_reward(view.own, own_inputs, config)


def _task_reward(
    view: View, inputs: jax.Array, seen: jax.Array, config: RegressionConfig
) -> jax.Array:
    """R^0 of inputs of which this much is seen, or of all within its range, where it has one."""
    if view.task_range is None:
        return head_reward(view.task, task_inputs_of(seen, config), config)
    low, high, slope, most = view.task_range
    # Demonstrations may go where noisy rollouts seldom do: to the end of the task.
    inputs = task_inputs_of(inputs, config)
    within = jnp.clip(inputs, low, high)
    distance = jnp.linalg.norm(inputs - within, axis=-1)
    return head_reward(view.task, within, config) - jnp.minimum(slope * distance, most)


def reward(
    rewards: Rewards,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: RegressionConfig,
    strategy: int | None = None,
) -> jax.Array:
    """R^0, or R^i = R^0 + alpha_i R~^i (Eq. 1) of one strategy counted from 0, `[...]`."""
    one = view(rewards, strategy, config)
    return view_reward(one, obs_t, action_t, next_obs_t, config)


def head_reward(head: Params, inputs: jax.Array, config: RegressionConfig) -> jax.Array:
    """Reward of one head, R^0 or R~^i: the mean over its ensemble `[ensemble, ...]`, `[...]`.

    Args:
      head: parameters.
      inputs: of `inputs_of`, for R^0 of `task_inputs_of`.
      config: settings.
    """
    return jnp.mean(jax.vmap(network(config).apply, in_axes=(0, None))(head, inputs), axis=0)


def _input_dim(obs_dim: int, action_dim: int, config: RegressionConfig) -> int:
    return obs_dim + (obs_dim + action_dim if config.include_action else 0)
