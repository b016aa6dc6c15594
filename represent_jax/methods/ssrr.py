"""SSRR (Chen, Paleja, Gombolay; CoRL 2020, https://arxiv.org/abs/2010.11723) on the same stages.

Noisy-AIRL, noise-performance curve and snippet regression of one demonstrator. For a task reward
the demonstrations of all strategies are merged, as in the paper's Tables I and II; kept separate,
every strategy has a reward of its own, and Phases 1 and 2 are those of REPRESENT.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from represent_jax.config import require
from represent_jax.envs import Environment
from represent_jax.methods import pipeline, represent
from represent_jax.methods.config import Problem, RepresentConfig
from represent_jax.methods.plan import Stage
from represent_jax.methods.population import member_of
from represent_jax.runs import RunDirectory
from represent_jax.stages import decomposition
from represent_jax.stages.policies import TaskPolicyConfig
from represent_jax.stages.regression_config import RegressionConfig

# What is left of Phase 3 where there is one reward; a single curve has no unit to learn.
_NOTHING_ELSE = {
    "strategy_weight": 0.0,
    "lambda_reg": 0.0,
    "lambda_bcd": 0.0,
    "learn_units": False,
}


@dataclasses.dataclass(frozen=True)
class SsrrConfig(RepresentConfig):
    """Settings of SSRR: those of REPRESENT without R~^i, so without Eq. 4 and Eq. 5.

    Its rewards are fitted to a curve each, whose unit they have, and what is learned of merged
    demonstrations starts from a clone of all: nothing is different for the task.
    """

    method: str = "ssrr"
    grouping: str = "merged"
    regression: RegressionConfig = RegressionConfig(**_NOTHING_ELSE)

    def __post_init__(self) -> None:
        super().__post_init__()
        for field, nothing in _NOTHING_ELSE.items():
            found = getattr(self.regression, field)
            expected = f"{nothing}, SSRR decomposes nothing"
            require(found == nothing, f"regression.{field}", expected, found)
        nothing, found = TaskPolicyConfig(), self.task_policy
        require(found == nothing, "task_policy", f"{nothing}, SSRR has no R^0 of its own", found)

    @property
    def target_names(self) -> tuple[str, ...]:
        """A reward for every group: "task" of merged demonstrations, or "strategy_1", ..."""
        return self.group_names if self.grouping == "separate" else (self.merged_name,)


def configure(settings: dict[str, Any]) -> dict[str, Any]:
    """Turns the settings of a preset and a domain into SSRR's."""
    own = dataclasses.replace(settings["regression"], **_NOTHING_ELSE)
    return settings | {"regression": own, "task_policy": TaskPolicyConfig()}


def plan(
    config: SsrrConfig, problem: Problem, checkpoint_seconds: float = 60.0
) -> tuple[Stage, ...]:
    """The stages of SSRR; see `methods.plan.execute`."""

    def regress(key, directory, noisy, curves):
        return pipeline.run_regressions(
            key, config, problem, noisy, curves, directory, checkpoint_seconds
        )

    def views(rewards):
        return {
            name: decomposition.view(one, None, config.regression)
            for name, one in _by_target(config, rewards).items()
        }

    settings = {"each": config.regression, "population": config.population}
    return (
        *represent.first_stages(config, problem, checkpoint_seconds),
        Stage(
            "regression",
            regress,
            ("noise", "curve"),
            settings,
            revision=config.regression.revision,
        ),
        *represent.last_stages(
            config,
            problem,
            checkpoint_seconds,
            views=views,
            rewards_of=lambda rewards: _rewards_of(config, rewards),
        ),
    )


def load_rewards(
    config: SsrrConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[..., jax.Array]]:
    """Every reward of a run, by target."""
    sizes = (env.observation_size, env.action_size, 1)
    example = jax.tree.map(
        lambda x: pipeline.shape_like(x, config.num_groups),
        decomposition.example(*sizes, config.regression),
    )
    return _rewards_of(config, directory.load_output("regression", example))


def _by_target(
    config: SsrrConfig, rewards: decomposition.Rewards
) -> dict[str, decomposition.Rewards]:
    return {name: member_of(rewards, i) for i, name in enumerate(config.target_names)}


def _rewards_of(
    config: SsrrConfig, rewards: decomposition.Rewards
) -> dict[str, Callable[..., jax.Array]]:
    def reward_of(one):
        return lambda *rows: decomposition.reward(one, *rows, config.regression, None)

    return {name: reward_of(one) for name, one in _by_target(config, rewards).items()}
