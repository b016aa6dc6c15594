"""REPRESENT (Xue, Chen, Gombolay; RA-L 2025), Algorithm 1, as a plan of stages.

demonstrations -> airl -> noise -> curve -> regression -> policies -> selection, each judged as it
ends
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from represent_jax.agents import cloning
from represent_jax.agents import rollout as rollouts
from represent_jax.data.trajectories import pad
from represent_jax.envs import Environment
from represent_jax.methods import pipeline, policy_learning, results
from represent_jax.methods.config import Problem, RepresentConfig
from represent_jax.methods.plan import Stage
from represent_jax.methods.policy_learning import Trained
from represent_jax.methods.population import member_of
from represent_jax.runs import RunDirectory
from represent_jax.stages import airl, decomposition, policies
from represent_jax.types import Params, RewardFn


def plan(
    config: RepresentConfig, problem: Problem, checkpoint_seconds: float = 60.0
) -> tuple[Stage, ...]:
    """The stages of REPRESENT; see `methods.plan.execute`."""

    def regress(key, directory, noisy, curves):
        return pipeline.run_regression(
            key, config, problem, noisy, curves, directory, checkpoint_seconds
        )

    return (
        *first_stages(config, problem, checkpoint_seconds),
        Stage(
            "regression",
            regress,
            ("noise", "curve"),
            {"regression": config.regression},
            revision=config.regression.revision,
        ),
        *last_stages(
            config,
            problem,
            checkpoint_seconds,
            views=lambda rewards: _views(config, rewards),
            rewards_of=lambda rewards: rewards_of(config, rewards),
        ),
    )


def first_stages(
    config: RepresentConfig, problem: Problem, checkpoint_seconds: float
) -> tuple[Stage, ...]:
    """Phases 1 and 2."""

    def imitate(key, directory):
        return pipeline.run_airl(key, config, problem, directory, checkpoint_seconds)

    def judge_imitation(key, directory, first):
        return results.judge_airl(key, config.airl, problem, first, config.noise.actions)

    def roll_out(key, directory, first):
        return pipeline.run_noise(key, config, problem, first, directory)

    def fit(key, directory, first, noisy):
        return pipeline.fit_curves(config, problem, first, noisy)

    # Samples are what was judged before there was a choice.
    judged = {"actions": "mode"} if config.noise.actions == "mode" else {}
    stages = (
        Stage("airl", imitate, (), {"airl": config.airl, "population": config.population}),
        Stage("airl_evaluation", judge_imitation, ("airl",), judged, reports=True),
        Stage("noise", roll_out, ("airl",), {"noise": config.noise}),
        Stage("curve", fit, ("airl", "noise"), {"curve": config.curve}),
    )
    return tuple(dataclasses.replace(stage, before_rewards=True) for stage in stages)


def last_stages(
    config: RepresentConfig,
    problem: Problem,
    checkpoint_seconds: float,
    views: Callable[[Any], dict[str, Params]],
    rewards_of: Callable[[Any], dict[str, Callable[..., jax.Array]]],
    reward_fn: RewardFn | None = None,
) -> tuple[Stage, ...]:
    """What follows a regression: its rewards judged, policies on them, and these judged.

    Args:
      config: settings.
      problem: environment, demonstrations, test trajectories.
      checkpoint_seconds: least time between two checkpoints.
      views: from what the regression returned to its rewards, by target, as parameters.
      rewards_of: the same as functions `reward(obs_t, action_t, next_obs_t)`.
      reward_fn: `reward_fn(one of views, obs_t, action_t, next_obs_t)`; that of a
        `decomposition.View` if None.
    """
    reward_fn = reward_fn or _reward_fn(config)

    def judge_rewards(key, directory, noisy, curves, rewards):
        groups = results.noisy_groups(config, noisy)
        learned = results.learned_returns(rewards_of(rewards))
        return {
            "curve": results.describe_curves(curves),
            "rewards": results.judge_rewards(problem, groups, learned, directory),
        }

    def train(key, directory, first, rewards) -> Trained:
        key_start, key = jax.random.split(key)
        objectives = _objectives(config, problem, views(rewards), reward_fn)

        def starts():
            return _starts(key_start, config, problem, objectives, first, reward_fn)

        return policy_learning.run(
            key,
            config.policies,
            config.population,
            problem.env,
            list(objectives.values()),
            reward_fn,
            None if config.policies.start == "cold" else starts,
            directory,
            checkpoint_seconds,
        )

    def select(key, directory, rewards, trained) -> Trained:
        objectives = _objectives(config, problem, views(rewards), reward_fn)
        chosen = config.selection
        margins = [
            chosen.task_margin if name == "task" else chosen.strategy_margin for name in objectives
        ]
        task, floors = None, None
        if chosen.task_floor:
            task = _objective(config, problem, "task", views(rewards)["task"], reward_fn)
            floors = task_floors(config, problem, reward_fn, task.params)
        return policy_learning.select(
            key,
            config.policies,
            margins,
            problem.env,
            list(objectives.values()),
            reward_fn,
            trained,
            directory,
            task,
            floors,
        )

    def judge_policies(key, directory, rewards, trained):
        episodes = results.agents_episodes(
            config.policies, problem.env, config.policy_names, trained
        )
        learned = results.learned_returns(rewards_of(rewards))
        found = results.judge_policies(
            key, config, problem, episodes, learned, trained.log, directory
        )
        return found | results.describe_selection(config, trained)

    settings = {"policies": config.policies, "population": config.population}
    if config.policy_names != config.target_names:
        settings["policy_targets"] = config.policy_names
    if config.task_policy != policies.TaskPolicyConfig():
        settings["task_policy"] = config.task_policy
    selection, handed_on = (), "policies"
    if config.selects:
        selection = (
            Stage(
                "selection",
                select,
                ("regression", "policies"),
                {"selection": config.selection},
                # A floor is what whole demonstrations earn.
                sees_pauses=config.selection.task_floor,
            ),
        )
        handed_on = "selection"
    return (
        Stage(
            "reward_evaluation",
            judge_rewards,
            ("noise", "curve", "regression"),
            config.names,
            reports=True,
        ),
        Stage("policies", train, ("airl", "regression"), settings),
        *selection,
        Stage(
            "policy_evaluation",
            judge_policies,
            ("regression", handed_on),
            config.names,
            reports=True,
        ),
    )


def rewards_of(
    config: RepresentConfig, rewards: decomposition.Rewards
) -> dict[str, Callable[..., jax.Array]]:
    """R^0 and every R^i that there is, by target."""

    def reward_of(strategy):
        return lambda *rows: decomposition.reward(rewards, *rows, config.regression, strategy)

    return {name: reward_of(i - 1 if i else None) for i, name in enumerate(config.target_names)}


def load_rewards(
    config: RepresentConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[..., jax.Array]]:
    """R^0 and every R^i of a run, by target."""
    sizes = (env.observation_size, env.action_size, config.num_groups)
    example = decomposition.example(*sizes, config.regression)
    return rewards_of(config, directory.load_output("regression", example))


def _views(
    config: RepresentConfig, rewards: decomposition.Rewards
) -> dict[str, decomposition.View]:
    return {
        name: decomposition.view(rewards, i - 1 if i else None, config.regression)
        for i, name in enumerate(config.target_names)
    }


def _reward_fn(config: RepresentConfig) -> RewardFn:
    """R^0 or R^i as a function of its `decomposition.View`."""

    def reward_fn(view, obs_t, action_t, next_obs_t):
        return decomposition.view_reward(view, obs_t, action_t, next_obs_t, config.regression)

    return reward_fn


def _objectives(
    config: RepresentConfig, problem: Problem, views: dict[str, Params], reward_fn: RewardFn
) -> dict[str, policies.Objective]:
    return {
        name: _objective(config, problem, name, view, reward_fn)
        for name, view in views.items()
        if name in config.policy_names
    }


def _objective(
    config: RepresentConfig, problem: Problem, name: str, view: Params, reward_fn: RewardFn
) -> policies.Objective:
    """What is maximised for the target called `name`; of one structure for all."""
    env, different = problem.env, config.task_policy
    scale = env.horizon / config.regression.return_scale
    objective = policies.make_objective(view, scale, env, config.policies)
    if name == "task":
        every = pad(problem.demonstrations.trajectories, env.horizon)
        objective = policies.task_objective(objective, every, different, reward_fn)
    if different.prior_half_life is None:
        return objective
    steps = different.prior_half_life if name == "task" else jnp.inf
    return objective._replace(prior_half_life=jnp.float32(steps))


def task_floors(
    config: RepresentConfig, problem: Problem, reward_fn: RewardFn, task: Params
) -> list[float]:
    """What the demonstrators behind each of `policy_names` earn of R^0 on average.

    Nothing is asked of the task's own policy, so its floor is minus infinity.
    """
    earned = {"task": -float("inf")}
    for i, name in enumerate(config.target_names[1:]):
        batch = pad(problem.demonstrations.of_strategy(i), problem.env.horizon)
        earned[name] = float(jnp.mean(rollouts.learned_returns(batch, reward_fn, task)))
    return [earned[name] for name in config.policy_names]


def _starts(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    objectives: dict[str, policies.Objective],
    first: airl.AirlOutput,
    reward_fn: RewardFn,
) -> Sequence[policies.PolicyParams]:
    """Phase 1's policy of each strategy; for the task see `TaskPolicyConfig.start`."""
    own = {name: member_of(first.policy, i) for i, name in enumerate(config.group_names)}

    def start_of(name, objective):
        if name in own:
            return own[name]
        if config.clones_for_task:
            return clone_all(key, config, problem)
        candidates = list(own.values())
        return policy_learning.best_start(
            key, problem.env, objective, candidates, config.policies, reward_fn
        )

    return [start_of(name, objective) for name, objective in objectives.items()]


def clone_all(key: jax.Array, config: RepresentConfig, problem: Problem) -> policies.PolicyParams:
    """A clone of all demonstrations, as Phase 1 clones those of a strategy."""
    module, settings = policies.agent_of(config.policies)
    rows = pipeline.transitions(problem.lessons.trajectories)
    num_updates, noise = config.airl.cloning_updates, config.airl.cloning_noise

    @jax.jit
    def clone(key, rows):
        keys = jax.random.split(key)
        return cloning.start(*keys, module, settings, problem.env, rows, num_updates, noise)

    return clone(key, rows)
