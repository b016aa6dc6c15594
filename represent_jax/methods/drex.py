"""D-REX (Brown et al., CoRL 2019, https://arxiv.org/abs/1907.03976) on the same stages.

demonstrations -> bc (or airl) -> noise -> preference -> policies -> evaluation

Demonstrations are cloned, the clone is rolled out under noise, and a reward is learned that
prefers less noise. Its policy is SAC's, as in the paper's Table II; D-REX's own code uses PPO.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents import rollout as rollouts
from represent_jax.config import require
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.envs import Environment
from represent_jax.errors import unknown
from represent_jax.methods import pipeline, results
from represent_jax.methods.clock import Clock
from represent_jax.methods.config import OneGroupConfig, Problem
from represent_jax.runs import RunDirectory
from represent_jax.stages import bc, policies, preference
from represent_jax.stages.airl import AirlConfig
from represent_jax.stages.bc import BcConfig
from represent_jax.stages.noise import NoiseConfig
from represent_jax.stages.policies import PoliciesConfig
from represent_jax.stages.preference import PreferenceConfig

STAGES = ("base", "noise", "preference", "policies", "evaluation")


@dataclasses.dataclass(frozen=True)
class DrexConfig(OneGroupConfig):
    """Settings of D-REX.

    Attributes:
      base: whose rollouts are ranked: those of a "bc" policy (D-REX's own way), or of Phase 1's
        "airl" policy (the data that SSRR's authors gave it).
      bc, airl, noise, preference, policies: settings of the stages.
    """

    method: str = "drex"
    base: str = "bc"
    bc: BcConfig = BcConfig()
    airl: AirlConfig = AirlConfig()
    noise: NoiseConfig = NoiseConfig()
    preference: PreferenceConfig = PreferenceConfig()
    policies: PoliciesConfig = PoliciesConfig(start="cold")

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.base in ("bc", "airl"), "base", "'bc' or 'airl'", self.base)


def configure(config: DrexConfig) -> DrexConfig:
    """Turns a preset's settings into D-REX's: its policies start from random networks."""
    return dataclasses.replace(config, policies=dataclasses.replace(config.policies, start="cold"))


def run(
    config: DrexConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float = 60.0,
    until: str = STAGES[-1],
) -> dict[str, Any] | None:
    """Runs every stage that is not done yet; as `represent.run`."""
    if until not in STAGES:
        raise unknown("stage", until, STAGES)
    if config.base == "bc":
        # Its policy is of another family than SAC's.
        require(
            config.policies.start == "cold", "policies.start", "'cold' with base 'bc'", "phase1"
        )
    stage_keys = jax.random.split(jax.random.PRNGKey(config.seed), len(STAGES))
    keys = dict(zip(STAGES, stage_keys, strict=True))
    env, clock = problem.env, Clock(directory)
    starts = None
    if config.base == "airl":
        with clock("base"):
            first = pipeline.run_airl(keys["base"], config, problem, directory, checkpoint_seconds)
        starts = [jax.tree.map(lambda x: x[0], first.policy)]
        if until == "base":
            return None
        with clock("noise"):
            noisy = pipeline.run_noise(keys["noise"], config, problem, first, directory)
    else:
        with clock("base"):
            cloned = pipeline.run_bc(
                keys["base"], config.bc, problem, directory, checkpoint_seconds
            )
        if until == "base":
            return None

        def policy(params, obs_t, key):
            return bc.act(params, obs_t, key, config.bc, env.action_size)

        def no_reward(_, obs_t, action_t, next_obs_t):
            return jnp.zeros(obs_t.shape[:-1])

        stacked = jax.tree.map(lambda x: x[None], cloned)
        with clock("noise"):
            noisy = pipeline.run_rollouts(
                keys["noise"],
                config.noise,
                env,
                policy,
                stacked,
                no_reward,
                jnp.zeros(1),
                directory,
            )
    batch = jax.tree.map(lambda x: x[0], noisy.trajectories)
    if until == "noise":
        return None
    with clock("preference"):
        params = _run_preference(
            keys["preference"], config, env, batch, directory, checkpoint_seconds
        )
    if until == "preference":
        return None

    def reward_fn(params, obs_t, action_t, next_obs_t):
        return preference.reward(params, obs_t, action_t, next_obs_t, config.preference)

    learned = jax.jit(lambda batch: rollouts.learned_returns(batch, reward_fn, params))
    objective = _objective(config, env, params, batch, reward_fn)
    with clock("policies"):
        trained = pipeline.run_policies(
            keys["policies"],
            config,
            env,
            [objective],
            reward_fn,
            starts,
            directory,
            checkpoint_seconds,
        )
    if until == "policies":
        return None
    with clock("evaluation"):
        key_pairs, key_policies = jax.random.split(keys["evaluation"])
        name = config.merged_name
        found = results.describe(config, problem)
        found["rewards"] = results.judge_rewards(
            problem, {"noisy_1": batch}, {name: learned}, directory
        )
        found["rewards"][name] |= {
            "ranking_accuracy": float(
                preference.ranking_accuracy(
                    batch.noise_level,
                    rollouts.true_returns(batch),
                    config.preference.min_level_gap,
                )
            ),
            "pair_accuracy": float(
                preference.pair_accuracy(params, batch, config.preference, key_pairs, 4096)
            ),
        }
        episodes = results.policy_episodes(
            config.policies, env, jax.tree.map(lambda x: x[0], trained)
        )
        found["policies"] = results.judge_policies(
            key_policies, config, problem, {name: episodes}, {name: learned}, directory
        )
    return clock.finish(found)


def load_rewards(
    config: DrexConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[..., jax.Array]]:
    """The reward of a run, by its only target."""
    example = jax.eval_shape(
        lambda key: preference.init(key, env.observation_size, config.preference),
        jax.random.PRNGKey(0),
    )
    params = directory.load_output("preference", example.params)
    return {config.merged_name: lambda *rows: preference.reward(params, *rows, config.preference)}


def load_policies(
    config: DrexConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[[jax.Array], jax.Array]]:
    """The policy of a run, by its only target."""
    return pipeline.load_agents(config.policies, config.target_names, env, directory)


def _run_preference(key, config, env, batch: TrajectoryBatch, directory, checkpoint_seconds):
    settings = config.preference
    preference.check_levels(np.asarray(batch.noise_level), settings)

    def init(key):
        return preference.init(key, env.observation_size, settings)

    def train(state, batch, num_updates):
        return preference.train(state, batch, settings, num_updates)

    return pipeline.run_updates(
        "preference",
        key,
        init,
        train,
        batch,
        lambda state: state.params,
        settings.num_updates,
        directory,
        checkpoint_seconds,
    )


def _objective(config, env, params, batch: TrajectoryBatch, reward_fn) -> policies.Objective:
    """A unit in which rollouts without noise earn 1 a step, and the noisiest 0.

    A preference fixes a reward up to scale and offset; the temperature of SAC does not.
    """
    reward_t = reward_fn(params, batch.obs[:, :-1], batch.actions, batch.obs[:, 1:])
    mean = jnp.sum(reward_t * batch.mask, axis=-1) / jnp.sum(batch.mask, axis=-1)
    lowest, highest = jnp.min(batch.noise_level), jnp.max(batch.noise_level)
    clean = jnp.mean(mean, where=batch.noise_level == lowest)
    noisiest = jnp.mean(mean, where=batch.noise_level == highest)
    scale = 1.0 / jnp.maximum(clean - noisiest, 1e-6)
    objective = policies.make_objective(params, scale, env, config.policies)
    return objective._replace(center=objective.center + scale * noisiest)
