"""Behavioural cloning at the strength of D-REX's code: a baseline, and where D-REX's noise goes.

Brown et al. (CoRL 2019), arXiv 1907.03976: a deterministic policy on raw observations, fitted by
squared error and held down by L2. Its output is neither squashed nor clipped in training.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from represent_jax.config import require, require_sizes
from represent_jax.errors import RepresentError
from represent_jax.stages.mlp import Mlp, squared_kernels
from represent_jax.types import Metrics, Params, Transition


@dataclasses.dataclass(frozen=True)
class BcConfig:
    """Settings of behavioural cloning.

    Attributes:
      num_updates: Adam steps.
      batch_size: transitions in each.
      hidden_sizes: units of the hidden layers.
      learning_rate: Adam's step size.
      kernel_scale: standard deviation of initial kernels.
      l2: weight of the squared kernels.
      validation_share: share of the transitions that is kept out of training.
    """

    num_updates: int = 50_000
    batch_size: int = 128
    hidden_sizes: tuple[int, ...] = (256, 256, 256, 256)
    learning_rate: float = 1e-4
    kernel_scale: float = 0.02
    l2: float = 1e-3
    validation_share: float = 0.2

    def __post_init__(self) -> None:
        for field in ("num_updates", "batch_size"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        for field in ("learning_rate", "kernel_scale"):
            require(getattr(self, field) > 0.0, field, "> 0", getattr(self, field))
        require_sizes(self.hidden_sizes)
        require(self.l2 >= 0.0, "l2", ">= 0", self.l2)
        require(
            0.0 < self.validation_share < 1.0,
            "validation_share",
            "in (0, 1)",
            self.validation_share,
        )


@struct.dataclass
class BcState:
    """Training state: parameters, optimiser and key."""

    params: Params
    opt: optax.OptState
    key: jax.Array


class BcData(NamedTuple):
    """Demonstrated transitions.

    Attributes:
      train: to learn from, `[num_train]`.
      validation: to see how well that carries over, `[num_validation]`.
    """

    train: Transition
    validation: Transition


@functools.lru_cache
def _network(config: BcConfig, action_dim: int) -> Mlp:
    return Mlp(config.hidden_sizes, config.kernel_scale, action_dim)


@functools.lru_cache
def _optimizer(config: BcConfig) -> optax.GradientTransformation:
    return optax.adam(config.learning_rate)


def split(key: jax.Array, demonstrations: Transition, config: BcConfig) -> BcData:
    """Divides transitions at random; the same key always gives the same division.

    Args:
      key: PRNG key.
      demonstrations: `[num_transitions]`; a transition that is given twice may fall on both sides.
      config: settings.

    Raises:
      RepresentError: there are fewer than two transitions.
    """
    num_transitions = demonstrations.obs_t.shape[0]
    if num_transitions < 2:
        raise RepresentError(
            f"behavioural cloning: at least 2 transitions are needed, found {num_transitions}"
        )
    num_validation = round(config.validation_share * num_transitions)
    num_validation = min(max(num_validation, 1), num_transitions - 1)
    order = jax.random.permutation(key, num_transitions)
    validation, train = order[:num_validation], order[num_validation:]
    demonstrations = jax.tree.map(jnp.asarray, demonstrations)
    return BcData(
        train=jax.tree.map(lambda x: x[train], demonstrations),
        validation=jax.tree.map(lambda x: x[validation], demonstrations),
    )


def init(key: jax.Array, demonstrations: Transition, config: BcConfig) -> BcState:
    """Draws the policy; of the demonstrations, `[num_transitions]`, only sizes matter."""
    key_params, key = jax.random.split(key)
    network = _network(config, demonstrations.action_t.shape[-1])
    params = network.init(key_params, jnp.zeros(demonstrations.obs_t.shape[-1]))
    return BcState(params, _optimizer(config).init(params), key)


def squared_error(params: Params, rows: Transition, config: BcConfig) -> jax.Array:
    """Squared error summed over an action's dimensions, averaged over `[num_rows]`, `[]`."""
    action_t = _network(config, rows.action_t.shape[-1]).apply(params, rows.obs_t)
    return jnp.mean(jnp.sum(jnp.square(action_t - rows.action_t), axis=-1))


def loss(params: Params, rows: Transition, config: BcConfig) -> tuple[jax.Array, Metrics]:
    """Squared error and L2 on a batch `[batch_size]`."""
    error = squared_error(params, rows, config)
    l2 = config.l2 * squared_kernels(params)
    return error + l2, {"loss": error + l2, "train_loss": error, "l2_loss": l2}


def step(state: BcState, data: BcData, config: BcConfig) -> tuple[BcState, Metrics]:
    """Makes one Adam step on a batch, drawn with replacement."""
    key_batch, key = jax.random.split(state.key)
    num_train = data.train.obs_t.shape[0]
    index = jax.random.randint(key_batch, (config.batch_size,), 0, num_train)
    rows = jax.tree.map(lambda x: jnp.asarray(x)[index], data.train)
    grads, metrics = jax.grad(loss, has_aux=True)(state.params, rows, config)
    updates, opt = _optimizer(config).update(grads, state.opt)
    return BcState(optax.apply_updates(state.params, updates), opt, key), metrics


def train(
    state: BcState, data: BcData, config: BcConfig, num_updates: int
) -> tuple[BcState, Metrics]:
    """Scans `step`; metrics are averaged over the steps.

    `validation_loss` is the squared error, without L2, on all validation rows after the last step;
    `train_loss` is what to hold it against.
    """
    state, metrics = jax.lax.scan(
        lambda state, _: step(state, data, config), state, None, length=num_updates
    )
    metrics = jax.tree.map(jnp.mean, metrics)
    metrics["validation_loss"] = squared_error(state.params, data.validation, config)
    return state, metrics


def act(
    params: Params, obs_t: jax.Array, key: jax.Array, config: BcConfig, action_dim: int
) -> jax.Array:
    """The policy's actions, clipped to [-1, 1]; the key is unused, `[..., action_dim]`."""
    del key
    return jnp.clip(_network(config, action_dim).apply(params, obs_t), -1.0, 1.0)


def finish(state: BcState) -> Params:
    """Reads what acting needs."""
    return state.params
