"""Phase 3: joint regression of the task reward and every strategy's own.

REPRESENT's Eq. 1, R^i = R^0 + alpha_i R~^i, is fitted with the three terms of Eq. 2:

  SSRR   snippets of noisy rollouts sum to their share of the noise-performance curve (Eq. 3);
  reg    R~^i stays small, on the states of all strategies (Eq. 4);
  BCD    R^i pays more on strategy i's demonstrations than on the others' (Eq. 5).

Rewards of one step are small: a whole noise-free episode is worth `return_scale`. Where a term
needs a scale-free quantity it uses rho = r * horizon / return_scale, whose mean over such an
episode is 1.
"""

import dataclasses
import enum
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from represent_jax.config import later, require
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.stages.mlp import Mlp, squared_kernels
from represent_jax.types import Metrics, Params

# Adam moves every parameter by about its step size; a unit has to get farther than a weight.
_UNIT_SPEED = 10.0


class Discrimination(enum.StrEnum):
    """How Eq. 5 is read; u_i(m) is the mean of rho^i over a demonstration of strategy m.

    LOG_RATIO: (u_i(m) - sg u_i(i) - log w)^2, Eq. 5 in the exponent: a bounded target.
    FLAIR: (exp u_i(m) - w exp sg u_i(i))^2, the loss of FLAIR's code with target ratio w.
    LITERAL: (exp u_i(i) - exp u_i(m))^2, Eq. 5 as printed; it makes strategies equal.
    """

    LOG_RATIO = "log_ratio"
    FLAIR = "flair"
    LITERAL = "literal"


