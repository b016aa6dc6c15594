"""Phase 1, Noisy-AIRL: a first reward and a first policy for each strategy.

AIRL (https://arxiv.org/abs/1710.11248) tells demonstrations from the policy's own transitions by

  logits = f(s, a, s') - log pi(a|s),   f = g + gamma h(s') - h(s),

where g becomes the reward and h absorbs shaping. SSRR (Chen et al., 2020) trains it on rollouts
under action noise of known level eta, whose rows are weighted by how much less likely the clean
policy is to act so: w = pi(a|s) / (eta u + (1 - eta) pi(a|s)), with u the uniform density.
The generator is SAC, its rewards recomputed from the current discriminator at every update.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training import networks as brax_networks
from flax import linen, struct

from represent_jax.agents import cloning, sac
from represent_jax.agents.sac import SacConfig
from represent_jax.config import require
from represent_jax.envs.episode import Episode
from represent_jax.types import Metrics, Params, Transition

# One environment in two is clean; the others climb to a quarter of random actions (SSRR's levels).
TRAINING_NOISE_LEVELS = (0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.10, 0.15, 0.20, 0.25)


@dataclasses.dataclass(frozen=True)
class AirlConfig:
    """Settings of Phase 1.

    Attributes:
      env_steps: budget of each strategy.
      cloning_updates: updates of behavioural cloning that the generator starts from; 0 starts it
        from random networks.
      noisy: whether training environments have the noise levels of SSRR (Noisy-AIRL).
      state_only: whether g sees the next state alone, or state and action too.
      hidden_sizes: units of the hidden layers of g and h.
      learning_rate: AdamW step size of the discriminator.
      weight_decay: AdamW weight decay of the discriminator.
      batch_size: rows from each of demonstrations and replay in a discriminator update.
      updates_per_step: discriminator updates after each vectorised step.
      gradient_penalty: weight of the squared gradient norm of f between demonstration and replay.
      shaping_discount: gamma in f.
      log_prob_clip: bound on log pi in the logits.
      reward_scale: factor on f where it rewards the generator.
      reward_clip: bound on f where it rewards the generator.
      sac: the generator.
    """

    env_steps: int = 160_000
    cloning_updates: int = 2_000
    noisy: bool = True
    state_only: bool = True
    hidden_sizes: tuple[int, ...] = (64, 64)
    learning_rate: float = 3e-4
    weight_decay: float = 1e-3
    batch_size: int = 256
    updates_per_step: int = 4
    gradient_penalty: float = 1.0
    shaping_discount: float = 0.99
    log_prob_clip: float = 1.0
    reward_scale: float = 0.5
    reward_clip: float = 10.0
    sac: SacConfig = SacConfig(buffer_capacity=256_000, initial_temperature=0.1, learning_rate=1e-3)

    def __post_init__(self) -> None:
        for field in ("env_steps", "batch_size", "updates_per_step"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        require(self.cloning_updates >= 0, "cloning_updates", ">= 0", self.cloning_updates)
        require(self.gradient_penalty >= 0, "gradient_penalty", ">= 0", self.gradient_penalty)


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
class AirlState:
    """Training state of one strategy.

    Attributes:
      sac: the generator's.
      reward: the discriminator.
      reward_opt: its optimiser's state.
    """

    sac: sac.SacState
    reward: RewardParams
    reward_opt: optax.OptState


class AirlOutput(NamedTuple):
    """What Phase 1 hands on for one strategy."""

    policy: sac.PolicyParams
    reward: RewardParams


@functools.lru_cache
def _networks(config: AirlConfig):
    module = brax_networks.MLP(layer_sizes=(*config.hidden_sizes, 1), activation=linen.relu)
    optimizer = optax.adamw(config.learning_rate, weight_decay=config.weight_decay)
    return module, optimizer


def init(key: jax.Array, env: Episode, demonstrations: Transition, config: AirlConfig) -> AirlState:
    """Starts training on one strategy's transitions, `[num_transitions]`."""
    key_sac, key_reset, key_g, key_h, key_clone = jax.random.split(key, 5)
    num_envs = config.sac.num_envs
    levels = jnp.asarray(TRAINING_NOISE_LEVELS if config.noisy else (0.0,))
    levels = jnp.resize(levels, (num_envs,))
    start = jax.vmap(env.reset)(jax.random.split(key_reset, num_envs), levels)
    module, optimizer = _networks(config)
    obs = demonstrations.obs_t
    reward = RewardParams(
        g=module.init(key_g, _g_inputs_like(env, config)),
        h=module.init(key_h, jnp.zeros(env.observation_size)),
        mean=jnp.mean(obs, axis=0),
        # A floor, for observations that hardly move in the demonstrations.
        std=jnp.std(obs, axis=0) + 1e-2,
    )
    policy = None
    if config.cloning_updates:
        sizes = (env.observation_size, env.action_size)
        learner = sac.init_learner(key_clone, *sizes, config.sac)
        policy = sac.policy_of(
            cloning.clone(key_clone, learner, demonstrations, config.sac, config.cloning_updates)
        )
    agent = sac.init(key_sac, env, config.sac, start, policy)
    return AirlState(agent, reward, optimizer.init((reward.g, reward.h)))


