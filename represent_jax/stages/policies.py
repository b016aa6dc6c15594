"""Policies on learned rewards: SAC, or PPO, on R^0 and on every R^i, or on a baseline's reward.

A learned reward R is used as rho = scale * R - center, where a noise-free episode of Phase 1
earns about 1 a step before the center is subtracted: an agent that starts from Phase 1's policy is
then paid only for getting better. That is the unit of the noise-performance curve, and says little
of how much more the best states pay than others, which a `span` sets instead. Starting from that
policy is what makes improvement reliable: from random networks, SAC finds local optima of the same
reward below what running well would pay.
"""

import dataclasses
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from represent_jax.agents import rollout as rollouts
from represent_jax.agents.ppo import PpoConfig
from represent_jax.agents.registry import find_agent
from represent_jax.agents.sac import PolicyParams, SacConfig
from represent_jax.config import later, require
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.envs.episode import Episode
from represent_jax.errors import RepresentError
from represent_jax.types import Metrics, Params, RewardFn


@dataclasses.dataclass(frozen=True)
class PoliciesConfig:
    """Settings of policy training on learned rewards.

    Attributes:
      env_steps: budget of each target, rounded up to whole evaluations. Those that SAC takes
        before its first update, `sac.warmup_env_steps`, are not counted.
      agent: "sac" or "ppo".
      start: "phase1" starts from Phase 1's policy, "cold" from random networks.
      keep: which policy is handed on: of those evaluated the "best" by learned return, the one
        it started from among them unless that is cold, or the "last".
      center: subtracted from rho at every step, unless episodes can end early: there a negative
        reward would pay for ending them.
      eval_env_steps: environment steps between two evaluations.
      eval_episodes: episodes of an evaluation.
      actions: what policies do where they are evaluated, and once they are handed on: the "mode" of
        their actions, or "sampled" ones, as while learning. A narrow path is learned with its
        noise, and the mode may leave it.
      sac, ppo: the agents.
    """

    env_steps: int = 400_000
    agent: str = "sac"
    start: str = "phase1"
    keep: str = "best"
    center: float = 1.0
    eval_env_steps: int = 20_000
    eval_episodes: int = 5
    actions: str = later("mode")
    sac: SacConfig = SacConfig(
        initial_temperature=0.05,
        learning_rate=1e-3,
        warmup_env_steps=19_200,
        critic_warmup_updates=2_000,
    )
    ppo: PpoConfig = PpoConfig()

    def __post_init__(self) -> None:
        find_agent(self.agent)
        require(self.start in ("phase1", "cold"), "start", "'phase1' or 'cold'", self.start)
        require(self.keep in ("best", "last"), "keep", "'best' or 'last'", self.keep)
        require(self.actions in ("mode", "sampled"), "actions", "'mode' or 'sampled'", self.actions)
        for field in ("env_steps", "eval_env_steps", "eval_episodes"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))


@dataclasses.dataclass(frozen=True)
class TaskPolicyConfig:
    """What is different for the policy on R^0, beside policies on rewards R^i.

    Attributes:
      start: with a warm start, "phase1" starts from the Phase 1 policy that earns most of R^0,
        "clone" from a clone of all demonstrations, which knows every style's states.
      span: what R^0 is scaled to differ by, a step, between the worst and the best of demonstrated
        states. R^i add up to the curve, whose unit they have; R^0 has what R~^i leave it, so that
        in that unit, if none, SAC's temperature and prior weigh more against it.
      prior_half_life: environment steps in which the weights of SAC's prior and of a temperature
        that is not learned halve, seen anew at every evaluation; they stay if none. Critics
        that know little need the prior, those that know R^0 well are held back by it. R~^i sees
        enough to be deceived without it.
    """

    start: str = "phase1"
    span: float | None = None
    prior_half_life: int | None = None

    def __post_init__(self) -> None:
        require(self.start in ("phase1", "clone"), "start", "'phase1' or 'clone'", self.start)
        for field in ("span", "prior_half_life"):
            found = getattr(self, field)
            require(found is None or found > 0, field, "positive, or none", found)


def agent_of(config: PoliciesConfig) -> tuple[ModuleType, SacConfig | PpoConfig]:
    """The agent's module and settings."""
    return find_agent(config.agent), getattr(config, config.agent)


