"""MSRD (Chen et al., HRI 2020, https://arxiv.org/abs/2001.00503): one joint adversarial training.

Its policies are the generators that it trains, one for each strategy: the paper's tables give SAC
to REPRESENT, SSRR and D-REX only.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from represent_jax.agents import rollout as rollouts
from represent_jax.config import require
from represent_jax.envs import Environment, Episode
from represent_jax.errors import unknown
from represent_jax.methods import pipeline, results
from represent_jax.methods.clock import Clock
from represent_jax.methods.config import MethodConfig, Problem, strategy_names
from represent_jax.runs import RunDirectory
from represent_jax.stages import msrd
from represent_jax.stages.msrd import MsrdConfig
from represent_jax.types import Transition

STAGES = ("msrd", "evaluation")


@dataclasses.dataclass(frozen=True)
class MsrdMethodConfig(MethodConfig):
    """Settings of MSRD.

    Attributes:
      msrd: settings of the stage.
    """

    method: str = "msrd"
    msrd: MsrdConfig = MsrdConfig()

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.grouping == "separate", "grouping", "'separate'", repr(self.grouping))

    @property
    def target_names(self) -> tuple[str, ...]:
        """ "task", "strategy_1", ..."""
        return ("task", *strategy_names(self.num_groups))


def run(
    config: MsrdMethodConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float = 60.0,
    until: str = STAGES[-1],
) -> dict[str, Any] | None:
    """Runs every stage that is not done yet; as `represent.run`."""
    if until not in STAGES:
        raise unknown("stage", until, STAGES)
    key_train, key_evaluation = jax.random.split(jax.random.PRNGKey(config.seed))
    clock = Clock(directory)
    with clock("msrd"):
        output = pipeline.run_msrd(key_train, config.msrd, problem, directory, checkpoint_seconds)
    if until == "msrd":
        return None
    with clock("evaluation"):
        env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)

        def policy(params, obs_t, key):
            return msrd.act(params, obs_t, key, config.msrd, env.action_size, deterministic=True)

        def learned_by(strategy):
            def reward_fn(rewards, *transition):
                return msrd.reward(rewards, *transition, config.msrd, strategy)

            return jax.jit(lambda batch: rollouts.learned_returns(batch, reward_fn, output.rewards))

        def episodes_of(strategy):
            params = jax.tree.map(lambda x: x[strategy], output.policies)
            levels = jnp.zeros(results.FINAL_EPISODES)
            return jax.jit(lambda key: rollouts.rollout(env, policy, params, key, levels))

        learned = {
            name: learned_by(i - 1 if i else None) for i, name in enumerate(config.target_names)
        }
        episodes = {name: episodes_of(i) for i, name in enumerate(config.group_names)}
        found = results.describe(config, problem)
        found["rewards"] = results.judge_rewards(problem, {}, learned, directory)
        found["policies"] = results.judge_policies(
            key_evaluation, config, problem, episodes, learned, directory
        )
    return clock.finish(found)


def load_rewards(
    config: MsrdMethodConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[..., jax.Array]]:
    """R^0 and every R^i of a run, by target."""
    rewards = _load(config, env, directory).rewards

    def reward_of(strategy):
        return lambda *rows: msrd.reward(rewards, *rows, config.msrd, strategy)

    names = config.target_names
    return {name: reward_of(i - 1 if i else None) for i, name in enumerate(names)}


def load_policies(
    config: MsrdMethodConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[[jax.Array], jax.Array]]:
    """The generators of a run, by strategy: there is none of the task's."""
    stacked, key = _load(config, env, directory).policies, jax.random.PRNGKey(0)

    def policy_of(i):
        params = jax.tree.map(lambda x: x[i], stacked)
        return lambda obs: msrd.act(
            params, obs, key, config.msrd, env.action_size, deterministic=True
        )

    return {name: policy_of(i) for i, name in enumerate(config.group_names)}


def _load(config: MsrdMethodConfig, env: Environment, directory: RunDirectory) -> msrd.MsrdOutput:
    shape = (config.num_groups, 1)
    obs, nothing = jnp.zeros((*shape, env.observation_size)), jnp.zeros(shape)
    action = jnp.zeros((*shape, env.action_size))
    rows = Transition(obs, action, obs, nothing, nothing, nothing)
    episode = Episode(env, config.horizon or env.horizon)
    example = jax.eval_shape(
        lambda key: msrd.finish(msrd.init(key, episode, rows, config.msrd)), jax.random.PRNGKey(0)
    )
    return directory.load_output("msrd", example)
