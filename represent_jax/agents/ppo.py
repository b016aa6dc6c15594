"""Proximal Policy Optimization (https://arxiv.org/abs/1707.06347) on Brax's losses and networks.

A step is one unroll of every environment followed by `num_epochs` passes over it. The policy is
of SAC's family, so that either agent can start from the other's. The density that a ratio is
taken of is that of the action the policy drew, before the environment's action noise; rewards see
what a transition stores, the action that was executed.

Brax's loss drops the transitions on which episodes are cut off. Here the value of the true final
observation is added to their reward, and their return ends there.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training import types as brax_types
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses as ppo_losses
from brax.training.agents.ppo import networks as ppo_networks
from flax import linen, struct

from represent_jax.agents.sac import PolicyParams, with_reward
from represent_jax.config import require, require_sizes
from represent_jax.envs.episode import Episode, transition_of
from represent_jax.types import Metrics, Params, RewardFn, Transition


@dataclasses.dataclass(frozen=True)
class PpoConfig:
    """Settings of the agent.

    Attributes:
      num_envs: environments stepped together, a multiple of `num_minibatches`.
      unroll_length: steps of every environment between two rounds of updates.
      num_epochs: passes over an unroll.
      num_minibatches: updates in a pass, each on the unrolls of other environments.
      hidden_sizes: units of the hidden layers of actor and critic.
      learning_rate: Adam's step size of actor and critic.
      discount: discount factor of an environment step.
      gae_lambda: weight of longer returns in the generalised advantage estimate.
      clip_epsilon: how far from 1 a probability ratio may go before its gradient is cut.
      entropy_weight: weight of the policy's entropy.
      normalize_advantages: whether advantages have mean 0 and spread 1 in every minibatch.
      reward_scale: factor on the reward.
      normalize_observations: whether networks see observations in units of their running spread.
    """

    num_envs: int = 64
    unroll_length: int = 32
    num_epochs: int = 8
    num_minibatches: int = 8
    hidden_sizes: tuple[int, ...] = (128, 128)
    learning_rate: float = 3e-4
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip_epsilon: float = 0.2
    entropy_weight: float = 1e-3
    normalize_advantages: bool = True
    reward_scale: float = 1.0
    normalize_observations: bool = False

    def __post_init__(self) -> None:
        for field in ("num_envs", "unroll_length", "num_epochs", "num_minibatches"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        require(
            self.num_envs % self.num_minibatches == 0,
            "num_envs",
            f"a multiple of num_minibatches ({self.num_minibatches})",
            self.num_envs,
        )
        for field in ("learning_rate", "reward_scale"):
            require(getattr(self, field) > 0.0, field, "positive", getattr(self, field))
        require_sizes(self.hidden_sizes)
        require(0.0 < self.discount < 1.0, "discount", "in (0, 1)", self.discount)
        require(0.0 <= self.gae_lambda <= 1.0, "gae_lambda", "in [0, 1]", self.gae_lambda)
        require(self.clip_epsilon > 0.0, "clip_epsilon", "positive", self.clip_epsilon)
        require(self.entropy_weight >= 0.0, "entropy_weight", ">= 0", self.entropy_weight)

    @property
    def env_steps_per_step(self) -> int:
        """Environment steps of one training step."""
        return self.num_envs * self.unroll_length


@struct.dataclass
class LearnerState:
    """Everything that gradient updates change.

    Attributes:
      policy_params, value_params: network parameters.
      opt: optimiser state of both.
      obs_stats: running statistics of observations (unused without normalisation).
    """

    policy_params: Params
    value_params: Params
    opt: optax.OptState
    obs_stats: running_statistics.RunningStatisticsState


@struct.dataclass
class PpoState:
    """The whole training state: saving and restoring it resumes bit for bit.

    Attributes:
      learner: networks and optimiser.
      env_state: the `num_envs` running episodes.
      key: PRNG key.
      env_steps: environment steps taken, `[]` int32.
      updates: gradient updates made, `[]` int32.
    """

    learner: LearnerState
    env_state: Any
    key: jax.Array
    env_steps: jax.Array
    updates: jax.Array


class Rollout(NamedTuple):
    """One unroll of every environment, `[unroll_length, num_envs]`.

    Attributes:
      transitions: what the steps stored.
      truncated_t: 1 where an episode was cut off by the time limit, `[...]`.
      raw_action_t: what the policy drew, before tanh and before noise, `[..., action_dim]`.
      log_prob_t: log density of the drawn action, `[...]`.
      logits_t: parameters of the distribution it was drawn from, `[..., 2 * action_dim]`.
    """

    transitions: Transition
    truncated_t: jax.Array
    raw_action_t: jax.Array
    log_prob_t: jax.Array
    logits_t: jax.Array


class Networks(NamedTuple):
    """Networks, loss and optimiser for one pair of observation and action sizes."""

    ppo: ppo_networks.PPONetworks
    loss: Any
    optimizer: optax.GradientTransformation


@functools.lru_cache
def make_networks(obs_dim: int, action_dim: int, config: PpoConfig) -> Networks:
    """Builds the networks; cheap, and cached."""
    preprocess = (
        running_statistics.normalize
        if config.normalize_observations
        else brax_types.identity_observation_preprocessor
    )
    # Brax keeps example inputs in closures; made under a trace they would be leaked tracers.
    with jax.ensure_compile_time_eval():
        networks = ppo_networks.make_ppo_networks(
            obs_dim,
            action_dim,
            preprocess_observations_fn=preprocess,
            policy_hidden_layer_sizes=config.hidden_sizes,
            value_hidden_layer_sizes=config.hidden_sizes,
            activation=linen.relu,
        )
    loss = functools.partial(
        ppo_losses.compute_ppo_loss,
        ppo_network=networks,
        entropy_cost=config.entropy_weight,
        discounting=config.discount,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clip_epsilon,
        normalize_advantage=config.normalize_advantages,
    )
    return Networks(networks, loss, optax.adam(config.learning_rate))


def init_learner(key: jax.Array, obs_dim: int, action_dim: int, config: PpoConfig) -> LearnerState:
    """Draws fresh networks."""
    networks = make_networks(obs_dim, action_dim, config)
    key_policy, key_value = jax.random.split(key)
    policy_params = networks.ppo.policy_network.init(key_policy)
    value_params = networks.ppo.value_network.init(key_value)
    return LearnerState(
        policy_params=policy_params,
        value_params=value_params,
        opt=networks.optimizer.init(ppo_losses.PPONetworkParams(policy_params, value_params)),
        obs_stats=running_statistics.init_state(specs.Array((obs_dim,), jnp.dtype("float32"))),
    )


def init(
    key: jax.Array,
    env: Episode,
    config: PpoConfig,
    start: Any = None,
    policy_params: PolicyParams | None = None,
    reward_fn: RewardFn | None = None,
    reward_params: Params = None,
) -> PpoState:
    """Starts episodes.

    Args:
      key: PRNG key.
      env: episodes to learn in.
      config: settings.
      start: `num_envs` stacked episode states to begin in; by default fresh ones without noise.
      policy_params: a policy to start from, of PPO or of SAC with the same `hidden_sizes`.
      reward_fn, reward_params: unused, for the shape that agents share; nothing is stored here.

    Returns:
      A state from which `step` goes on.
    """
    del reward_fn, reward_params
    key_learner, key_env, key = jax.random.split(key, 3)
    learner = init_learner(key_learner, env.observation_size, env.action_size, config)
    if policy_params is not None:
        learner = learner.replace(
            policy_params=policy_params.policy, obs_stats=policy_params.obs_stats
        )
    if start is None:
        start = jax.vmap(env.reset)(jax.random.split(key_env, config.num_envs))
    return PpoState(
        learner=learner,
        env_state=start,
        key=key,
        env_steps=jnp.zeros((), jnp.int32),
        updates=jnp.zeros((), jnp.int32),
    )


def act(
    params: PolicyParams,
    obs_t: jax.Array,
    key: jax.Array,
    config: PpoConfig,
    action_dim: int,
    deterministic: bool = False,
) -> jax.Array:
    """Samples actions, or takes their mode, `[..., action_dim]`."""
    networks = make_networks(obs_t.shape[-1], action_dim, config).ppo
    logits = networks.policy_network.apply(params.obs_stats, params.policy, obs_t)
    distribution = networks.parametric_action_distribution
    return distribution.mode(logits) if deterministic else distribution.sample(logits, key)


def log_prob(
    params: PolicyParams, obs_t: jax.Array, action_t: jax.Array, config: PpoConfig
) -> jax.Array:
    """Log density of executed actions, `[...]`; actions at the bounds are moved inside them."""
    networks = make_networks(obs_t.shape[-1], action_t.shape[-1], config).ppo
    logits = networks.policy_network.apply(params.obs_stats, params.policy, obs_t)
    inside = jnp.clip(action_t, -1.0 + 1e-5, 1.0 - 1e-5)
    return networks.parametric_action_distribution.log_prob(logits, jnp.arctanh(inside))


def value(learner: LearnerState, obs_t: jax.Array, action_dim: int, config: PpoConfig) -> jax.Array:
    """The critic's V(s), of scaled rewards, `[...]`."""
    networks = make_networks(obs_t.shape[-1], action_dim, config).ppo
    return networks.value_network.apply(learner.obs_stats, learner.value_params, obs_t)


