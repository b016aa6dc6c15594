"""D-REX's reward learning: preferences between noisy rollouts, a baseline.

Brown et al., Better-than-Demonstrator Imitation Learning via Automatically-Ranked Demonstrations
(CoRL 2019), arXiv 1907.03976, at the settings of its code. More noise means a worse rollout, so a
reward is fitted by which the less noisy of two snippets is likely to sum to more. Two things
differ from the code: every update draws new pairs, while the code draws 5,000 once for each
network, and the reward sees the state that an action led to, while the code's sees the one before.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from represent_jax.config import require, require_sizes
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.errors import RepresentError
from represent_jax.stages.mlp import Mlp, squared_kernels
from represent_jax.types import Metrics, Params

# In float32 two levels may lie a little less apart than the decimals they stand for.
_GAP_TOLERANCE = 1e-4


@dataclasses.dataclass(frozen=True)
class PreferenceConfig:
    """Settings of D-REX's reward learning.

    Attributes:
      num_updates: Adam steps.
      num_pairs: pairs of snippets in each.
      min_level_gap: least difference between the noise levels of a pair.
      snippet_steps: length of snippets; an episode that is shorter is one snippet.
      hidden_sizes: units of the hidden layers.
      learning_rate: Adam's step size.
      kernel_scale: standard deviation of initial kernels.
      l2: weight of the squared kernels.
      ensemble_size: independent copies, whose mean is the reward.
    """

    num_updates: int = 3000
    num_pairs: int = 64
    min_level_gap: float = 0.3
    snippet_steps: int = 50
    hidden_sizes: tuple[int, ...] = (256, 256)
    learning_rate: float = 1e-4
    kernel_scale: float = 0.02
    l2: float = 0.01
    ensemble_size: int = 3

    def __post_init__(self) -> None:
        for field in ("num_updates", "num_pairs", "snippet_steps", "ensemble_size"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        for field in ("learning_rate", "kernel_scale"):
            require(getattr(self, field) > 0.0, field, "> 0", getattr(self, field))
        require(0.0 < self.min_level_gap <= 1.0, "min_level_gap", "in (0, 1]", self.min_level_gap)
        require_sizes(self.hidden_sizes)
        require(self.l2 >= 0.0, "l2", ">= 0", self.l2)


@struct.dataclass
class PreferenceState:
    """Training state: parameters with leaves `[ensemble, ...]`, optimiser and key."""

    params: Params
    opt: optax.OptState
    key: jax.Array


class Pairs(NamedTuple):
    """Pairs of snippets; the first of each comes from the less noisy rollout.

    Attributes:
      inputs: what the reward sees, `[num_pairs, 2, snippet_steps, obs_dim]`.
      mask: 1 in the snippet, 0 past its end, `[num_pairs, 2, snippet_steps]`.
    """

    inputs: jax.Array
    mask: jax.Array


@functools.lru_cache
def _network(config: PreferenceConfig) -> Mlp:
    return Mlp(config.hidden_sizes, config.kernel_scale)


@functools.lru_cache
def _optimizer(config: PreferenceConfig) -> optax.GradientTransformation:
    return optax.adam(config.learning_rate)


def init(key: jax.Array, obs_dim: int, config: PreferenceConfig) -> PreferenceState:
    """Draws all ensemble members."""
    key_params, key = jax.random.split(key)

    def draw(key):
        return _network(config).init(key, jnp.zeros(obs_dim))

    params = jax.vmap(draw)(jax.random.split(key_params, config.ensemble_size))
    return PreferenceState(params, _optimizer(config).init(params), key)


def check_levels(noise_levels: np.ndarray, config: PreferenceConfig) -> None:
    """Checks, outside jit, that there are pairs to sample.

    Args:
      noise_levels: of each trajectory, `[num_trajectories]`.
      config: settings.

    Raises:
      RepresentError: no two levels differ by min_level_gap.
    """
    levels = np.asarray(noise_levels)
    if not bool(jnp.any(_clearly_less_noisy(levels, config.min_level_gap))):
        found = f"{levels.min():g} to {levels.max():g}" if levels.size else "no trajectories"
        raise RepresentError(
            f"noise levels: no two differ by min_level_gap ({config.min_level_gap:g}), "
            f"found {found}"
        )


def _clearly_less_noisy(noise_levels: jax.Array, min_level_gap: float) -> jax.Array:
    """Whether row i is at least the gap less noisy than column j, `[N, N]`."""
    levels = jnp.asarray(noise_levels, jnp.float32)
    return levels[None, :] - levels[:, None] >= (1.0 - _GAP_TOLERANCE) * min_level_gap


def sample_pairs(
    key: jax.Array, trajectories: TrajectoryBatch, num_pairs: int, config: PreferenceConfig
) -> Pairs:
    """Draws pairs of snippets, all pairs of trajectories with the gap equally likely.

    Starts are uniform and independent; a snippet never leaves the steps in which its episode ran.
    What is drawn has no meaning where `check_levels` raises.

    Args:
      key: PRNG key.
      trajectories: `[num_trajectories]`.
      num_pairs: how many to draw.
      config: settings.
    """
    key_pair, key_start = jax.random.split(key)
    trajectories = jax.tree.map(jnp.asarray, trajectories)
    horizon = trajectories.mask.shape[1]
    admissible = _clearly_less_noisy(trajectories.noise_level, config.min_level_gap)
    # One draw numbers a pair among all admissible ones, row by row: exact, in integers.
    cumulative = jnp.cumsum(admissible.astype(jnp.int32).ravel())
    draw = jax.random.randint(key_pair, (num_pairs,), 0, cumulative[-1])
    pair = jnp.searchsorted(cumulative, draw, side="right")
    index = jnp.stack(jnp.divmod(pair, admissible.shape[1]), axis=1)
    alive = jnp.sum(trajectories.mask, axis=1).astype(jnp.int32)[index]
    length = jnp.minimum(config.snippet_steps, alive)
    start = jax.random.randint(key_start, index.shape, 0, alive - length + 1)
    offset = jnp.arange(min(config.snippet_steps, horizon))
    steps = jnp.minimum(start[..., None] + offset, horizon - 1)
    mask = (offset < length[..., None]).astype(jnp.float32)
    return Pairs(trajectories.obs[index[..., None], steps + 1], mask)


def margins(params: Params, pairs: Pairs, config: PreferenceConfig) -> jax.Array:
    """By how much one member's reward sums to more on the less noisy snippets, `[num_pairs]`."""
    reward_t = _network(config).apply(params, pairs.inputs)
    sums = jnp.sum(pairs.mask * reward_t, axis=-1)
    return sums[:, 0] - sums[:, 1]