def _g_inputs_like(env: Episode, config: AirlConfig) -> jax.Array:
    extra = 0 if config.state_only else env.observation_size + env.action_size
    return jnp.zeros(env.observation_size + extra)


def reward(
    params: RewardParams,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: AirlConfig,
) -> jax.Array:
    """g alone, the reward without shaping, `[...]`."""
    module, _ = _networks(config)
    inputs = _normalize(params, next_obs_t)
    if not config.state_only:
        inputs = jnp.concatenate([inputs, _normalize(params, obs_t), action_t], axis=-1)
    return module.apply(params.g, inputs)[..., 0]


def advantage(params: RewardParams, transition: Transition, config: AirlConfig) -> jax.Array:
    """f = g + gamma h(s') - h(s), `[...]`; h is zero past a terminal state."""
    module, _ = _networks(config)
    h_t = module.apply(params.h, _normalize(params, transition.obs_t))[..., 0]
    next_h_t = module.apply(params.h, _normalize(params, transition.next_obs_t))[..., 0]
    g_t = reward(params, transition.obs_t, transition.action_t, transition.next_obs_t, config)
    return g_t + config.shaping_discount * transition.discount_t * next_h_t - h_t


def _normalize(params: RewardParams, obs: jax.Array) -> jax.Array:
    return (obs - params.mean) / params.std


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


def discriminator_loss(
    params: RewardParams,
    expert: Transition,
    policy: Transition,
    log_prob_expert: jax.Array,
    log_prob_policy: jax.Array,
    key: jax.Array,
    config: AirlConfig,
) -> tuple[jax.Array, Metrics]:
    """Weighted binary cross-entropy with demonstrations labelled 1, plus the gradient penalty.

    Args:
      params: discriminator.
      expert, policy: batches of transitions, `[batch]`.
      log_prob_expert, log_prob_policy: log pi(a|s) of their rows, `[batch]`.
      key: PRNG key of the penalty's interpolation.
      config: settings.
    """
    logits_expert_is_high = advantage(params, expert, config) - log_prob_expert
    logits_policy = advantage(params, policy, config) - log_prob_policy
    weight = importance_weight(log_prob_policy, policy.noise_level_t, policy.action_t.shape[-1])
    loss = 0.5 * jnp.mean(jax.nn.softplus(-logits_expert_is_high))
    loss += 0.5 * jnp.mean(weight * jax.nn.softplus(logits_policy))
    penalty = jnp.zeros(())
    if config.gradient_penalty > 0.0:
        penalty = _gradient_penalty(params, expert, policy, key, config)
    metrics = {
        "discriminator_loss": loss,
        "gradient_penalty": penalty,
        "accuracy_expert": jnp.mean(logits_expert_is_high > 0.0),
        "accuracy_policy": jnp.mean(logits_policy < 0.0),
        "logits_policy": jnp.mean(logits_policy),
    }
    return loss + config.gradient_penalty * penalty, metrics


