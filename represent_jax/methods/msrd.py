"""MSRD (Chen et al., HRI 2020, https://arxiv.org/abs/2001.00503): one joint adversarial training.

Its policies are the generators that it trains, one for each strategy: the paper's tables give SAC
to REPRESENT, SSRR and D-REX only.
"""

import dataclasses
from collections.abc import Callable

import jax

from represent_jax.config import require, require_entries
from represent_jax.envs import Environment, Episode
from represent_jax.methods import pipeline, results
from represent_jax.methods.config import MethodConfig, Problem, strategy_names
from represent_jax.methods.plan import Stage
from represent_jax.methods.population import member_of, stack
from represent_jax.runs import RunDirectory
from represent_jax.runs.loop import advance
from represent_jax.stages import msrd
from represent_jax.stages.msrd import MsrdConfig


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
        require(self.grouping == "separate", "grouping", "'separate'", self.grouping)

    def check_against(self, obs_dim: int) -> None:
        """Raises a UsageError where R^0 is to see entries that an observation does not have."""
        require_entries(self.msrd.task_entries, obs_dim, "msrd.task_entries")

    @property
    def target_names(self) -> tuple[str, ...]:
        """ "task", "strategy_1", ..."""
        return ("task", *strategy_names(self.num_groups))


def plan(
    config: MsrdMethodConfig, problem: Problem, checkpoint_seconds: float = 60.0
) -> tuple[Stage, ...]:
    """The stages of MSRD; see `methods.plan.execute`."""
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)

    def learn(key, directory):
        return train(key, config.msrd, problem, directory, checkpoint_seconds)

    def judge_rewards(key, directory, output):
        learned = results.learned_returns(_rewards_of(config, output))
        return {"rewards": results.judge_rewards(problem, {}, learned, directory)}

    def judge_policies(key, directory, output):
        def policy(params, obs_t, key):
            return msrd.act(params, obs_t, key, config.msrd, env.action_size, deterministic=True)

        episodes = results.generators_episodes(env, config.group_names, output.policies, policy)
        learned = results.learned_returns(_rewards_of(config, output))
        return results.judge_policies(key, config, problem, episodes, learned, (), directory)

    return (
        Stage("msrd", learn, (), {"msrd": config.msrd}),
        Stage("reward_evaluation", judge_rewards, ("msrd",), reports=True),
        Stage("policy_evaluation", judge_policies, ("msrd",), reports=True),
    )


def train(
    key: jax.Array,
    config: MsrdConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> msrd.MsrdOutput:
    """MSRD's joint training of all strategies."""
    demonstrations = stack(pipeline.transitions_of(problem.lessons))

    def init(key):
        return msrd.init(key, problem.env, demonstrations, config)

    if directory.is_done("msrd"):
        return directory.load_output("msrd", msrd.finish(jax.eval_shape(init, key)))
    per_step = config.sac.env_steps_per_step
    chunk_env_steps = pipeline.chunk_of(config.env_steps, per_step)
    num_steps = chunk_env_steps // per_step
    state = advance(
        directory,
        "msrd",
        lambda: jax.jit(init)(key),
        jax.jit(
            lambda state: msrd.train(state, problem.env, demonstrations, config, num_steps),
            donate_argnums=0,
        ),
        -(-config.env_steps // chunk_env_steps),
        units_per_chunk=chunk_env_steps,
        checkpoint_seconds=checkpoint_seconds,
        describe=lambda m: "discriminator " + pipeline.numbers(m["discriminator_loss"]),
        example=jax.eval_shape(init, key),
    )
    output = msrd.finish(state)
    directory.save_output("msrd", output)
    return output


def load_rewards(
    config: MsrdMethodConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[..., jax.Array]]:
    """R^0 and every R^i of a run, by target."""
    return _rewards_of(config, _load(config, env, directory))


def _rewards_of(
    config: MsrdMethodConfig, output: msrd.MsrdOutput
) -> dict[str, Callable[..., jax.Array]]:
    def reward_of(strategy):
        return lambda *rows: msrd.reward(output.rewards, *rows, config.msrd, strategy)

    return {name: reward_of(i - 1 if i else None) for i, name in enumerate(config.target_names)}


def load_policies(
    config: MsrdMethodConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[[jax.Array], jax.Array]]:
    """The generators of a run, by strategy: there is none of the task's."""
    stacked, unused = _load(config, env, directory).policies, jax.random.PRNGKey(0)

    def policy_of(i):
        params = member_of(stacked, i)
        return lambda obs, key=None: msrd.act(
            params, obs, unused, config.msrd, env.action_size, deterministic=True
        )

    return {name: policy_of(i) for i, name in enumerate(config.group_names)}


def _load(config: MsrdMethodConfig, env: Environment, directory: RunDirectory) -> msrd.MsrdOutput:
    rows = pipeline.blank_transitions(env, config.num_groups, 1)
    episode = Episode(env, config.horizon or env.horizon)
    example = jax.eval_shape(
        lambda key: msrd.finish(msrd.init(key, episode, rows, config.msrd)), jax.random.PRNGKey(0)
    )
    return directory.load_output("msrd", example)
