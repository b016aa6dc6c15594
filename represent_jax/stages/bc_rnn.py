"""BC-RNN: behavioural cloning of sequences, a baseline.

Mandlekar et al., What Matters in Learning from Offline Human Demonstrations for Robot Manipulation
(2021), arXiv 2108.03298, at the defaults of its code, robomimic. An LSTM reads short sequences of
demonstrations, each from an empty hidden state, and predicts the action of every step; acting, it
forgets as often as it did in training. What differs from robomimic: observations are standardised
by mean and standard deviation of the demonstrations (an option there, off); sequences lie whole
within an episode where it is long enough, while robomimic also lets them begin near its end and
repeats the last step; initial parameters are Flax's, not PyTorch's; no layers stand behind the LSTM
(two of 1,024 there, `mlp_sizes` here); updates are fewer.
"""

import dataclasses
import enum
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen, struct

from represent_jax.config import require, require_sizes
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.types import Metrics, Params

# robomimic's numbers: added to the deviation of observations, least deviation of a mode in
# training, and the deviation with which a mode acts.
_SMALLEST_OBS_STD = 1e-3
_SMALLEST_MODE_STD = 1e-4
_ACTING_MODE_STD = 1e-4


class Head(enum.StrEnum):
    """What the network predicts and how it is scored.

    L2: the action, tanh-squashed; mean squared error.
    GMM: a mixture of diagonal Gaussians with tanh-squashed means; negative log-likelihood.
    """

    L2 = "l2"
    GMM = "gmm"


@dataclasses.dataclass(frozen=True)
class BcRnnConfig:
    """Settings of BC-RNN.

    Attributes:
      num_updates: Adam steps (robomimic: 200,000).
      batch_size: sequences in each.
      sequence_length: steps of a sequence.
      hidden_size: units of each LSTM layer.
      num_layers: LSTM layers.
      mlp_sizes: units of hidden layers between LSTM and output (robomimic: 1024, 1024).
      learning_rate: Adam's step size.
      head: "l2" or "gmm".
      num_modes: Gaussians of the mixture.
      reset_every: steps after which a rollout empties the hidden state; none stands for
        sequence_length, as robomimic has it, 0 for never.
    """

    num_updates: int = 20_000
    batch_size: int = 100
    sequence_length: int = 10
    hidden_size: int = 400
    num_layers: int = 2
    mlp_sizes: tuple[int, ...] = ()
    learning_rate: float = 1e-4
    head: str = "l2"
    num_modes: int = 5
    reset_every: int | None = None

    def __post_init__(self) -> None:
        for field in (
            "num_updates",
            "batch_size",
            "sequence_length",
            "hidden_size",
            "num_layers",
            "num_modes",
        ):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        require_sizes(self.mlp_sizes, "mlp_sizes")
        require(self.learning_rate > 0.0, "learning_rate", "> 0", self.learning_rate)
        heads = tuple(Head)
        require(self.head in heads, "head", f"one of {', '.join(heads)}", self.head)
        require(
            self.reset_every is None or self.reset_every >= 0,
            "reset_every",
            "none or >= 0",
            self.reset_every,
        )


class BcRnnParams(NamedTuple):
    """What acting needs.

    Attributes:
      obs_mean, obs_std: of the demonstrations' observations, `[obs_dim]`.
      network: the network's parameters.
    """

    obs_mean: jax.Array
    obs_std: jax.Array
    network: Params


@struct.dataclass
class BcRnnState:
    """Training state: parameters, optimiser and key."""

    params: BcRnnParams
    opt: optax.OptState
    key: jax.Array


class BcRnnCarry(NamedTuple):
    """What a rollout remembers.

    Attributes:
      lstm: cell and hidden state of every layer, each `[num_episodes, hidden_size]`.
      steps: steps since the episode began, int32 `[num_episodes]`.
    """

    lstm: tuple[tuple[jax.Array, jax.Array], ...]
    steps: jax.Array


class Sequences(NamedTuple):
    """Windows of demonstrations.

    Attributes:
      obs: `[batch_size, sequence_length, obs_dim]`.
      actions: `[batch_size, sequence_length, action_dim]`.
      mask: 1 while the episode runs, `[batch_size, sequence_length]`.
    """

    obs: jax.Array
    actions: jax.Array
    mask: jax.Array


class Mixture(NamedTuple):
    """A mixture of diagonal Gaussians over actions.

    Attributes:
      logits: unnormalised log weights, `[..., num_modes]`.
      mean, std: of each mode, `[..., num_modes, action_dim]`.
    """

    logits: jax.Array
    mean: jax.Array
    std: jax.Array


