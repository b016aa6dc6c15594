"""Soft Actor-Critic (https://arxiv.org/abs/1812.05905) on Brax's losses and networks.

A step is one vectorised environment step followed by `updates_per_step` gradient updates. The
reward is a function of what a transition stores: computed once, when the transition is stored, or
again at every update for a reward that is itself learning. Counters are not part of the vmapped
state: `population_axes` says which leaves carry the population axis.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training import types as brax_types
from brax.training.acme import running_statistics, specs
from brax.training.agents.sac import losses as sac_losses
from brax.training.agents.sac import networks as sac_networks
from flax import struct

from represent_jax.agents import replay
from represent_jax.config import later, require, require_sizes
from represent_jax.envs.episode import Episode, transition_of
from represent_jax.types import Metrics, Params, RewardFn, Transition


@dataclasses.dataclass(frozen=True)
class SacConfig:
    """Settings of the agent.

    Attributes:
      num_envs: environments stepped together.
      updates_per_step: gradient updates after each vectorised step (of `num_envs` env steps).
      batch_size: transitions in each update.
      buffer_capacity: transitions kept, a multiple of `num_envs`.
      warmup_env_steps: environment steps taken before the first update.
      staggered: whether first episodes are cut off after random times. Without it all environments
        are at the same step of their episodes, which long episodes and a small budget never undo.
      critic_warmup_updates: first updates in which only the critics learn, so that an actor that
        was learned elsewhere is not undone by critics that know nothing yet.
      hidden_sizes: units of the hidden layers of actor and critics.
      critic_layer_norm: whether critics normalise their hidden layers, which bounds what they say
        of actions that nobody took (https://arxiv.org/abs/2302.02948).
      learning_rate: Adam's step size of actor, critics and temperature.
      discount: discount factor of an environment step.
      target_update_rate: share of the critics that enters the target critics at each update.
      initial_temperature: the entropy's weight at the start.
      learn_temperature: whether the temperature follows the target entropy, -action_dim / 2.
      critic_entropy: whether values count the policy's entropy beside rewards. Where the policy
        must be narrow to do anything, that pays it for being where nothing has to be done.
      prior_weight: weight of staying near the policy it starts from: -log pi_1 of the actor's own
        actions in its loss (BRAC-p, https://arxiv.org/abs/1911.11361). Critics that know only
        pi_1's actions otherwise send the actor where they know nothing.
      reward_scale: factor on the reward.
      normalize_observations: whether networks see observations in units of their running spread.
    """

    num_envs: int = 64
    updates_per_step: int = 8
    batch_size: int = 256
    buffer_capacity: int = 512_000
    warmup_env_steps: int = 6_400
    staggered: bool = later(False)
    critic_warmup_updates: int = 0
    hidden_sizes: tuple[int, ...] = (128, 128)
    critic_layer_norm: bool = later(False)
    learning_rate: float = 3e-4
    discount: float = 0.99
    target_update_rate: float = 0.005
    initial_temperature: float = 1.0
    learn_temperature: bool = True
    critic_entropy: bool = later(True)
    prior_weight: float = 0.0
    reward_scale: float = 1.0
    normalize_observations: bool = False

    def __post_init__(self) -> None:
        for field in ("num_envs", "updates_per_step", "batch_size", "warmup_env_steps"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        require(
            self.buffer_capacity >= self.num_envs and self.buffer_capacity % self.num_envs == 0,
            "buffer_capacity",
            f"a multiple of num_envs ({self.num_envs})",
            self.buffer_capacity,
        )
        require(0.0 < self.discount < 1.0, "discount", "in (0, 1)", self.discount)
        for field in ("learning_rate", "initial_temperature", "reward_scale"):
            require(getattr(self, field) > 0.0, field, "positive", getattr(self, field))
        require(
            self.critic_warmup_updates >= 0,
            "critic_warmup_updates",
            "at least 0",
            self.critic_warmup_updates,
        )
        require(self.prior_weight >= 0.0, "prior_weight", ">= 0", self.prior_weight)
        rate = self.target_update_rate
        require(0.0 < rate <= 1.0, "target_update_rate", "in (0, 1]", rate)
        require(len(self.hidden_sizes) >= 1, "hidden_sizes", "at least one", self.hidden_sizes)
        require_sizes(self.hidden_sizes)

    @property
    def env_steps_per_step(self) -> int:
        """Environment steps of one training step."""
        return self.num_envs


@struct.dataclass
class LearnerState:
    """Everything that gradient updates change.

    Attributes:
      policy_params, q_params, target_q_params: network parameters.
      log_temperature: `[]`.
      policy_opt, q_opt, temperature_opt: optimiser states.
      obs_stats: running statistics of observations (unused without normalisation).
      prior: pi_1, the policy to stay near; None where its weight is 0, or where it starts cold.
    """

    policy_params: Params
    q_params: Params
    target_q_params: Params
    log_temperature: jax.Array
    policy_opt: optax.OptState
    q_opt: optax.OptState
    temperature_opt: optax.OptState
    obs_stats: running_statistics.RunningStatisticsState
    prior: "PolicyParams | None" = None


@struct.dataclass
class SacState:
    """The whole training state: saving and restoring it resumes bit for bit.

    Attributes:
      learner: networks and optimisers.
      buffer: replayed transitions.
      env_state: the `num_envs` running episodes.
      key: PRNG key.
      env_steps: environment steps taken, `[]` int32.
      updates: gradient updates made, `[]` int32.
    """

    learner: LearnerState
    buffer: replay.ReplayBuffer
    env_state: Any
    key: jax.Array
    env_steps: jax.Array
    updates: jax.Array


class PolicyParams(NamedTuple):
    """What acting needs: observation statistics and the actor's parameters."""

    obs_stats: running_statistics.RunningStatisticsState
    policy: Params


class Networks(NamedTuple):
    """Networks, losses and optimiser for one pair of observation and action sizes."""

    sac: sac_networks.SACNetworks
    temperature_loss: Any
    critic_loss: Any
    actor_loss: Any
    optimizer: optax.GradientTransformation


@functools.lru_cache
def make_networks(obs_dim: int, action_dim: int, config: SacConfig) -> Networks:
    """Builds the networks; cheap, and cached."""
    preprocess = (
        running_statistics.normalize
        if config.normalize_observations
        else brax_types.identity_observation_preprocessor
    )
    # Brax keeps example inputs in closures; made under a trace they would be leaked tracers.
    with jax.ensure_compile_time_eval():
        networks = sac_networks.make_sac_networks(
            obs_dim,
            action_dim,
            preprocess_observations_fn=preprocess,
            hidden_layer_sizes=config.hidden_sizes,
            q_network_layer_norm=config.critic_layer_norm,
        )
    losses = sac_losses.make_losses(networks, config.reward_scale, config.discount, action_dim)
    return Networks(networks, *losses, optax.adam(config.learning_rate))


def init_learner(key: jax.Array, obs_dim: int, action_dim: int, config: SacConfig) -> LearnerState:
    """Draws fresh networks."""
    networks = make_networks(obs_dim, action_dim, config)
    key_policy, key_q = jax.random.split(key)
    policy_params = networks.sac.policy_network.init(key_policy)
    q_params = networks.sac.q_network.init(key_q)
    log_temperature = jnp.log(jnp.float32(config.initial_temperature))
    return LearnerState(
        policy_params=policy_params,
        q_params=q_params,
        # A copy: the state is donated, and two leaves must not share one buffer.
        target_q_params=jax.tree.map(jnp.copy, q_params),
        log_temperature=log_temperature,
        policy_opt=networks.optimizer.init(policy_params),
        q_opt=networks.optimizer.init(q_params),
        temperature_opt=networks.optimizer.init(log_temperature),
        obs_stats=running_statistics.init_state(specs.Array((obs_dim,), jnp.dtype("float32"))),
    )


def init(
    key: jax.Array,
    env: Episode,
    config: SacConfig,
    start: Any = None,
    policy_params: PolicyParams | None = None,
    reward_fn: RewardFn | None = None,
    reward_params: Params = None,
) -> SacState:
    """Starts episodes and fills the buffer with `warmup_env_steps` steps.

    Args:
      key: PRNG key.
      env: episodes to learn in.
      config: settings.
      start: `num_envs` stacked episode states to begin in; by default fresh ones without noise.
      policy_params: a policy to start from; the warm-up then follows it. Without one the
        warm-up's actions are uniform.
      reward_fn: the reward stored with the warm-up's transitions; None is the environment's own.
      reward_params: its parameters.

    Returns:
      A state from which `step` goes on.
    """
    obs_dim, action_dim = env.observation_size, env.action_size
    key_learner, key_env, key_warmup, key = jax.random.split(key, 4)
    learner = init_learner(key_learner, obs_dim, action_dim, config)
    if policy_params is not None:
        learner = learner.replace(
            policy_params=policy_params.policy, obs_stats=policy_params.obs_stats
        )
        if config.prior_weight > 0.0:
            # A copy: the state is donated, and two leaves must not share one buffer.
            learner = learner.replace(prior=jax.tree.map(jnp.copy, policy_params))
    if start is None:
        start = jax.vmap(env.reset)(jax.random.split(key_env, config.num_envs))
    if config.staggered:
        key_steps = jax.random.fold_in(key_env, 1)
        steps = jax.random.randint(key_steps, (config.num_envs,), 0, env.horizon)
        start = start.replace(info=start.info | {"steps": steps})
    buffer = replay.init(config.buffer_capacity, obs_dim, action_dim)

    def warm(carry, key):
        env_state, buffer = carry
        if policy_params is None:
            shape = (config.num_envs, action_dim)
            actions = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
        else:
            actions = act(policy_params, env_state.obs, key, config, action_dim)
        after = jax.vmap(env.step)(env_state, actions)
        transitions = with_reward(transition_of(env_state, after), reward_fn, reward_params)
        return (after, replay.insert(buffer, transitions)), transitions.obs_t

    num_steps = -(-config.warmup_env_steps // config.num_envs)
    keys = jax.random.split(key_warmup, num_steps)
    (env_state, buffer), observations = jax.lax.scan(warm, (start, buffer), keys)
    if config.normalize_observations:
        stats = running_statistics.update(learner.obs_stats, observations)
        learner = learner.replace(obs_stats=stats)
    return SacState(
        learner=learner,
        buffer=buffer,
        env_state=env_state,
        key=key,
        env_steps=jnp.asarray(num_steps * config.num_envs, jnp.int32),
        updates=jnp.zeros((), jnp.int32),
    )


def act(
    params: PolicyParams,
    obs_t: jax.Array,
    key: jax.Array,
    config: SacConfig,
    action_dim: int,
    deterministic: bool = False,
) -> jax.Array:
    """Samples actions, or takes their mode, `[..., action_dim]`."""
    networks = make_networks(obs_t.shape[-1], action_dim, config).sac
    logits = networks.policy_network.apply(params.obs_stats, params.policy, obs_t)
    distribution = networks.parametric_action_distribution
    return distribution.mode(logits) if deterministic else distribution.sample(logits, key)


def log_prob(
    params: PolicyParams, obs_t: jax.Array, action_t: jax.Array, config: SacConfig
) -> jax.Array:
    """Log density of executed actions, `[...]`; actions at the bounds are moved inside them."""
    networks = make_networks(obs_t.shape[-1], action_t.shape[-1], config).sac
    logits = networks.policy_network.apply(params.obs_stats, params.policy, obs_t)
    inside = jnp.clip(action_t, -1.0 + 1e-5, 1.0 - 1e-5)
    return networks.parametric_action_distribution.log_prob(logits, jnp.arctanh(inside))


def policy_of(learner: LearnerState) -> PolicyParams:
    """Reads the acting part of a learner."""
    return PolicyParams(learner.obs_stats, learner.policy_params)


def collect(
    state: SacState,
    env: Episode,
    config: SacConfig,
    reward_fn: RewardFn | None = None,
    reward_params: Params = None,
) -> tuple[SacState, Transition]:
    """Takes one step in every environment and stores what happened.

    Returns:
      The next state, and the transitions with the environment's own reward; stored beside them
      is the reward of `reward_fn`, where one is given.
    """
    key_act, key = jax.random.split(state.key)
    learner = state.learner
    actions = act(policy_of(learner), state.env_state.obs, key_act, config, env.action_size)
    env_state = jax.vmap(env.step)(state.env_state, actions)
    transitions = transition_of(state.env_state, env_state)
    if config.normalize_observations:
        stats = running_statistics.update(learner.obs_stats, transitions.obs_t)
        learner = learner.replace(obs_stats=stats)
    stored = with_reward(transitions, reward_fn, reward_params)
    state = state.replace(
        learner=learner,
        buffer=replay.insert(state.buffer, stored),
        env_state=env_state,
        key=key,
        env_steps=state.env_steps + config.num_envs,
    )
    return state, transitions


def with_reward(
    transitions: Transition, reward_fn: RewardFn | None, reward_params: Params
) -> Transition:
    """Replaces the reward by that of `reward_fn`; None keeps the environment's own."""
    if reward_fn is None:
        return transitions
    reward_t = reward_fn(
        reward_params, transitions.obs_t, transitions.action_t, transitions.next_obs_t
    )
    return transitions._replace(reward_t=reward_t)


def update(
    learner: LearnerState,
    batch: Transition,
    key: jax.Array,
    config: SacConfig,
    prior_share: jax.Array | float = 1.0,
) -> tuple[LearnerState, Metrics]:
    """Makes one gradient update of temperature, critics and actor from a batch `[batch_size]`.

    Args:
      learner: networks and optimisers.
      batch: transitions.
      key: PRNG key.
      config: settings.
      prior_share: what is left of the prior's weight, and of a temperature that is not learned.
    """
    networks = make_networks(batch.obs_t.shape[-1], batch.action_t.shape[-1], config)
    key_temperature, key_critic, key_actor = jax.random.split(key, 3)
    transitions = brax_types.Transition(
        observation=batch.obs_t,
        action=batch.action_t,
        reward=batch.reward_t,
        discount=batch.discount_t,
        next_observation=batch.next_obs_t,
        # The stored next observation is the true one, so a time limit needs no masking.
        extras={"state_extras": {"truncation": jnp.zeros_like(batch.reward_t)}},
    )
    temperature = jnp.exp(learner.log_temperature)
    if not config.learn_temperature:
        temperature *= prior_share
    prior_weight = config.prior_weight * prior_share
    critic_loss, q_grads = jax.value_and_grad(networks.critic_loss)(
        learner.q_params,
        learner.policy_params,
        learner.obs_stats,
        learner.target_q_params,
        temperature if config.critic_entropy else jnp.zeros_like(temperature),
        transitions,
        key_critic,
    )
    actor_loss, policy_grads = jax.value_and_grad(_actor_loss)(
        learner.policy_params, learner, networks, temperature, prior_weight, transitions, key_actor
    )
    q_updates, q_opt = networks.optimizer.update(q_grads, learner.q_opt)
    policy_updates, policy_opt = networks.optimizer.update(policy_grads, learner.policy_opt)
    q_params = optax.apply_updates(learner.q_params, q_updates)
    rate = config.target_update_rate
    learner = learner.replace(
        policy_params=optax.apply_updates(learner.policy_params, policy_updates),
        q_params=q_params,
        target_q_params=optax.incremental_update(q_params, learner.target_q_params, rate),
        policy_opt=policy_opt,
        q_opt=q_opt,
    )
    if config.learn_temperature:
        temperature_grad = jax.grad(networks.temperature_loss)(
            learner.log_temperature,
            learner.policy_params,
            learner.obs_stats,
            transitions,
            key_temperature,
        )
        temperature_update, temperature_opt = networks.optimizer.update(
            temperature_grad, learner.temperature_opt
        )
        learner = learner.replace(
            log_temperature=optax.apply_updates(learner.log_temperature, temperature_update),
            temperature_opt=temperature_opt,
        )
    metrics = {
        "critic_loss": critic_loss,
        "actor_loss": actor_loss,
        "temperature": temperature,
        "batch_reward": jnp.mean(batch.reward_t),
    }
    return learner, metrics


def _actor_loss(policy_params, learner, networks, temperature, prior_weight, transitions, key):
    loss = networks.actor_loss(
        policy_params, learner.obs_stats, learner.q_params, temperature, transitions, key
    )
    if learner.prior is None:
        return loss
    policy_network = networks.sac.policy_network
    distribution = networks.sac.parametric_action_distribution
    obs_t, prior = transitions.observation, learner.prior
    logits = policy_network.apply(learner.obs_stats, policy_params, obs_t)
    unbounded_action_t = distribution.sample_no_postprocessing(logits, key)
    logits_prior = policy_network.apply(prior.obs_stats, prior.policy, obs_t)
    log_prior = distribution.log_prob(logits_prior, unbounded_action_t)
    return loss - prior_weight * jnp.mean(log_prior)


def learn(
    state: SacState,
    batches: Transition,
    config: SacConfig,
    prior_share: jax.Array | float = 1.0,
) -> tuple[SacState, Metrics]:
    """Makes one update for each batch, `[num_updates, batch_size]`, in order; see `update`."""
    num_updates = batches.reward_t.shape[0]
    keys = jax.random.split(state.key, num_updates + 1)
    numbers = state.updates + jnp.arange(num_updates)

    def body(learner, inputs):
        batch, key, number = inputs
        updated, metrics = update(learner, batch, key, config, prior_share)
        if config.critic_warmup_updates:
            warming = number < config.critic_warmup_updates
            frozen = updated.replace(
                policy_params=learner.policy_params,
                policy_opt=learner.policy_opt,
                log_temperature=learner.log_temperature,
                temperature_opt=learner.temperature_opt,
            )
            updated = jax.tree.map(lambda a, b: jnp.where(warming, a, b), frozen, updated)
        return updated, metrics

    learner, metrics = jax.lax.scan(body, state.learner, (batches, keys[1:], numbers))
    state = state.replace(learner=learner, key=keys[0], updates=state.updates + num_updates)
    return state, jax.tree.map(jnp.mean, metrics)


def draw(state: SacState, env: Episode, config: SacConfig) -> tuple[SacState, Transition]:
    """Draws the batches of one step, `[updates_per_step, batch_size]`, from the buffer."""
    key_sample, key = jax.random.split(state.key)
    shape = (config.updates_per_step, config.batch_size)
    batches = replay.sample(state.buffer, key_sample, shape, env.observation_size, env.action_size)
    return state.replace(key=key), batches


def step(
    state: SacState,
    env: Episode,
    config: SacConfig,
    reward_fn: RewardFn | None = None,
    reward_params: Params = None,
    recompute_rewards: bool = False,
    prior_share: jax.Array | float = 1.0,
) -> tuple[SacState, Metrics]:
    """Takes one vectorised environment step and learns from the buffer.

    Args:
      state: training state.
      env: episodes to learn in.
      config: settings.
      reward_fn: the reward to maximise; None is the environment's own.
      reward_params: its parameters.
      recompute_rewards: whether the reward is evaluated when a batch is drawn, for a reward that
        changes, rather than once when a transition is stored.
      prior_share: see `update`.

    Returns:
      The next state and metrics, averaged over updates; `env_reward` is the true one.
    """
    state, transitions = collect(state, env, config, reward_fn, reward_params)
    state, batches = draw(state, env, config)
    if recompute_rewards:
        batches = with_reward(batches, reward_fn, reward_params)
    state, metrics = learn(state, batches, config, prior_share)
    return state, {**metrics, "env_reward": jnp.mean(transitions.reward_t)}


def train(
    state: SacState,
    env: Episode,
    config: SacConfig,
    num_steps: int,
    reward_fn: RewardFn | None = None,
    reward_params: Params = None,
    prior_share: jax.Array | float = 1.0,
) -> tuple[SacState, Metrics]:
    """Scans `step`; metrics are averaged over the steps."""

    def body(state, _):
        return step(state, env, config, reward_fn, reward_params, prior_share=prior_share)

    state, metrics = jax.lax.scan(body, state, None, length=num_steps)
    return state, jax.tree.map(jnp.mean, metrics)


def population_axes(state: SacState) -> SacState:
    """Returns vmap axes for a stacked state: 0 everywhere but for the shared counters.

    One number stands for a whole part of the state: Brax's observation counter would turn the
    numbers of its own leaves into arrays, which vmap refuses.
    """
    buffer = replay.ReplayBuffer(data=0, inserted=None)
    return state.replace(learner=0, buffer=buffer, env_state=0, key=0, env_steps=None, updates=None)
