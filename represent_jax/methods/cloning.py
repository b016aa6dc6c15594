"""BC and BC-RNN: the demonstrations of all strategies cloned by one policy, or one strategy's."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from represent_jax.agents import rollout as rollouts
from represent_jax.envs import Environment, Episode
from represent_jax.errors import RepresentError, unknown
from represent_jax.methods import pipeline, results
from represent_jax.methods.clock import Clock
from represent_jax.methods.config import MethodConfig, OneGroupConfig, Problem
from represent_jax.runs import RunDirectory
from represent_jax.stages import bc, bc_rnn
from represent_jax.stages.bc import BcConfig
from represent_jax.stages.bc_rnn import BcRnnConfig
from represent_jax.types import Transition

STAGES = ("training", "evaluation")


@dataclasses.dataclass(frozen=True)
class BcMethodConfig(OneGroupConfig):
    """Settings of behavioural cloning.

    Attributes:
      bc: settings of the stage.
    """

    method: str = "bc"
    bc: BcConfig = BcConfig()


@dataclasses.dataclass(frozen=True)
class BcRnnMethodConfig(OneGroupConfig):
    """Settings of recurrent behavioural cloning.

    Attributes:
      bc_rnn: settings of the stage.
    """

    method: str = "bc_rnn"
    bc_rnn: BcRnnConfig = BcRnnConfig()


def run_bc(
    config: BcMethodConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float = 60.0,
    until: str = STAGES[-1],
) -> dict[str, Any] | None:
    """Runs every stage that is not done yet; as `represent.run`."""
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)

    def train(key):
        return pipeline.run_bc(key, config.bc, problem, directory, checkpoint_seconds)

    def episodes(params, key):
        def policy(params, obs_t, key):
            return bc.act(params, obs_t, key, config.bc, env.action_size)

        return rollouts.rollout(env, policy, params, key, jnp.zeros(results.FINAL_EPISODES))

    return _run(config, problem, directory, until, train, episodes)


def run_bc_rnn(
    config: BcRnnMethodConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float = 60.0,
    until: str = STAGES[-1],
) -> dict[str, Any] | None:
    """Runs every stage that is not done yet; as `represent.run`."""
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)

    def train(key):
        return pipeline.run_bc_rnn(key, config.bc_rnn, problem, directory, checkpoint_seconds)

    def episodes(params, key):
        def policy(params, carry, obs_t, key):
            return bc_rnn.act(params, carry, obs_t, key, config.bc_rnn, env.action_size)

        levels = jnp.zeros(results.FINAL_EPISODES)
        carry = bc_rnn.initial_carry(results.FINAL_EPISODES, config.bc_rnn)
        return rollouts.rollout_recurrent(env, policy, params, carry, key, levels)

    return _run(config, problem, directory, until, train, episodes)


def _run(config, problem, directory, until, train, episodes):
    if until not in STAGES:
        raise unknown("stage", until, STAGES)
    key_train, key_evaluation = jax.random.split(jax.random.PRNGKey(config.seed))
    clock = Clock(directory)
    with clock("training"):
        params = train(key_train)
    if until == "training":
        return None
    with clock("evaluation"):
        found = results.describe(config, problem)
        found["rewards"] = {}
        policies = {config.merged_name: jax.jit(lambda key: episodes(params, key))}
        found["policies"] = results.judge_policies(
            key_evaluation, config, problem, policies, {}, directory
        )
    return clock.finish(found)


def load_no_rewards(config: MethodConfig, env: Environment, directory: RunDirectory) -> dict:
    """Raises: cloning learns no reward."""
    raise RepresentError(f"{directory.path}: a run of {config.method}, which learns no reward")


def load_bc_policies(
    config: BcMethodConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[[jax.Array], jax.Array]]:
    """The policy of a run, by its only target."""
    obs, nothing = jnp.zeros((1, env.observation_size)), jnp.zeros(1)
    rows = Transition(obs, jnp.zeros((1, env.action_size)), obs, nothing, nothing, nothing)
    key = jax.random.PRNGKey(0)
    example = jax.eval_shape(lambda key: bc.finish(bc.init(key, rows, config.bc)), key)
    params = directory.load_output("bc", example)
    return {config.merged_name: lambda obs: bc.act(params, obs, key, config.bc, env.action_size)}


def load_no_recurrent_policies(
    config: BcRnnMethodConfig, env: Environment, directory: RunDirectory
) -> dict:
    """Raises: a recurrent policy is no function of observations alone."""
    raise RepresentError(
        f"{directory.path}: the policy of bc_rnn carries a hidden state; see stages/bc_rnn.py, act"
    )