class Objective(NamedTuple):
    """What an agent maximises: scale * R - center, of the same shape for all targets.

    Attributes:
      params: parameters of the learned reward R.
      scale, center: `[]`.
      prior_half_life: environment steps in which the prior's weight halves, `[]`; infinite, or None
        where that goes for all targets, if it stays.
    """

    params: Params
    scale: jax.Array
    center: jax.Array
    prior_half_life: jax.Array | None = None


@struct.dataclass
class PolicyState:
    """Training state of one target.

    Attributes:
      agent: the agent's.
      best: the policy with the highest learned return of those evaluated, the first included.
      best_learned_return: `[]`.
    """

    agent: Any
    best: PolicyParams
    best_learned_return: jax.Array


class Evaluation(NamedTuple):
    """Episodes of a policy.

    Attributes:
      true_return: mean return under the environment's reward, `[]`.
      learned_return: mean return under the learned reward R, `[]`.
    """

    true_return: jax.Array
    learned_return: jax.Array


def make_objective(params: Params, scale: float, env: Episode, config: PoliciesConfig) -> Objective:
    """Centres a reward, unless episodes can end early."""
    center = 0.0 if env.terminates else config.center
    return Objective(params, jnp.float32(scale), jnp.float32(center))


def task_objective(
    objective: Objective,
    demonstrations: TrajectoryBatch,
    config: TaskPolicyConfig,
    reward_fn: RewardFn,
) -> Objective:
    """Makes of an objective on R^0 what its settings ask for.

    Args:
      objective: as for any reward.
      demonstrations: among whose states R^0 is to have the span, `[num_demonstrations]`.
      config: settings.
      reward_fn: the learned reward R.

    Raises:
      RepresentError: R^0 is the same in all of these states, so that no scale makes it differ.
    """
    if config.span is None:
        return objective
    obs_t, next_obs_t = demonstrations.obs[:, :-1], demonstrations.obs[:, 1:]
    reward_t = reward_fn(objective.params, obs_t, demonstrations.actions, next_obs_t)
    happened = demonstrations.mask > 0
    low = jnp.min(reward_t, where=happened, initial=jnp.inf)
    width = jnp.max(reward_t, where=happened, initial=-jnp.inf) - low
    if not width > 0.0:
        raise RepresentError(f"task_policy.span: R^0 is {low:g} in every demonstrated state")
    scale = jnp.float32(config.span / width)
    # The worst of these states pays nothing before the center is subtracted.
    return objective._replace(scale=scale, center=objective.center + scale * low)


def _maximised(reward_fn: RewardFn) -> RewardFn:
    def maximised(objective, obs_t, action_t, next_obs_t):
        learned = reward_fn(objective.params, obs_t, action_t, next_obs_t)
        return objective.scale * learned - objective.center

    return maximised


def init(
    key: jax.Array,
    env: Episode,
    objective: Objective,
    policy: PolicyParams,
    config: PoliciesConfig,
    reward_fn: RewardFn,
) -> PolicyState:
    """Starts an agent on an objective, from `policy` unless the start is cold.

    Args:
      key: PRNG key.
      env: episodes to learn in.
      objective: the reward's parameters, scale and center.
      policy: to start from.
      config: settings.
      reward_fn: the learned reward R.
    """
    agent, settings = agent_of(config)
    state = agent.init(
        key,
        env,
        settings,
        policy_params=policy if config.start == "phase1" else None,
        reward_fn=_maximised(reward_fn),
        reward_params=objective,
    )
    # A copy: the state is donated, and two leaves must not share one buffer.
    best = jax.tree.map(jnp.copy, agent.policy_of(state.learner))
    to_beat = jnp.float32(-jnp.inf)
    if config.start == "phase1":
        key_eval = jax.random.fold_in(key, 0)
        learned = evaluate(key_eval, env, objective, best, config, reward_fn).learned_return
        to_beat = jnp.where(jnp.isfinite(learned), learned, -jnp.inf)
    return PolicyState(state, best, to_beat)


