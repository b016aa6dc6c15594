"""Phase 3: joint regression of the task reward and every strategy's own.

REPRESENT's Eq. 1, R^i = R^0 + alpha_i R~^i, is fitted with the three terms of Eq. 2:

  SSRR   snippets of noisy rollouts sum to their share of the noise-performance curve (Eq. 3);
  reg    R~^i stays small, on the states of all strategies (Eq. 4);
  BCD    R^i pays more on strategy i's demonstrations than on the others' (Eq. 5).

Rewards of one step are small: a whole noise-free episode is worth `return_scale`. Where a term
needs a scale-free quantity it uses rho = r * horizon / return_scale, whose mean over such an
episode is 1.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.stages.decomposition import (
    Rewards,
    bound,
    draw,
    inputs_of,
    network,
    task_inputs_of,
)
from represent_jax.stages.mlp import squared_kernels
from represent_jax.stages.regression_config import Discrimination, RegressionConfig
from represent_jax.types import Metrics

# Adam moves every parameter by about its step size; a unit has to get farther than a weight.
_UNIT_SPEED = 10.0


class RegressionData(NamedTuple):
    """What Phase 3 learns from; leading axis `[num_strategies]` throughout.

    Attributes:
      noisy: noisy rollouts, `[num_strategies, num_trajectories]`.
      targets: curve value of each rollout's noise level, `[num_strategies, num_trajectories]`.
      demonstrations: padded demonstrations, `[num_strategies, num_demonstrations]`.
    """

    noisy: TrajectoryBatch
    targets: jax.Array
    demonstrations: TrajectoryBatch


@struct.dataclass
class RegressionState:
    """Training state.

    Attributes:
      rewards: parameters.
      log_units: of the curves, `[ensemble, num_strategies]`, see `units_of`; None where they are 1.
      opt: the optimiser's.
      key: PRNG key.
    """

    rewards: Rewards
    log_units: jax.Array | None
    opt: optax.OptState
    key: jax.Array


class Snippets(NamedTuple):
    """Sampled states of snippets and what the snippets are worth.

    Attributes:
      inputs: `[..., num_snippets, states_per_snippet, input_dim]`.
      share: the snippet's length over the horizon, `[..., num_snippets]`.
      target: curve value, `[..., num_snippets]`.
    """

    inputs: jax.Array
    share: jax.Array
    target: jax.Array


@functools.lru_cache
def _optimizer(config: RegressionConfig) -> optax.GradientTransformation:
    return optax.adam(config.learning_rate)


def init(
    key: jax.Array, obs_dim: int, action_dim: int, num_strategies: int, config: RegressionConfig
) -> RegressionState:
    """Draws all heads of all ensemble members.

    Raises:
      UsageError: R^0 is to see entries that an observation does not have.
    """
    key_task, key_strategies, key = jax.random.split(key, 3)
    rewards = draw(key_task, key_strategies, obs_dim, action_dim, num_strategies, config)
    shape = (config.ensemble_size, num_strategies)
    log_units = jnp.zeros(shape) if config.learn_units else None
    return RegressionState(rewards, log_units, _optimizer(config).init((rewards, log_units)), key)


def finish(state: RegressionState, data: RegressionData, config: RegressionConfig) -> Rewards:
    """Reads the rewards, bounded where they are to be."""
    return bound(state.rewards, data.noisy, data.demonstrations, config)


def sample_snippets(
    key: jax.Array, trajectories: TrajectoryBatch, targets: jax.Array, config: RegressionConfig
) -> Snippets:
    """Draws snippets of one strategy and some states of each.

    Start and length are uniform; a snippet never leaves the steps in which its episode ran, and
    its share of the curve's value is its length over the nominal horizon, so that in a domain
    that terminates a longer life is worth more.

    Args:
      key: PRNG key.
      trajectories: `[num_trajectories]`.
      targets: curve values, `[num_trajectories]`.
      config: settings.
    """
    key_index, key_length, key_start, key_states = jax.random.split(key, 4)
    num_trajectories, horizon = trajectories.mask.shape
    shape = (config.num_snippets,)
    index = jax.random.randint(key_index, shape, 0, num_trajectories)
    alive = jnp.sum(trajectories.mask[index], axis=-1).astype(jnp.int32)
    longest = min(config.max_snippet_steps, horizon)
    shortest = min(config.min_snippet_steps, longest)
    length = jnp.minimum(jax.random.randint(key_length, shape, shortest, longest + 1), alive)
    start = jnp.floor(jax.random.uniform(key_start, shape) * (alive - length + 1)).astype(jnp.int32)
    offset = jax.random.uniform(key_states, (*shape, config.states_per_snippet))
    steps = start[:, None] + jnp.floor(offset * length[:, None]).astype(jnp.int32)
    index = index[:, None]
    inputs = inputs_of(
        trajectories.obs[index, steps],
        trajectories.actions[index, steps],
        trajectories.obs[index, steps + 1],
        config,
    )
    return Snippets(inputs, length / horizon, targets[index[:, 0]])


def units_of(log_units: jax.Array) -> jax.Array:
    """What a curve value of 1 is worth, `[..., num_strategies]`: positive, of geometric mean 1."""
    log_units = _UNIT_SPEED * log_units
    return jnp.exp(log_units - jnp.mean(log_units, axis=-1, keepdims=True))


def ssrr_loss(rho: jax.Array, snippets: Snippets, return_scale: float) -> jax.Array:
    """Eq. 3 on snippets: (sum_t R(s_t) - S sigma L / T)^2, estimated without bias.

    The square of a mean over sampled states would carry their variance; the product of the
    errors of two independent halves does not.

    Args:
      rho: rewards of the sampled states in units of S / T, `[num_snippets, states]`.
      snippets: shares and targets.
      return_scale: S.
    """
    first, second = jnp.split(rho, 2, axis=-1)
    scale = return_scale * snippets.share
    error_first = scale * (jnp.mean(first, axis=-1) - snippets.target)
    error_second = scale * (jnp.mean(second, axis=-1) - snippets.target)
    return jnp.mean(error_first * error_second)


def discrimination_loss(utility: jax.Array, config: RegressionConfig) -> jax.Array:
    """Eq. 5, summed over all ordered pairs of strategies.

    Args:
      utility: u_i(m), mean rho^i over strategy m's demonstrations, `[num_strategies (i), (m)]`.
      config: the reading and its ratio.
    """
    num_strategies = utility.shape[0]
    utility = jnp.clip(utility, -5.0, 5.0)
    own = jnp.diagonal(utility)[:, None]
    ratio = config.discrimination_ratio
    if config.discrimination == Discrimination.LOG_RATIO:
        gap = utility - jax.lax.stop_gradient(own) - jnp.log(ratio)
    elif config.discrimination == Discrimination.FLAIR:
        gap = jnp.exp(utility) - ratio * jnp.exp(jax.lax.stop_gradient(own))
    else:
        gap = jnp.exp(own) - jnp.exp(utility)
    return jnp.sum(jnp.square(gap) * (1.0 - jnp.eye(num_strategies)))


def loss(
    rewards: Rewards,
    log_units: jax.Array | None,
    snippets: Snippets,
    demonstration_inputs: jax.Array,
    horizon: int,
    config: RegressionConfig,
) -> tuple[jax.Array, Metrics]:
    """Eq. 2 of one ensemble member.

    Args:
      rewards: without the ensemble axis.
      log_units: of the curves, `[num_strategies]`; None where they are 1.
      snippets: `[num_strategies, ...]`.
      demonstration_inputs: states of demonstrations, `[num_strategies, states, input_dim]`.
      horizon: T.
      config: settings.
    """
    head = network(config)
    num_strategies, num_states, input_dim = demonstration_inputs.shape
    unit = horizon / config.return_scale
    rho_task = unit * head.apply(rewards.task, task_inputs_of(snippets.inputs, config))
    rho_own = unit * jax.vmap(head.apply)(rewards.strategies, snippets.inputs)
    alpha = config.strategy_weight
    units = jnp.ones(num_strategies) if log_units is None else units_of(log_units)
    # In its own unit, so that no strategy's errors get small by its unit getting so.
    rho = (rho_task + alpha * rho_own) / units[:, None, None]
    ssrr = jax.vmap(ssrr_loss, in_axes=(0, 0, None))(rho, snippets, config.return_scale)
    # Every strategy's head on every strategy's demonstrations, [i, m, states].
    flat = demonstration_inputs.reshape(-1, input_dim)
    rho_cross = unit * jax.vmap(head.apply, in_axes=(0, None))(rewards.strategies, flat)
    rho_cross = rho_cross.reshape(num_strategies, num_strategies, num_states)
    task_inputs = task_inputs_of(demonstration_inputs, config)
    rho_task_demo = unit * jax.lax.stop_gradient(head.apply(rewards.task, task_inputs))
    utility = jnp.mean(rho_task_demo[None] + alpha * rho_cross, axis=-1)
    reg = jnp.sum(jnp.mean(jnp.square(rho_own), axis=(1, 2)))
    reg += jnp.sum(jnp.mean(jnp.square(rho_cross), axis=(1, 2)))
    bcd = discrimination_loss(utility, config)
    l2 = config.l2 * squared_kernels(rewards.task)
    l2 += config.strategy_l2 * squared_kernels(rewards.strategies)
    total = (
        config.lambda_ssrr * jnp.sum(ssrr) + config.lambda_reg * reg + config.lambda_bcd * bcd + l2
    )
    own = jnp.diagonal(jnp.mean(rho_cross, axis=-1))
    others = jnp.sum(jnp.mean(rho_cross, axis=-1)) - jnp.sum(own)
    metrics = {
        "loss": total,
        "ssrr_loss": jnp.mean(ssrr),
        "reg_loss": reg,
        "bcd_loss": bcd,
        "l2_loss": l2,
        "strategy_reward_own": jnp.mean(own),
        "strategy_reward_others": others / jnp.maximum(num_strategies * (num_strategies - 1), 1),
    }
    if log_units is not None:
        metrics |= {f"unit_{i + 1}": units[i] for i in range(num_strategies)}
    return total, metrics


def _sample_states(key: jax.Array, batch: TrajectoryBatch, config: RegressionConfig) -> jax.Array:
    """Draws states in which episodes of one strategy ran, `[num_demonstration_states, dim]`."""
    weights = batch.mask.reshape(-1)
    shape = (config.num_demonstration_states,)
    # Inverse transform: exact and cheap, where `choice` would sort.
    cumulative = jnp.cumsum(weights)
    draw = jax.random.uniform(key, shape) * cumulative[-1]
    flat = jnp.searchsorted(cumulative, draw, side="right")
    index, step = jnp.divmod(jnp.minimum(flat, weights.size - 1), batch.mask.shape[1])
    action_t = None if batch.actions is None else batch.actions[index, step]
    return inputs_of(batch.obs[index, step], action_t, batch.obs[index, step + 1], config)


def step(
    state: RegressionState, data: RegressionData, config: RegressionConfig
) -> tuple[RegressionState, Metrics]:
    """Makes one Adam step on every ensemble member, each with snippets of its own."""
    key_members, key = jax.random.split(state.key)
    num_strategies, _, horizon = data.noisy.mask.shape

    def member_loss(learned, key):
        key_snippets, key_states = jax.random.split(key)
        snippets = jax.vmap(sample_snippets, in_axes=(0, 0, 0, None))(
            jax.random.split(key_snippets, num_strategies), data.noisy, data.targets, config
        )
        states = jax.vmap(_sample_states, in_axes=(0, 0, None))(
            jax.random.split(key_states, num_strategies), data.demonstrations, config
        )
        return loss(*learned, snippets, states, horizon, config)

    keys = jax.random.split(key_members, config.ensemble_size)
    learned = (state.rewards, state.log_units)
    grads, metrics = jax.vmap(jax.grad(member_loss, has_aux=True))(learned, keys)
    updates, opt = _optimizer(config).update(grads, state.opt)
    learned = optax.apply_updates(learned, updates)
    return RegressionState(*learned, opt, key), jax.tree.map(jnp.mean, metrics)


def train(
    state: RegressionState, data: RegressionData, config: RegressionConfig, num_updates: int
) -> tuple[RegressionState, Metrics]:
    """Scans `step`; metrics are averaged over the steps."""
    state, metrics = jax.lax.scan(
        lambda state, _: step(state, data, config), state, None, length=num_updates
    )
    return state, jax.tree.map(jnp.mean, metrics)
