"""The discriminator of Noisy-AIRL, whose parts g and h are a reward and its shaping.

AIRL (https://arxiv.org/abs/1710.11248) tells demonstrations from the policy's own transitions by

  logits = f(s, a, s') - log pi(a|s),   f = g + gamma h(s') - h(s),

where g becomes the reward and h absorbs shaping. SSRR (Chen et al., 2020) trains it on rollouts
under action noise of known level eta, whose rows are weighted by how much likelier the clean policy
is to act so: w = pi(a|s) / (eta u + (1 - eta) pi(a|s)), with u the uniform density. Here log
pi is bounded, in w as in the logits, so that w stays near 1 whatever the action.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training import networks as brax_networks
from flax import linen, struct

from represent_jax.config import require, require_sizes
from represent_jax.types import Metrics, Params, Transition

# Bound on the inputs of g and h, in deviations of the demonstrations.
INPUT_CLIP = 5.0


@dataclasses.dataclass(frozen=True)
class DiscriminatorConfig:
    """Settings of the discriminator.

    Attributes:
      state_only: whether g sees the next state alone, or state and action too.
      hidden_sizes: units of the hidden layers of g and h.
      learning_rate: AdamW step size.
      weight_decay: AdamW weight decay.
      batch_size: rows from each of demonstrations and policy in an update.
      updates_per_step: updates in a training step.
      gradient_penalty: weight of the squared gradient norm of f between demonstration and policy.
      shaping_discount: gamma in f.
      log_prob_clip: bound on log pi in the logits.
    """

    state_only: bool = True
    hidden_sizes: tuple[int, ...] = (64, 64)
    learning_rate: float = 3e-4
    weight_decay: float = 1e-3
    batch_size: int = 256
    updates_per_step: int = 4
    gradient_penalty: float = 1.0
    shaping_discount: float = 0.99
    log_prob_clip: float = 1.0

    def __post_init__(self) -> None:
        for field in ("batch_size", "updates_per_step"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        require(self.learning_rate > 0.0, "learning_rate", "positive", self.learning_rate)
        for field in ("gradient_penalty", "weight_decay"):
            require(getattr(self, field) >= 0.0, field, ">= 0", getattr(self, field))
        require_sizes(self.hidden_sizes)
        discount = self.shaping_discount
        require(0.0 <= discount <= 1.0, "shaping_discount", "in [0, 1]", discount)
        require(self.log_prob_clip > 0.0, "log_prob_clip", "positive", self.log_prob_clip)


class RewardParams(NamedTuple):
    """The discriminator's parameters and the statistics its inputs are normalised by.

    Attributes:
      g, h: network parameters.
      mean, std: of the demonstrations' observations, `[obs_dim]`.
    """

    g: Params
    h: Params
    mean: jax.Array
    std: jax.Array


@struct.dataclass
class DiscriminatorState:
    """Parameters and their optimiser's state."""

    params: RewardParams
    opt: optax.OptState


class Rows(NamedTuple):
    """Batches of one training step, `[updates_per_step, batch_size]`.

    Attributes:
      expert, policy: transitions of the demonstrations and of the policy.
      log_prob_expert, log_prob_policy: bounded log pi(a|s) of their rows; the former is None for
        demonstrations of states alone.
    """

    expert: Transition
    policy: Transition
    log_prob_expert: jax.Array | None
    log_prob_policy: jax.Array


@functools.lru_cache
def _networks(config: DiscriminatorConfig):
    module = brax_networks.MLP(layer_sizes=(*config.hidden_sizes, 1), activation=linen.relu)
    optimizer = optax.adamw(config.learning_rate, weight_decay=config.weight_decay)
    return module, optimizer