@dataclasses.dataclass(frozen=True)
class RegressionConfig:
    """Settings of Phase 3.

    Attributes:
      num_updates: Adam steps.
      num_snippets: snippets of each strategy in a step.
      states_per_snippet: states drawn from a snippet to estimate its sum; even.
      num_demonstration_states: states of each strategy's demonstrations in a step.
      min_snippet_steps, max_snippet_steps: range of a snippet's length.
      hidden_sizes: units of the hidden layers of every head.
      learning_rate: Adam's step size.
      kernel_scale: standard deviation of initial kernels (SSRR: 0.001).
      l2: weight of R^0's squared kernels (SSRR: 0.1).
      strategy_l2: weight of those of every R~^i, which Eq. 4 keeps small already.
      ensemble_size: independent copies, whose mean is the reward.
      return_scale: learned return of a whole episode whose curve value is 1 (SSRR: 10).
      strategy_weight: alpha_i of Eq. 1, for all strategies.
      lambda_ssrr, lambda_reg, lambda_bcd: weights of Eq. 2's terms.
      discrimination: reading of Eq. 5.
      discrimination_ratio: w, target of exp u_i(m) / exp u_i(i).
      include_action: whether rewards see state and action as well as the next state.
      task_entries: entries of the next observation that R^0 sees, such as the objects that a task
        is about; everything that a R~^i sees if empty.
      input_quantile: rewards see no input beyond this quantile of the noisy rollouts, nor below
        its counterpart: what lies outside counts as being at the edge, so that nothing is paid for
        going on where nobody has been. Not bounded if none.
      task_within_demonstrations: whether R^0 sees nothing beyond what was demonstrated, and falls
        there as steeply as it rises within. More was better in all that was rolled out; only
        demonstrations tell where to stop.
      learn_units: whether each strategy's curve has a unit of its own, learned with the rewards.
        Scaled to [0, 1] by themselves, curves say that all strategies are equally good without
        noise; R^0, which sees them all, then has to call the better one's rollouts too bad.
    """

    num_updates: int = 3000
    num_snippets: int = 64
    states_per_snippet: int = 16
    num_demonstration_states: int = 256
    min_snippet_steps: int = 50
    max_snippet_steps: int = 500
    hidden_sizes: tuple[int, ...] = (128, 128)
    learning_rate: float = 1e-4
    kernel_scale: float = 1e-3
    l2: float = 0.1
    strategy_l2: float = 0.01
    ensemble_size: int = 3
    return_scale: float = 10.0
    strategy_weight: float = 1.0
    lambda_ssrr: float = 1.0
    lambda_reg: float = 0.1
    lambda_bcd: float = 0.01
    discrimination: str = "log_ratio"
    discrimination_ratio: float = 0.7
    include_action: bool = False
    task_entries: tuple[int, ...] = later(())
    input_quantile: float | None = later(None)
    task_within_demonstrations: bool = later(False)
    learn_units: bool = later(True, before=False)

    def __post_init__(self) -> None:
        for field in ("num_updates", "num_snippets", "ensemble_size", "min_snippet_steps"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        require(
            self.states_per_snippet >= 2 and self.states_per_snippet % 2 == 0,
            "states_per_snippet",
            "even and at least 2",
            self.states_per_snippet,
        )
        require(
            self.max_snippet_steps >= self.min_snippet_steps,
            "max_snippet_steps",
            f"at least min_snippet_steps ({self.min_snippet_steps})",
            self.max_snippet_steps,
        )
        readings = tuple(Discrimination)
        require(
            self.discrimination in readings,
            "discrimination",
            f"one of {', '.join(readings)}",
            self.discrimination,
        )
        require(
            0.0 < self.discrimination_ratio <= 1.0,
            "discrimination_ratio",
            "in (0, 1]",
            self.discrimination_ratio,
        )
        require(
            all(entry >= 0 for entry in self.task_entries),
            "task_entries",
            "indices from 0",
            self.task_entries,
        )
        if self.input_quantile is not None:
            require(
                0.5 < self.input_quantile <= 1.0,
                "input_quantile",
                "in (0.5, 1], or none",
                self.input_quantile,
            )


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
      task_range: of R^0; None without, and while they are fitted.
    """

    task: Params
    strategies: Params
    bounds: Bounds | None = None
    task_range: TaskRange | None = None


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
def _head(config: RegressionConfig) -> Mlp:
    return Mlp(config.hidden_sizes, config.kernel_scale)


@functools.lru_cache
def _optimizer(config: RegressionConfig) -> optax.GradientTransformation:
    return optax.adam(config.learning_rate)


def _input_dim(obs_dim: int, action_dim: int, config: RegressionConfig) -> int:
    return obs_dim + (obs_dim + action_dim if config.include_action else 0)


def check_entries(config: RegressionConfig, obs_dim: int) -> None:
    """Raises a UsageError where R^0 is to see entries that an observation does not have."""
    require(
        all(entry < obs_dim for entry in config.task_entries),
        "task_entries",
        f"indices of an observation of size {obs_dim}",
        config.task_entries,
    )


def init(
    key: jax.Array, obs_dim: int, action_dim: int, num_strategies: int, config: RegressionConfig
) -> RegressionState:
    """Draws all heads of all ensemble members.

    Raises:
      UsageError: R^0 is to see entries that an observation does not have.
    """
    check_entries(config, obs_dim)
    key_task, key_strategies, key = jax.random.split(key, 3)
    input_dim = _input_dim(obs_dim, action_dim, config)
    head = _head(config)

    def draw(key, input_dim):
        return head.init(key, jnp.zeros(input_dim))

    shape = (config.ensemble_size, num_strategies)
    keys = jax.random.split(key_task, config.ensemble_size)
    task = jax.vmap(lambda key: draw(key, len(config.task_entries) or input_dim))(keys)
    keys = jax.random.split(key_strategies, shape)
    strategies = jax.vmap(jax.vmap(lambda key: draw(key, input_dim)))(keys)
    rewards = Rewards(task, strategies)
    log_units = jnp.zeros(shape) if config.learn_units else None
    return RegressionState(rewards, log_units, _optimizer(config).init((rewards, log_units)), key)


def finish(state: RegressionState, data: RegressionData, config: RegressionConfig) -> Rewards:
    """Reads the rewards, with the bounds of their inputs and R^0's range where there are to be."""
    rewards = state.rewards
    if config.input_quantile is not None:
        levels = jnp.array([1.0 - config.input_quantile, config.input_quantile])
        edges = jnp.nanquantile(_rows_of(data.noisy, config), levels, axis=0)
        rewards = rewards._replace(bounds=Bounds(*edges))
    if config.task_within_demonstrations:
        rewards = rewards._replace(task_range=_task_range(rewards, data, config))
    return rewards


def _rows_of(batch: TrajectoryBatch, config: RegressionConfig) -> jax.Array:
    """Inputs of all steps, `[rows, input_dim]`; NaN where an episode was over."""
    inputs = inputs_of(batch.obs[..., :-1, :], batch.actions, batch.obs[..., 1:, :], config)
    return jnp.where(batch.mask[..., None] > 0, inputs, jnp.nan).reshape(-1, inputs.shape[-1])


def _task_range(rewards: Rewards, data: RegressionData, config: RegressionConfig) -> TaskRange:
    rows = _rows_of(data.demonstrations, config)
    seen = rows if rewards.bounds is None else jnp.clip(rows, *rewards.bounds)
    earned = head_reward(rewards.task, task_inputs_of(seen, config), config)
    most = jnp.nanmax(earned) - jnp.nanmin(earned)
    rows = task_inputs_of(rows, config)
    low, high = jnp.nanmin(rows, axis=0), jnp.nanmax(rows, axis=0)
    return TaskRange(low, high, most / jnp.max(high - low), most)


def example(
    obs_dim: int, action_dim: int, num_strategies: int, config: RegressionConfig
) -> Rewards:
    """The shapes of what `finish` returns, for a checkpoint to be read into."""
    sizes = (obs_dim, action_dim, num_strategies)
    key = jax.random.PRNGKey(0)
    rewards = jax.eval_shape(lambda key: init(key, *sizes, config), key).rewards
    input_dim = _input_dim(obs_dim, action_dim, config)
    if config.input_quantile is not None:
        edge = jax.ShapeDtypeStruct((input_dim,), jnp.float32)
        rewards = rewards._replace(bounds=Bounds(edge, edge))
    if config.task_within_demonstrations:
        edge = jax.ShapeDtypeStruct((len(config.task_entries) or input_dim,), jnp.float32)
        number = jax.ShapeDtypeStruct((), jnp.float32)
        rewards = rewards._replace(task_range=TaskRange(edge, edge, number, number))
    return rewards


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
    head = _head(config)
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


def head_reward(head: Params, inputs: jax.Array, config: RegressionConfig) -> jax.Array:
    """Reward of one head, R^0 or R~^i: the mean over its ensemble `[ensemble, ...]`, `[...]`.

    Args:
      head: parameters.
      inputs: of `inputs_of`, for R^0 of `task_inputs_of`.
      config: settings.
    """
    return jnp.mean(jax.vmap(_head(config).apply, in_axes=(0, None))(head, inputs), axis=0)


class View(NamedTuple):
    """One reward of all, of the same shape for R^0 and every R^i.

    Attributes:
      task, own: parameters of R^0 and of one R~^i, leaves `[ensemble, ...]`.
      strategy_weight: 0 for R^0, alpha_i for R^i, `[]`.
      bounds: of the inputs.
      task_range: of R^0.
    """

    task: Params
    own: Params
    strategy_weight: jax.Array
    bounds: Bounds | None = None
    task_range: TaskRange | None = None


def view(rewards: Rewards, strategy: int | None, config: RegressionConfig) -> View:
    """Picks R^0 (`strategy=None`) or R^i (counted from 0)."""
    own = jax.tree.map(lambda leaf: leaf[:, strategy or 0], rewards.strategies)
    weight = 0.0 if strategy is None else config.strategy_weight
    return View(rewards.task, own, jnp.float32(weight), rewards.bounds, rewards.task_range)


def view_reward(
    view: View,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: RegressionConfig,
) -> jax.Array:
    """R^0 or R^i, `[...]`."""
    inputs = inputs_of(obs_t, action_t, next_obs_t, config)
    reached = task_inputs_of(inputs, config)
    if view.bounds is not None:
        inputs = jnp.clip(inputs, *view.bounds)
    task_inputs = task_inputs_of(inputs, config)
    if view.task_range is None:
        task = head_reward(view.task, task_inputs, config)
    else:
        low, high, slope, most = view.task_range
        task = head_reward(view.task, jnp.clip(task_inputs, low, high), config)
        distance = jnp.linalg.norm(reached - jnp.clip(reached, low, high), axis=-1)
        task -= jnp.minimum(slope * distance, most)
    return task + view.strategy_weight * head_reward(view.own, inputs, config)


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