def _gradient_penalty(params, expert, policy, key, config) -> jax.Array:
    mix = jax.random.uniform(key, (expert.obs_t.shape[0], 1))

    def between(a, b):
        return mix * a + (1.0 - mix) * b

    def f_of(obs_t, next_obs_t):
        rows = policy._replace(obs_t=obs_t, next_obs_t=next_obs_t)
        return jnp.sum(advantage(params, rows, config))

    grads = jax.grad(f_of, argnums=(0, 1))(
        between(expert.obs_t, policy.obs_t), between(expert.next_obs_t, policy.next_obs_t)
    )
    # In units of the demonstrations' spread, so that the penalty does not depend on scales.
    norm = sum(jnp.sum(jnp.square(grad * params.std), axis=-1) for grad in grads)
    return jnp.mean(norm)


def step(
    state: AirlState, env: Episode, demonstrations: Transition, config: AirlConfig
) -> tuple[AirlState, Metrics]:
    """Takes one vectorised environment step; updates the discriminator, then the generator.

    The discriminator comes first: it must see log pi of the policy that faces it.
    """
    agent, transitions = sac.collect(state.sac, env, config.sac)
    policy = sac.policy_of(agent.learner)
    key_replay, key_expert, key_loss, key = jax.random.split(agent.key, 4)
    agent = agent.replace(key=key)
    shape = (config.updates_per_step, config.batch_size)
    replayed = sac.replay.sample(
        agent.buffer, key_replay, shape, env.observation_size, env.action_size
    )
    index = jax.random.randint(key_expert, shape, 0, demonstrations.reward_t.shape[0])
    expert = jax.tree.map(lambda x: x[index], demonstrations)
    log_prob_replayed = _log_prob(policy, replayed, config)
    log_prob_expert = _log_prob(policy, expert, config)
    _, optimizer = _networks(config)

    def body(carry, inputs):
        params, opt = carry

        def loss_fn(nets):
            whole = params._replace(g=nets[0], h=nets[1])
            return discriminator_loss(whole, *inputs, config)

        nets = (params.g, params.h)
        (_, metrics), grads = jax.value_and_grad(loss_fn, has_aux=True)(nets)
        updates, opt = optimizer.update(grads, opt, nets)
        g, h = optax.apply_updates(nets, updates)
        return (params._replace(g=g, h=h), opt), metrics

    keys = jax.random.split(key_loss, config.updates_per_step)
    (params, opt), discriminator_metrics = jax.lax.scan(
        body,
        (state.reward, state.reward_opt),
        (expert, replayed, log_prob_expert, log_prob_replayed, keys),
    )

    agent, batches = sac.draw(agent, env, config.sac)
    reward_t = generator_reward(params, batches, config)
    agent, metrics = sac.learn(agent, batches._replace(reward_t=reward_t), config.sac)
    metrics = {
        **metrics,
        **jax.tree.map(jnp.mean, discriminator_metrics),
        "env_reward": jnp.mean(transitions.reward_t),
    }
    return AirlState(agent, params, opt), metrics


def _log_prob(policy: sac.PolicyParams, rows: Transition, config: AirlConfig) -> jax.Array:
    # Unbounded, log pi alone tells old and demonstrated actions from fresh ones, and a state-only
    # f is left with nothing to learn from; see BUILD_NOTES.
    log_prob_t = sac.log_prob(policy, rows.obs_t, rows.action_t, config.sac)
    return jnp.clip(log_prob_t, -config.log_prob_clip, config.log_prob_clip)


def generator_reward(params: RewardParams, transition: Transition, config: AirlConfig) -> jax.Array:
    """What the generator maximises beside its own entropy, `[...]`.

    AIRL's reward is f - log pi. Its second half is the entropy that SAC adds by itself; written
    into the rewards of replayed actions it would favour those the policy has left behind.
    """
    f_t = advantage(params, transition, config)
    return config.reward_scale * jnp.clip(f_t, -config.reward_clip, config.reward_clip)


def train(
    state: AirlState, env: Episode, demonstrations: Transition, config: AirlConfig, num_steps: int
) -> tuple[AirlState, Metrics]:
    """Scans `step`; metrics are averaged over the steps."""
    state, metrics = jax.lax.scan(
        lambda state, _: step(state, env, demonstrations, config), state, None, length=num_steps
    )
    return state, jax.tree.map(jnp.mean, metrics)


def finish(state: AirlState) -> AirlOutput:
    """Reads what the later phases need."""
    return AirlOutput(sac.policy_of(state.sac.learner), state.reward)
