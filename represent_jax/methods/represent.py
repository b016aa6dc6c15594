"""REPRESENT (Xue, Chen, Gombolay; RA-L 2025), Algorithm 1: the stages in order, resumable.

demonstrations -> airl -> noise and curve -> regression -> policies -> evaluation
"""

from collections.abc import Callable
from typing import Any

import jax

from represent_jax.envs import Environment
from represent_jax.errors import unknown
from represent_jax.methods import pipeline
from represent_jax.methods import results as found
from represent_jax.methods.clock import Clock
from represent_jax.methods.config import Problem, RepresentConfig
from represent_jax.runs import RunDirectory
from represent_jax.stages import regression

STAGES = ("airl", "noise", "regression", "policies", "evaluation")


def run(
    config: RepresentConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float = 60.0,
    until: str = STAGES[-1],
) -> dict[str, Any] | None:
    """Runs every stage that is not done yet and returns the results.

    Args:
      config: settings.
      problem: environment, demonstrations, test trajectories.
      directory: where stages are saved as they end, and restored from.
      checkpoint_seconds: least time between two checkpoints of a stage under way.
      until: the last of `STAGES` to run; called again, the run goes on behind it.

    Returns:
      The results, None where the run stopped before its evaluation.

    Raises:
      UsageError: no stage of that name.
      RepresentError: a loss diverged, or Phase 1's reward is not finite.
    """
    if until not in STAGES:
        raise unknown("stage", until, STAGES)
    stage_keys = jax.random.split(jax.random.PRNGKey(config.seed), len(STAGES))
    keys = dict(zip(STAGES, stage_keys, strict=True))
    clock = Clock(directory)
    with clock("airl"):
        first = pipeline.run_airl(keys["airl"], config, problem, directory, checkpoint_seconds)
    if until == "airl":
        return None
    with clock("noise"):
        noisy = pipeline.run_noise(keys["noise"], config, problem, first, directory)
    curves = pipeline.fit_curves(config, noisy)
    if until == "noise":
        return None
    with clock("regression"):
        rewards = pipeline.run_regression(
            keys["regression"], config, problem, noisy, curves, directory, checkpoint_seconds
        )
    if until == "regression":
        return None
    with clock("policies"):
        starts = [jax.tree.map(lambda x, i=i: x[i], first.policy) for i in range(config.num_groups)]
        trained = pipeline.run_policies(
            keys["policies"],
            config,
            problem.env,
            pipeline.objectives_of(config, problem.env, rewards),
            pipeline.reward_fn_of(config),
            starts,
            directory,
            checkpoint_seconds,
        )
    if until == "policies":
        return None
    with clock("evaluation"):
        results = found.evaluate(
            keys["evaluation"], config, problem, first, noisy, curves, rewards, trained, directory
        )
    return clock.finish(results)


def load_rewards(
    config: RepresentConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[..., jax.Array]]:
    """R^0 and every R^i of a run, by target."""
    sizes = (env.observation_size, env.action_size, config.num_groups)
    example = jax.eval_shape(
        lambda key: regression.init(key, *sizes, config.regression), jax.random.PRNGKey(0)
    )
    rewards = directory.load_output("regression", example.rewards)

    def reward_of(strategy):
        return lambda *rows: regression.reward(rewards, *rows, config.regression, strategy)

    names = config.target_names
    return {name: reward_of(i - 1 if i else None) for i, name in enumerate(names)}


def load_policies(
    config: RepresentConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[[jax.Array], jax.Array]]:
    """The policies of a run, by target."""
    return pipeline.load_agents(config.policies, config.target_names, env, directory)