def policy_of(learner: LearnerState) -> PolicyParams:
    """Reads the acting part of a learner."""
    return PolicyParams(learner.obs_stats, learner.policy_params)


def collect(state: PpoState, env: Episode, config: PpoConfig) -> tuple[PpoState, Rollout]:
    """Unrolls every environment.

    Returns:
      The next state, and what happened, with the environment's own reward.
    """
    key_act, key = jax.random.split(state.key)
    learner = state.learner
    networks = make_networks(env.observation_size, env.action_size, config).ppo
    distribution = networks.parametric_action_distribution

    def body(env_state, key):
        logits_t = networks.policy_network.apply(
            learner.obs_stats, learner.policy_params, env_state.obs
        )
        raw_action_t = distribution.sample_no_postprocessing(logits_t, key)
        after = jax.vmap(env.step)(env_state, distribution.postprocess(raw_action_t))
        return after, Rollout(
            transitions=transition_of(env_state, after),
            truncated_t=after.info["truncated"].astype(jnp.float32),
            raw_action_t=raw_action_t,
            log_prob_t=distribution.log_prob(logits_t, raw_action_t),
            logits_t=logits_t,
        )

    keys = jax.random.split(key_act, config.unroll_length)
    env_state, rollout = jax.lax.scan(body, state.env_state, keys)
    env_steps = state.env_steps + config.unroll_length * config.num_envs
    return state.replace(env_state=env_state, key=key, env_steps=env_steps), rollout