class _Network(linen.Module):
    hidden_size: int
    num_layers: int
    mlp_sizes: tuple[int, ...]
    output_size: int

    def setup(self) -> None:
        self.cells = [linen.OptimizedLSTMCell(self.hidden_size) for _ in range(self.num_layers)]
        self.mlp = [linen.Dense(size) for size in self.mlp_sizes]
        self.output = linen.Dense(self.output_size)

    def __call__(self, lstm, x):
        lstm, x = self.recur(lstm, x)
        return lstm, self.decode(x)

    def recur(self, lstm, x):
        after = []
        for cell, layer in zip(self.cells, lstm, strict=True):
            layer, x = cell(layer, x)
            after.append(layer)
        return tuple(after), x

    def decode(self, x):
        for layer in self.mlp:
            x = linen.relu(layer(x))
        return self.output(x)


@functools.lru_cache
def _network(config: BcRnnConfig, action_dim: int) -> _Network:
    size = action_dim if config.head == Head.L2 else config.num_modes * (2 * action_dim + 1)
    return _Network(config.hidden_size, config.num_layers, config.mlp_sizes, size)


@functools.lru_cache
def _optimizer(config: BcRnnConfig) -> optax.GradientTransformation:
    return optax.adam(config.learning_rate)


def init(key: jax.Array, demonstrations: TrajectoryBatch, config: BcRnnConfig) -> BcRnnState:
    """Draws the network and takes mean and deviation of the observations acted on.

    Args:
      key: PRNG key.
      demonstrations: `[num_trajectories]`.
      config: settings.
    """
    key_network, key = jax.random.split(key)
    demonstrations = jax.tree.map(jnp.asarray, demonstrations)
    obs = demonstrations.obs[:, :-1]
    weights = (demonstrations.mask / jnp.sum(demonstrations.mask))[..., None]
    mean = jnp.sum(weights * obs, axis=(0, 1))
    std = jnp.sqrt(jnp.sum(weights * jnp.square(obs - mean), axis=(0, 1))) + _SMALLEST_OBS_STD
    network = _network(config, demonstrations.actions.shape[-1]).init(
        key_network, _empty(1, config), obs[:1, 0]
    )
    return BcRnnState(BcRnnParams(mean, std, network), _optimizer(config).init(network), key)


def _empty(num_rows: int, config: BcRnnConfig) -> tuple[tuple[jax.Array, jax.Array], ...]:
    shape = (num_rows, config.hidden_size)
    return tuple((jnp.zeros(shape), jnp.zeros(shape)) for _ in range(config.num_layers))


def sample_sequences(
    key: jax.Array, demonstrations: TrajectoryBatch, config: BcRnnConfig
) -> Sequences:
    """Draws windows, every one that lies within the running steps of an episode equally likely.

    An episode shorter than a window has one, from its beginning; `mask` is 0 past its end.

    Args:
      key: PRNG key.
      demonstrations: `[num_trajectories]`.
      config: settings.
    """
    demonstrations = jax.tree.map(jnp.asarray, demonstrations)
    alive = jnp.sum(demonstrations.mask, axis=-1).astype(jnp.int32)
    windows = jnp.where(alive > 0, jnp.maximum(alive - config.sequence_length + 1, 1), 0)
    cumulative = jnp.cumsum(windows)
    draw = jax.random.randint(key, (config.batch_size,), 0, cumulative[-1])
    index = jnp.searchsorted(cumulative, draw, side="right")
    start = draw - (cumulative - windows)[index]
    steps = start[:, None] + jnp.arange(config.sequence_length)
    mask = (steps < alive[index][:, None]).astype(jnp.float32)
    index, steps = index[:, None], jnp.minimum(steps, demonstrations.mask.shape[1] - 1)
    return Sequences(demonstrations.obs[index, steps], demonstrations.actions[index, steps], mask)


def unroll(params: BcRnnParams, obs: jax.Array, config: BcRnnConfig, action_dim: int) -> jax.Array:
    """Applies the network to whole sequences, each from an empty hidden state.

    Args:
      params: parameters.
      obs: `[batch_size, num_steps, obs_dim]`.
      config: settings.
      action_dim: size of an action.

    Returns:
      The last layer's outputs, `[batch_size, num_steps, output_size]`.
    """
    network = _network(config, action_dim)

    def recur(lstm, x_t):
        return network.apply(params.network, lstm, x_t, method="recur")

    x = jnp.swapaxes(_standardise(params, obs), 0, 1)
    _, hidden = jax.lax.scan(recur, _empty(obs.shape[0], config), x)
    return network.apply(params.network, jnp.swapaxes(hidden, 0, 1), method="decode")


def _standardise(params: BcRnnParams, obs: jax.Array) -> jax.Array:
    return (obs - params.obs_mean) / params.obs_std