def init(
    key: jax.Array, demonstrations: Transition, config: DiscriminatorConfig
) -> DiscriminatorState:
    """Draws g and h, and takes the inputs' statistics from `[num_transitions]` rows."""
    obs = demonstrations.obs_t
    obs_dim = obs.shape[-1]
    input_dim = obs_dim
    if not config.state_only:
        input_dim += obs_dim + demonstrations.action_t.shape[-1]
    module, optimizer = _networks(config)
    key_g, key_h = jax.random.split(key)
    params = RewardParams(
        g=module.init(key_g, jnp.zeros(input_dim)),
        h=module.init(key_h, jnp.zeros(obs_dim)),
        mean=jnp.mean(obs, axis=0),
        # A floor, for observations that hardly move in the demonstrations.
        std=jnp.std(obs, axis=0) + 1e-2,
    )
    return DiscriminatorState(params, optimizer.init((params.g, params.h)))


def reward(
    params: RewardParams,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: DiscriminatorConfig,
) -> jax.Array:
    """g alone, the reward without shaping, `[...]`."""
    module, _ = _networks(config)
    inputs = _normalize(params, next_obs_t)
    if not config.state_only:
        inputs = jnp.concatenate([inputs, _normalize(params, obs_t), action_t], axis=-1)
    return module.apply(params.g, inputs)[..., 0]


def advantage(
    params: RewardParams, transition: Transition, config: DiscriminatorConfig
) -> jax.Array:
    """f = g + gamma h(s') - h(s), `[...]`; h is zero past a terminal state."""
    module, _ = _networks(config)
    h_t = module.apply(params.h, _normalize(params, transition.obs_t))[..., 0]
    next_h_t = module.apply(params.h, _normalize(params, transition.next_obs_t))[..., 0]
    g_t = reward(params, transition.obs_t, transition.action_t, transition.next_obs_t, config)
    return g_t + config.shaping_discount * transition.discount_t * next_h_t - h_t


def _normalize(params: RewardParams, obs: jax.Array) -> jax.Array:
    # Bounded: a robot that random actions turned on its back is 28 deviations from anything
    # demonstrated, and one such episode would set the lower end of the noise-performance curve.
    return jnp.clip((obs - params.mean) / params.std, -INPUT_CLIP, INPUT_CLIP)


def bounded_log_prob(log_prob_t: jax.Array, config: DiscriminatorConfig) -> jax.Array:
    """Log pi as the logits see it, `[...]`.

    Unbounded, log pi alone tells old and demonstrated actions from fresh ones, and a state-only f
    is left with nothing to learn from; see BUILD_NOTES.
    """
    return jnp.clip(log_prob_t, -config.log_prob_clip, config.log_prob_clip)


def importance_weight(
    log_prob_t: jax.Array, noise_level_t: jax.Array, action_dim: int
) -> jax.Array:
    """Likelihood of an executed action under the policy over that under the noisy policy.

    SSRR's correction, in log space: log w = log pi - log(eta u + (1 - eta) pi).

    Args:
      log_prob_t: log pi(a|s), `[...]`.
      noise_level_t: eta, `[...]`.
      action_dim: number of action dimensions; the uniform density u is 2^-action_dim.
    """
    log_uniform = -action_dim * jnp.log(2.0)
    noisy = jnp.logaddexp(
        jnp.log(noise_level_t) + log_uniform,
        jnp.log1p(-noise_level_t) + log_prob_t,
    )
    return jnp.exp(log_prob_t - noisy)


def logits(f_expert: jax.Array, f_policy: jax.Array, rows: Rows) -> tuple[jax.Array, jax.Array]:
    """f - log pi of demonstrations and of the policy, both `[...]`; f alone without actions.

    Where demonstrated actions are missing, so is their log pi, and log pi in the policy's rows only
    would tell the two apart whatever the states are. So it is left out of both. At its optimum f is
    then the log-ratio of how often transitions are demonstrated and how often the policy makes them
    (Torabi et al., 2018, https://arxiv.org/abs/1807.06158); it still leads the policy to where the
    demonstrations are, and g still says which states these are. The importance weights of noisy
    rows need log pi of the policy's own actions only, and keep it.

    Args:
      f_expert, f_policy: f of the rows.
      rows: the rows.
    """
    if rows.log_prob_expert is None:
        return f_expert, f_policy
    return f_expert - rows.log_prob_expert, f_policy - rows.log_prob_policy