def bootstrap(learner: LearnerState, rollout: Rollout, config: PpoConfig) -> Rollout:
    """Scales rewards and ends returns at time limits with the value of the final observation."""
    transitions = rollout.transitions
    action_dim = transitions.action_t.shape[-1]
    final_value_t = value(learner, transitions.next_obs_t, action_dim, config)
    reward_t = config.reward_scale * transitions.reward_t
    transitions = transitions._replace(
        reward_t=reward_t + config.discount * rollout.truncated_t * final_value_t,
        discount_t=transitions.discount_t * (1.0 - rollout.truncated_t),
    )
    return rollout._replace(transitions=transitions)


def update(
    learner: LearnerState, batch: Rollout, key: jax.Array, config: PpoConfig
) -> tuple[LearnerState, Metrics]:
    """Makes one gradient update of actor and critic.

    Args:
      learner: networks and optimiser.
      batch: bootstrapped unrolls, `[unroll_length, num_envs / num_minibatches]`.
      key: PRNG key.
      config: settings.
    """
    rows = batch.transitions
    networks = make_networks(rows.obs_t.shape[-1], rows.action_t.shape[-1], config)
    data = brax_types.Transition(
        observation=rows.obs_t,
        action=rows.action_t,
        reward=rows.reward_t,
        discount=rows.discount_t,
        next_observation=rows.next_obs_t,
        extras={
            # Time limits are in reward and discount already.
            "state_extras": {"truncation": jnp.zeros_like(rows.reward_t)},
            "policy_extras": {
                "raw_action": batch.raw_action_t,
                "log_prob": batch.log_prob_t,
                "distribution_params": batch.logits_t,
            },
        },
    )
    data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)
    params = ppo_losses.PPONetworkParams(learner.policy_params, learner.value_params)
    grads, losses = jax.grad(networks.loss, has_aux=True)(params, learner.obs_stats, data, key)
    updates, opt = networks.optimizer.update(grads, learner.opt)
    params = optax.apply_updates(params, updates)
    metrics = {
        "critic_loss": losses["v_loss"],
        "actor_loss": losses["policy_loss"],
        "kl": losses["kl_mean"],
        "raw_action_std": losses["policy_dist_mean_std"],
    }
    return learner.replace(policy_params=params.policy, value_params=params.value, opt=opt), metrics


