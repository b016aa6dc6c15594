"""AIRL (https://arxiv.org/abs/1710.11248) and Noisy-AIRL alone: Phase 1 as a method of its own.

Every strategy has the reward g of its discriminator, and the generator that was trained against it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from represent_jax.config import require
from represent_jax.envs import Environment, Episode
from represent_jax.methods import pipeline, results
from represent_jax.methods.config import MethodConfig, Problem
from represent_jax.methods.plan import Stage
from represent_jax.methods.population import member_of
from represent_jax.runs import RunDirectory
from represent_jax.stages import airl
from represent_jax.stages.airl import AirlConfig


@dataclasses.dataclass(frozen=True)
class NoisyAirlMethodConfig(MethodConfig):
    """Settings of Noisy-AIRL.

    Attributes:
      airl: settings of the stage.
    """

    method: str = "noisy_airl"
    airl: AirlConfig = AirlConfig()

    @property
    def target_names(self) -> tuple[str, ...]:
        """One for every strategy: a task's reward is not learned."""
        return self.group_names

    @property
    def needs_actions(self) -> str:
        """What in Phase 1 needs them."""
        return self.airl.needs_actions


@dataclasses.dataclass(frozen=True)
class AirlMethodConfig(NoisyAirlMethodConfig):
    """Settings of AIRL: those of Noisy-AIRL, without noise."""

    method: str = "airl"
    airl: AirlConfig = AirlConfig(noisy=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        expected = "false, with noise it is method noisy_airl"
        require(not self.airl.noisy, "airl.noisy", expected, self.airl.noisy)


def configure_airl(settings: dict[str, Any]) -> dict[str, Any]:
    """Turns the settings of a preset and a domain into AIRL's."""
    return settings | {"airl": dataclasses.replace(settings["airl"], noisy=False)}


def plan(
    config: NoisyAirlMethodConfig, problem: Problem, checkpoint_seconds: float = 60.0
) -> tuple[Stage, ...]:
    """The stages of either; see `methods.plan.execute`."""
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)

    def imitate(key, directory):
        return pipeline.run_airl(key, config, problem, directory, checkpoint_seconds)

    def judge_imitation(key, directory, output):
        return results.judge_airl(key, config.airl, problem, output)

    def judge_rewards(key, directory, output):
        learned = results.learned_returns(_rewards_of(config, output))
        return {"rewards": results.judge_rewards(problem, {}, learned, directory)}

    def judge_policies(key, directory, output):
        def policy(params, obs_t, key):
            return airl.act(params, obs_t, key, config.airl, env.action_size, deterministic=True)

        episodes = results.generators_episodes(env, config.group_names, output.policy, policy)
        learned = results.learned_returns(_rewards_of(config, output))
        return results.judge_policies(key, config, problem, episodes, learned, (), directory)

    settings = {"airl": config.airl, "population": config.population}
    return (
        Stage("airl", imitate, (), settings, before_rewards=True),
        Stage("airl_evaluation", judge_imitation, ("airl",), reports=True, before_rewards=True),
        Stage("reward_evaluation", judge_rewards, ("airl",), config.names, reports=True),
        Stage("policy_evaluation", judge_policies, ("airl",), config.names, reports=True),
    )


def load_rewards(
    config: NoisyAirlMethodConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[..., jax.Array]]:
    """The discriminators' rewards of a run, by strategy."""
    return _rewards_of(config, _load(config, env, directory))


def load_policies(
    config: NoisyAirlMethodConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[[jax.Array], jax.Array]]:
    """The modes of a run's generators, by strategy."""
    stacked = _load(config, env, directory).policy
    unused = jax.random.PRNGKey(0)

    def policy_of(params):
        return lambda obs, key=None: airl.act(
            params, obs, unused, config.airl, env.action_size, deterministic=True
        )

    return {name: policy_of(member_of(stacked, i)) for i, name in enumerate(config.group_names)}


def _rewards_of(
    config: NoisyAirlMethodConfig, output: airl.AirlOutput
) -> dict[str, Callable[..., jax.Array]]:
    def reward_of(params):
        return lambda *rows: airl.reward(params, *rows, config.airl)

    return {
        name: reward_of(member_of(output.reward, i)) for i, name in enumerate(config.group_names)
    }


def _load(
    config: NoisyAirlMethodConfig, env: Environment, directory: RunDirectory
) -> airl.AirlOutput:
    rows = pipeline.blank_transitions(env, 1)
    episode = Episode(env, config.horizon or env.horizon)
    one = jax.eval_shape(
        lambda key: airl.finish(airl.init(key, episode, rows, config.airl)), jax.random.PRNGKey(0)
    )
    example = jax.tree.map(lambda x: pipeline.shape_like(x, config.num_groups), one)
    return directory.load_output("airl", example)