def loss(
    params: RewardParams, rows: Rows, key: jax.Array, config: DiscriminatorConfig
) -> tuple[jax.Array, Metrics]:
    """Weighted binary cross-entropy with demonstrations labelled 1, plus the gradient penalty.

    Args:
      params: discriminator.
      rows: batches of one update, `[batch_size]`.
      key: PRNG key of the penalty's interpolation.
      config: settings.
    """
    f_expert, f_policy = (advantage(params, of, config) for of in (rows.expert, rows.policy))
    logits_expert_is_high, logits_policy = logits(f_expert, f_policy, rows)
    action_dim = rows.policy.action_t.shape[-1]
    weight = importance_weight(rows.log_prob_policy, rows.policy.noise_level_t, action_dim)
    cross_entropy = 0.5 * jnp.mean(jax.nn.softplus(-logits_expert_is_high))
    cross_entropy += 0.5 * jnp.mean(weight * jax.nn.softplus(logits_policy))
    penalty = jnp.zeros(())
    if config.gradient_penalty > 0.0:
        penalty = gradient_penalty(
            lambda transition: advantage(params, transition, config), params.std, rows, key
        )
    metrics = {
        "discriminator_loss": cross_entropy,
        "gradient_penalty": penalty,
        "accuracy_expert": jnp.mean(logits_expert_is_high > 0.0),
        "accuracy_policy": jnp.mean(logits_policy < 0.0),
        "logits_policy": jnp.mean(logits_policy),
    }
    return cross_entropy + config.gradient_penalty * penalty, metrics


def gradient_penalty(
    advantage_fn: Callable[[Transition], jax.Array], std: jax.Array, rows: Rows, key: jax.Array
) -> jax.Array:
    """Mean squared gradient norm of f between demonstrations and policy, `[]`.

    Args:
      advantage_fn: f of transitions, `[batch_size]`.
      std: the demonstrations' spread, `[obs_dim]`.
      rows: batches of one update.
      key: PRNG key of the interpolation.
    """
    expert, policy = rows.expert, rows.policy
    mix = jax.random.uniform(key, (expert.obs_t.shape[0], 1))

    def between(a, b):
        return mix * a + (1.0 - mix) * b

    def f_of(obs_t, next_obs_t):
        between_rows = policy._replace(obs_t=obs_t, next_obs_t=next_obs_t)
        return jnp.sum(advantage_fn(between_rows))

    grads = jax.grad(f_of, argnums=(0, 1))(
        between(expert.obs_t, policy.obs_t), between(expert.next_obs_t, policy.next_obs_t)
    )
    # In units of the demonstrations' spread, so that the penalty does not depend on scales.
    norm = sum(jnp.sum(jnp.square(grad * std), axis=-1) for grad in grads)
    return jnp.mean(norm)


def update(
    state: DiscriminatorState, rows: Rows, key: jax.Array, config: DiscriminatorConfig
) -> tuple[DiscriminatorState, Metrics]:
    """Makes one update for each batch, in order; metrics are averaged over them."""
    _, optimizer = _networks(config)

    def body(state, inputs):
        params = state.params

        def loss_fn(nets):
            return loss(params._replace(g=nets[0], h=nets[1]), *inputs, config)

        nets = (params.g, params.h)
        (_, metrics), grads = jax.value_and_grad(loss_fn, has_aux=True)(nets)
        updates, opt = optimizer.update(grads, state.opt, nets)
        g, h = optax.apply_updates(nets, updates)
        return DiscriminatorState(params._replace(g=g, h=h), opt), metrics

    keys = jax.random.split(key, rows.log_prob_policy.shape[0])
    state, metrics = jax.lax.scan(body, state, (rows, keys))
    return state, jax.tree.map(jnp.mean, metrics)