def _mixture(output: jax.Array, config: BcRnnConfig, action_dim: int) -> Mixture:
    """Reads the outputs of head "gmm", `[..., num_modes * (2 * action_dim + 1)]`."""
    logits, rest = jnp.split(output, [config.num_modes], axis=-1)
    rest = rest.reshape(*rest.shape[:-1], 2, config.num_modes, action_dim)
    std = jax.nn.softplus(rest[..., 1, :, :]) + _SMALLEST_MODE_STD
    return Mixture(logits, jnp.tanh(rest[..., 0, :, :]), std)


def _log_prob(mixture: Mixture, action_t: jax.Array) -> jax.Array:
    log_density = jax.scipy.stats.norm.logpdf(action_t[..., None, :], mixture.mean, mixture.std)
    log_weight = jax.nn.log_softmax(mixture.logits)
    return jax.nn.logsumexp(log_weight + jnp.sum(log_density, axis=-1), axis=-1)


def loss(params: BcRnnParams, sequences: Sequences, config: BcRnnConfig) -> jax.Array:
    """The head's loss, averaged over the steps in which episodes ran."""
    action_dim = sequences.actions.shape[-1]
    output = unroll(params, sequences.obs, config, action_dim)
    if config.head == Head.L2:
        loss_t = jnp.mean(jnp.square(jnp.tanh(output) - sequences.actions), axis=-1)
    else:
        loss_t = -_log_prob(_mixture(output, config, action_dim), sequences.actions)
    return jnp.sum(sequences.mask * loss_t) / jnp.sum(sequences.mask)


def step(
    state: BcRnnState, demonstrations: TrajectoryBatch, config: BcRnnConfig
) -> tuple[BcRnnState, Metrics]:
    """Makes one Adam step on a batch of sequences."""
    key_sequences, key = jax.random.split(state.key)
    sequences = sample_sequences(key_sequences, demonstrations, config)

    def network_loss(network):
        return loss(state.params._replace(network=network), sequences, config)

    value, grads = jax.value_and_grad(network_loss)(state.params.network)
    updates, opt = _optimizer(config).update(grads, state.opt)
    network = optax.apply_updates(state.params.network, updates)
    return BcRnnState(state.params._replace(network=network), opt, key), {"loss": value}


def train(
    state: BcRnnState, demonstrations: TrajectoryBatch, config: BcRnnConfig, num_updates: int
) -> tuple[BcRnnState, Metrics]:
    """Scans `step`; metrics are averaged over the steps."""
    state, metrics = jax.lax.scan(
        lambda state, _: step(state, demonstrations, config), state, None, length=num_updates
    )
    return state, jax.tree.map(jnp.mean, metrics)


def initial_carry(num_episodes: int, config: BcRnnConfig) -> BcRnnCarry:
    """Returns what rollouts remember when they begin: nothing."""
    return BcRnnCarry(_empty(num_episodes, config), jnp.zeros(num_episodes, jnp.int32))


def act(
    params: BcRnnParams,
    carry: BcRnnCarry,
    obs_t: jax.Array,
    key: jax.Array,
    config: BcRnnConfig,
    action_dim: int,
) -> tuple[BcRnnCarry, jax.Array]:
    """Acts one step of every episode; head "gmm" draws a mode and acts close to its mean.

    Args:
      params: parameters.
      carry: what the rollouts remember.
      obs_t: `[num_episodes, obs_dim]`.
      key: PRNG key; unused by head "l2".
      config: settings.
      action_dim: size of an action.

    Returns:
      What they remember now, and actions in [-1, 1], `[num_episodes, action_dim]`.
    """
    lstm = carry.lstm
    period = config.sequence_length if config.reset_every is None else config.reset_every
    if period > 0:
        forget = (carry.steps % period == 0)[:, None]
        lstm = jax.tree.map(lambda x: jnp.where(forget, 0.0, x), lstm)
    network = _network(config, action_dim)
    lstm, output = network.apply(params.network, lstm, _standardise(params, obs_t))
    if config.head == Head.L2:
        action_t = jnp.tanh(output)
    else:
        key_mode, key_noise = jax.random.split(key)
        mixture = _mixture(output, config, action_dim)
        mode = jax.random.categorical(key_mode, mixture.logits)[..., None, None]
        mean = jnp.take_along_axis(mixture.mean, mode, axis=-2)[..., 0, :]
        noise = jax.random.normal(key_noise, mean.shape)
        action_t = jnp.clip(mean + _ACTING_MODE_STD * noise, -1.0, 1.0)
    return BcRnnCarry(lstm, carry.steps + 1), action_t


def finish(state: BcRnnState) -> BcRnnParams:
    """Reads what acting needs."""
    return state.params