def learn(state: PpoState, rollout: Rollout, config: PpoConfig) -> tuple[PpoState, Metrics]:
    """Makes `num_epochs * num_minibatches` updates; metrics are averaged over them."""
    key_epochs, key = jax.random.split(state.key)
    data = bootstrap(state.learner, rollout, config)

    def minibatches(x, order):
        split = x[:, order].reshape(x.shape[0], config.num_minibatches, -1, *x.shape[2:])
        return jnp.swapaxes(split, 0, 1)

    def epoch(learner, key):
        key_order, key_loss = jax.random.split(key)
        order = jax.random.permutation(key_order, config.num_envs)
        batches = jax.tree.map(lambda x: minibatches(x, order), data)
        keys = jax.random.split(key_loss, config.num_minibatches)
        return jax.lax.scan(
            lambda learner, inputs: update(learner, *inputs, config), learner, (batches, keys)
        )

    keys = jax.random.split(key_epochs, config.num_epochs)
    learner, metrics = jax.lax.scan(epoch, state.learner, keys)
    if config.normalize_observations:
        # Only now: ratios compare with densities under the statistics that actions were drawn with.
        stats = running_statistics.update(learner.obs_stats, rollout.transitions.obs_t)
        learner = learner.replace(obs_stats=stats)
    updates = state.updates + config.num_epochs * config.num_minibatches
    metrics = {
        **jax.tree.map(jnp.mean, metrics),
        "batch_reward": jnp.mean(rollout.transitions.reward_t),
    }
    return state.replace(learner=learner, key=key, updates=updates), metrics


def step(
    state: PpoState,
    env: Episode,
    config: PpoConfig,
    reward_fn: RewardFn | None = None,
    reward_params: Params = None,
) -> tuple[PpoState, Metrics]:
    """Unrolls every environment and learns from what happened.

    Args:
      state: training state.
      env: episodes to learn in.
      config: settings.
      reward_fn: the reward to maximise; None is the environment's own.
      reward_params: its parameters.

    Returns:
      The next state and metrics, averaged over updates; `env_reward` is the true one.
    """
    state, rollout = collect(state, env, config)
    rewarded = with_reward(rollout.transitions, reward_fn, reward_params)
    state, metrics = learn(state, rollout._replace(transitions=rewarded), config)
    return state, {**metrics, "env_reward": jnp.mean(rollout.transitions.reward_t)}


def train(
    state: PpoState,
    env: Episode,
    config: PpoConfig,
    num_steps: int,
    reward_fn: RewardFn | None = None,
    reward_params: Params = None,
) -> tuple[PpoState, Metrics]:
    """Scans `step`; metrics are averaged over the steps."""
    state, metrics = jax.lax.scan(
        lambda state, _: step(state, env, config, reward_fn, reward_params),
        state,
        None,
        length=num_steps,
    )
    return state, jax.tree.map(jnp.mean, metrics)


def population_axes(state: PpoState) -> PpoState:
    """Returns vmap axes for a stacked state: 0 everywhere but for the shared counters.

    One number stands for a whole part of the state: Brax's observation counter would turn the
    numbers of its own leaves into arrays, which vmap refuses.
    """
    return state.replace(learner=0, env_state=0, key=0, env_steps=None, updates=None)