def steps_per_evaluation(config: PoliciesConfig) -> int:
    """The agent's training steps between two evaluations, each of `env_steps_per_step`."""
    _, settings = agent_of(config)
    return max(1, config.eval_env_steps // settings.env_steps_per_step)


def train(
    state: PolicyState,
    env: Episode,
    objective: Objective,
    config: PoliciesConfig,
    reward_fn: RewardFn,
) -> tuple[PolicyState, Metrics]:
    """Trains for `eval_env_steps`, evaluates, and keeps the better policy by learned return."""
    agent, settings = agent_of(config)
    num_steps = steps_per_evaluation(config)
    weaker = {}
    if objective.prior_half_life is not None:
        weaker["prior_share"] = 0.5 ** (state.agent.env_steps / objective.prior_half_life)
    agent_state, metrics = agent.train(
        state.agent,
        env,
        settings,
        num_steps,
        reward_fn=_maximised(reward_fn),
        reward_params=objective,
        **weaker,
    )
    key_eval, key = jax.random.split(agent_state.key)
    policy = agent.policy_of(agent_state.learner)
    result = evaluate(key_eval, env, objective, policy, config, reward_fn)
    better = result.learned_return > state.best_learned_return
    state = PolicyState(
        agent=agent_state.replace(key=key),
        best=jax.tree.map(lambda new, old: jnp.where(better, new, old), policy, state.best),
        best_learned_return=jnp.where(better, result.learned_return, state.best_learned_return),
    )
    return state, {**metrics, **result._asdict()}


def finish(state: PolicyState, config: PoliciesConfig) -> PolicyParams:
    """Reads the policy that is handed on."""
    if config.keep == "best":
        return state.best
    return agent_of(config)[0].policy_of(state.agent.learner)


def population_axes(state: PolicyState, config: PoliciesConfig) -> PolicyState:
    """Returns vmap axes for a stacked state: 0 everywhere but for the agent's counters."""
    agent, _ = agent_of(config)
    return PolicyState(agent.population_axes(state.agent), best=0, best_learned_return=0)


def evaluate(
    key: jax.Array,
    env: Episode,
    objective: Objective,
    policy: PolicyParams,
    config: PoliciesConfig,
    reward_fn: RewardFn,
) -> Evaluation:
    """Runs episodes; the true return is only ever reported, never used."""
    batch = rollout(key, env, policy, config.eval_episodes, config)
    learned = rollouts.learned_returns(batch, reward_fn, objective.params)
    return Evaluation(jnp.mean(rollouts.true_returns(batch)), jnp.mean(learned))


def act(
    policy: PolicyParams,
    obs_t: jax.Array,
    action_dim: int,
    config: PoliciesConfig,
    key: jax.Array | None = None,
) -> jax.Array:
    """What a policy does where it is used, `[..., action_dim]`.

    Without a key it is a pure function of observations: noise of sampled actions is drawn from the
    observation's own bits, so that equal observations get equal actions, and episodes that begin
    alike where physics has no chance in it stay alike.
    """
    agent, settings = agent_of(config)
    mode = config.actions == "mode"
    if mode or key is not None:
        # The mode draws nothing from the key.
        key = jax.random.PRNGKey(0) if key is None else key
        return agent.act(policy, obs_t, key, settings, action_dim, deterministic=mode)

    def one(obs_t):
        bits = jax.lax.bitcast_convert_type(obs_t.astype(jnp.float32), jnp.uint32)
        key, _ = jax.lax.scan(
            lambda key, word: (jax.random.fold_in(key, word), None), jax.random.PRNGKey(0), bits
        )
        return agent.act(policy, obs_t, key, settings, action_dim)

    flat = jnp.reshape(obs_t, (-1, obs_t.shape[-1]))
    return jax.vmap(one)(flat).reshape(*obs_t.shape[:-1], action_dim)


def rollout(
    key: jax.Array,
    env: Episode,
    policy: PolicyParams,
    num_episodes: int,
    config: PoliciesConfig,
) -> TrajectoryBatch:
    """Runs episodes of the agent's policy, `[num_episodes]`."""
    whole = Episode(env.env, env.horizon, auto_reset=False)
    agent, settings = agent_of(config)
    mode = config.actions == "mode"

    def act(params, obs_t, key):
        return agent.act(params, obs_t, key, settings, env.action_size, deterministic=mode)

    return rollouts.rollout(whole, act, policy, key, jnp.zeros(num_episodes))