def loss(params: Params, pairs: Pairs, config: PreferenceConfig) -> tuple[jax.Array, Metrics]:
    """Bradley-Terry cross-entropy of the preferences, and L2, of one ensemble member.

    Args:
      params: without the ensemble axis.
      pairs: `[num_pairs, ...]`.
      config: settings.
    """
    margin = margins(params, pairs, config)
    l2 = config.l2 * squared_kernels(params)
    # Softmax cross-entropy of two logits depends on their difference only.
    total = jnp.mean(jax.nn.softplus(-margin)) + l2
    return total, {"loss": total, "accuracy": _share_positive(margin), "l2_loss": l2}


def _share_positive(margin: jax.Array) -> jax.Array:
    return jnp.mean(0.5 * (1.0 + jnp.sign(margin)))


def step(
    state: PreferenceState, trajectories: TrajectoryBatch, config: PreferenceConfig
) -> tuple[PreferenceState, Metrics]:
    """Makes one Adam step on every ensemble member, each with pairs of its own."""
    key_members, key = jax.random.split(state.key)

    def member_loss(params, key):
        return loss(params, sample_pairs(key, trajectories, config.num_pairs, config), config)

    keys = jax.random.split(key_members, config.ensemble_size)
    grads, metrics = jax.vmap(jax.grad(member_loss, has_aux=True))(state.params, keys)
    updates, opt = _optimizer(config).update(grads, state.opt)
    params = optax.apply_updates(state.params, updates)
    return PreferenceState(params, opt, key), jax.tree.map(jnp.mean, metrics)


def train(
    state: PreferenceState,
    trajectories: TrajectoryBatch,
    config: PreferenceConfig,
    num_updates: int,
) -> tuple[PreferenceState, Metrics]:
    """Scans `step`; metrics are averaged over the steps."""
    state, metrics = jax.lax.scan(
        lambda state, _: step(state, trajectories, config), state, None, length=num_updates
    )
    return state, jax.tree.map(jnp.mean, metrics)


def reward(
    params: Params,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: PreferenceConfig,
) -> jax.Array:
    """The mean over the ensemble, of the state that the action led to, `[...]`."""
    del obs_t, action_t
    return jnp.mean(jax.vmap(_network(config).apply, in_axes=(0, None))(params, next_obs_t), axis=0)


def ranking_accuracy(
    noise_levels: jax.Array, true_returns: jax.Array, min_level_gap: float
) -> jax.Array:
    """Share of admissible pairs of trajectories in which less noise goes with more return, `[]`.

    How good the labels are (in the code's README: Hopper 0.82, HalfCheetah 0.88 to 0.92). Equal
    returns count half; NaN where no pair has the gap.

    Args:
      noise_levels: `[num_trajectories]`.
      true_returns: `[num_trajectories]`.
      min_level_gap: least difference between the noise levels of a pair.
    """
    admissible = _clearly_less_noisy(noise_levels, min_level_gap)
    true_returns = jnp.asarray(true_returns)
    agrees = 0.5 * (1.0 + jnp.sign(true_returns[:, None] - true_returns[None, :]))
    return jnp.sum(admissible * agrees) / jnp.sum(admissible)


def pair_accuracy(
    params: Params,
    trajectories: TrajectoryBatch,
    config: PreferenceConfig,
    key: jax.Array,
    num_pairs: int,
) -> jax.Array:
    """Share of sampled pairs that the ensemble's mean orders by noise, `[]`; ties count half.

    Args:
      params: `[ensemble, ...]`.
      trajectories: `[num_trajectories]`.
      config: settings.
      key: PRNG key.
      num_pairs: how many to sample.
    """
    pairs = sample_pairs(key, trajectories, num_pairs, config)

    def margin(pair):
        reward_t = reward(params, None, None, pair.inputs, config)
        sums = jnp.sum(pair.mask * reward_t, axis=-1)
        return sums[0] - sums[1]

    # In blocks as large as those of training: all at once, thousands of pairs would fill memory.
    return _share_positive(jax.lax.map(margin, pairs, batch_size=config.num_pairs))
