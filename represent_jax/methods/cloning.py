"""BC and BC-RNN: the demonstrations of all strategies cloned by one policy, or one strategy's."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from represent_jax.agents import rollout as rollouts
from represent_jax.data.trajectories import pad
from represent_jax.envs import Environment, Episode
from represent_jax.errors import RepresentError
from represent_jax.methods import pipeline, results
from represent_jax.methods.config import MethodConfig, OneGroupConfig, Problem
from represent_jax.methods.plan import Stage
from represent_jax.runs import RunDirectory
from represent_jax.stages import bc, bc_rnn
from represent_jax.stages.bc import BcConfig
from represent_jax.stages.bc_rnn import BcRnnConfig
from represent_jax.types import Params


@dataclasses.dataclass(frozen=True)
class BcMethodConfig(OneGroupConfig):
    """Settings of behavioural cloning.

    Attributes:
      bc: settings of the stage.
    """

    method: str = "bc"
    bc: BcConfig = BcConfig()

    @property
    def needs_actions(self) -> str:
        """Cloning is of actions."""
        return f"method={self.method}"


@dataclasses.dataclass(frozen=True)
class BcRnnMethodConfig(OneGroupConfig):
    """Settings of recurrent behavioural cloning.

    Attributes:
      bc_rnn: settings of the stage.
    """

    method: str = "bc_rnn"
    bc_rnn: BcRnnConfig = BcRnnConfig()

    @property
    def needs_actions(self) -> str:
        """Cloning is of actions."""
        return f"method={self.method}"


def plan_bc(
    config: BcMethodConfig, problem: Problem, checkpoint_seconds: float = 60.0
) -> tuple[Stage, ...]:
    """The stages of behavioural cloning; see `methods.plan.execute`."""
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)

    def train(key, directory):
        return train_bc(key, config.bc, problem, directory, checkpoint_seconds)

    def episodes(params, key):
        def policy(params, obs_t, key):
            return bc.act(params, obs_t, key, config.bc, env.action_size)

        return rollouts.rollout(env, policy, params, key, jnp.zeros(results.FINAL_EPISODES))

    return (
        Stage("bc", train, (), {"bc": config.bc}),
        _evaluation(config, problem, "bc", episodes),
    )


def plan_bc_rnn(
    config: BcRnnMethodConfig, problem: Problem, checkpoint_seconds: float = 60.0
) -> tuple[Stage, ...]:
    """The stages of recurrent behavioural cloning; see `methods.plan.execute`."""
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)

    def train(key, directory):
        return train_bc_rnn(key, config.bc_rnn, problem, directory, checkpoint_seconds)

    def episodes(params, key):
        def policy(params, carry, obs_t, key):
            return bc_rnn.act(params, carry, obs_t, key, config.bc_rnn, env.action_size)

        levels = jnp.zeros(results.FINAL_EPISODES)
        carry = bc_rnn.initial_carry(results.FINAL_EPISODES, config.bc_rnn)
        return rollouts.rollout_recurrent(env, policy, params, carry, key, levels)

    return (
        Stage("bc_rnn", train, (), {"bc_rnn": config.bc_rnn}, sees_pauses=True),
        _evaluation(config, problem, "bc_rnn", episodes),
    )


def _evaluation(config, problem, trained_in, episodes) -> Stage:
    def judge(key, directory, params):
        policies = {config.merged_name: jax.jit(lambda key: episodes(params, key))}
        return {"rewards": {}} | results.judge_policies(
            key, config, problem, policies, {}, (), directory
        )

    return Stage("policy_evaluation", judge, (trained_in,), config.names, reports=True)


def train_bc(
    key: jax.Array,
    config: bc.BcConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> Params:
    """Behavioural cloning of all demonstrations together."""
    key_split, key = jax.random.split(key)
    every = pipeline.transitions(problem.lessons.trajectories)
    data = bc.split(key_split, every, config)
    return pipeline.run_updates(
        "bc",
        key,
        lambda key: bc.init(key, data.train, config),
        lambda state, data, num_updates: bc.train(state, data, config, num_updates),
        data,
        bc.finish,
        config.num_updates,
        directory,
        checkpoint_seconds,
    )


def train_bc_rnn(
    key: jax.Array,
    config: bc_rnn.BcRnnConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> bc_rnn.BcRnnParams:
    """Recurrent behavioural cloning of all demonstrations together."""
    data = pad(problem.demonstrations.trajectories, problem.env.horizon)
    data = jax.tree.map(jnp.asarray, data)
    return pipeline.run_updates(
        "bc_rnn",
        key,
        lambda key: bc_rnn.init(key, data, config),
        lambda state, data, num_updates: bc_rnn.train(state, data, config, num_updates),
        data,
        bc_rnn.finish,
        config.num_updates,
        directory,
        checkpoint_seconds,
    )


def load_no_rewards(config: MethodConfig, env: Environment, directory: RunDirectory) -> dict:
    """Raises: cloning learns no reward."""
    raise RepresentError(f"{directory.path}: a run of {config.method}, which learns no reward")


def load_bc_policies(
    config: BcMethodConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[[jax.Array], jax.Array]]:
    """The policy of a run, by its only target."""
    rows = pipeline.blank_transitions(env, 1)
    key = jax.random.PRNGKey(0)
    example = jax.eval_shape(lambda key: bc.finish(bc.init(key, rows, config.bc)), key)
    params = directory.load_output("bc", example)

    def policy(obs, unused_key=None):
        return bc.act(params, obs, key, config.bc, env.action_size)

    return {config.merged_name: policy}


def load_no_recurrent_policies(
    config: BcRnnMethodConfig, env: Environment, directory: RunDirectory
) -> dict:
    """Raises: a recurrent policy is no function of observations alone."""
    raise RepresentError(
        f"{directory.path}: the policy of bc_rnn carries a hidden state; see stages/bc_rnn.py, act"
    )
