"""Policies on learned rewards: SAC on R^0 and on every R^i.

The learned reward is used in the unit rho = R * horizon / S, less `center`: a noise-free episode
of Phase 1 then earns about nothing, and an agent that starts from Phase 1's policy is paid only
for getting better. Starting from that policy is what makes improvement reliable: from random
networks, SAC finds local optima of the same reward below what running well would pay.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from represent_jax.agents import rollout as rollouts
from represent_jax.agents import sac
from represent_jax.agents.sac import SacConfig
from represent_jax.config import require
from represent_jax.envs.episode import Episode
from represent_jax.stages import regression
from represent_jax.stages.regression import RegressionConfig
from represent_jax.types import Metrics


@dataclasses.dataclass(frozen=True)
class PoliciesConfig:
    """Settings of policy training on learned rewards.

    Attributes:
      env_steps: budget of each target.
      start: "phase1" starts from Phase 1's policy, "cold" from random networks.
      center: subtracted from rho at every step, unless episodes can end early: there a negative
        reward would pay for ending them.
      eval_env_steps: environment steps between two evaluations.
      eval_episodes: deterministic episodes of an evaluation.
      sac: the agent.
    """

    env_steps: int = 400_000
    start: str = "phase1"
    center: float = 1.0
    eval_env_steps: int = 20_000
    eval_episodes: int = 5
    sac: SacConfig = SacConfig(
        initial_temperature=0.05,
        learning_rate=1e-3,
        warmup_env_steps=19_200,
        critic_warmup_updates=2_000,
    )

    def __post_init__(self) -> None:
        require(self.start in ("phase1", "cold"), "start", "'phase1' or 'cold'", self.start)
        for field in ("env_steps", "eval_env_steps", "eval_episodes"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))


class Target(NamedTuple):
    """A reward to maximise, of the same shape for R^0 and every R^i.

    Attributes:
      heads: the task's and one strategy's parameters.
      strategy_weight: 0 for R^0, alpha_i for R^i, `[]`.
      scale: horizon / S, which turns R into rho, `[]`.
      center: subtracted from rho, `[]`.
    """

    heads: regression.Rewards
    strategy_weight: jax.Array
    scale: jax.Array
    center: jax.Array


class Evaluation(NamedTuple):
    """Deterministic episodes of a policy.

    Attributes:
      true_return: mean return under the environment's reward, `[]`.
      learned_return: mean return under the learned reward, `[]`.
    """

    true_return: jax.Array
    learned_return: jax.Array


def make_target(
    rewards: regression.Rewards,
    strategy: int | None,
    env: Episode,
    config: PoliciesConfig,
    regression_config: RegressionConfig,
) -> Target:
    """Picks R^0 (`strategy=None`) or R^i (counted from 0) as the reward to maximise."""
    heads = regression.Rewards(
        rewards.task, jax.tree.map(lambda leaf: leaf[:, strategy or 0], rewards.strategies)
    )
    weight = 0.0 if strategy is None else regression_config.strategy_weight
    return Target(
        heads,
        jnp.float32(weight),
        jnp.float32(env.horizon / regression_config.return_scale),
        jnp.float32(0.0 if env.terminates else config.center),
    )


def reward(
    target: Target,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: RegressionConfig,
) -> jax.Array:
    """What SAC maximises: rho - center, `[...]`."""
    learned = learned_reward(target, obs_t, action_t, next_obs_t, config)
    return target.scale * learned - target.center


def learned_reward(
    target: Target,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: RegressionConfig,
) -> jax.Array:
    """R^0 or R^i in its own unit, `[...]`."""
    inputs = (obs_t, action_t, next_obs_t, config)
    task = regression.head_reward(target.heads.task, *inputs)
    strategy = regression.head_reward(target.heads.strategies, *inputs)
    return task + target.strategy_weight * strategy


def init(
    key: jax.Array,
    env: Episode,
    target: Target,
    policy: sac.PolicyParams,
    config: PoliciesConfig,
    regression_config: RegressionConfig,
) -> sac.SacState:
    """Starts an agent on a target, from `policy` unless the start is cold."""
    return sac.init(
        key,
        env,
        config.sac,
        policy_params=policy if config.start == "phase1" else None,
        reward_fn=lambda *args: reward(*args, regression_config),
        reward_params=target,
    )


def train(
    state: sac.SacState,
    env: Episode,
    target: Target,
    config: PoliciesConfig,
    regression_config: RegressionConfig,
) -> tuple[sac.SacState, Metrics]:
    """Trains for `eval_env_steps` and evaluates."""
    num_steps = max(1, config.eval_env_steps // config.sac.num_envs)
    state, metrics = sac.train(
        state,
        env,
        config.sac,
        num_steps,
        reward_fn=lambda *args: reward(*args, regression_config),
        reward_params=target,
    )
    key_eval, key = jax.random.split(state.key)
    policy = sac.policy_of(state.learner)
    result = evaluate(key_eval, env, target, policy, config, regression_config)
    return state.replace(key=key), {**metrics, **result._asdict()}


def evaluate(
    key: jax.Array,
    env: Episode,
    target: Target,
    policy: sac.PolicyParams,
    config: PoliciesConfig,
    regression_config: RegressionConfig,
) -> Evaluation:
    """Runs deterministic episodes; the true return is only ever reported, never used."""
    whole = Episode(env.env, env.horizon, auto_reset=False)

    def act(params, obs_t, key):
        return sac.act(params, obs_t, key, config.sac, env.action_size, deterministic=True)

    batch = rollouts.rollout(whole, act, policy, key, jnp.zeros(config.eval_episodes))
    learned = rollouts.learned_returns(
        batch, lambda *args: learned_reward(*args, regression_config), target
    )
    return Evaluation(jnp.mean(rollouts.true_returns(batch)), jnp.mean(learned))
