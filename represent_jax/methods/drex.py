"""D-REX (Brown et al., CoRL 2019, https://arxiv.org/abs/1907.03976) on the same stages.

demonstrations -> bc (or airl) -> noise -> preference -> policies -> evaluation

Demonstrations are cloned, the clone is rolled out under noise, and a reward is learned that
prefers less noise. Its policy is SAC's, as in the paper's Table II; D-REX's own code uses PPO.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents import rollout as rollouts
from represent_jax.config import require
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.envs import Environment
from represent_jax.methods import cloning, pipeline, policy_learning, results
from represent_jax.methods.config import OneGroupConfig, Problem, check_start
from represent_jax.methods.plan import Stage
from represent_jax.methods.population import member_of
from represent_jax.runs import RunDirectory
from represent_jax.stages import bc, noise, policies, preference
from represent_jax.stages.airl import AirlConfig
from represent_jax.stages.bc import BcConfig
from represent_jax.stages.noise import NoiseConfig, NoisyData
from represent_jax.stages.policies import PoliciesConfig
from represent_jax.stages.preference import PreferenceConfig
from represent_jax.types import Params, RewardFn


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
        # A clone is of another family than SAC's policies.
        require(
            self.base == "airl" or self.policies.start == "cold",
            "policies.start",
            "'cold' with base 'bc'",
            self.policies.start,
        )
        check_start(self.airl, self.policies)
        gap, highest = self.preference.min_level_gap, noise.highest_level(self.noise)
        expected = f"at most the highest noise level ({highest:g})"
        reached = gap <= highest or math.isclose(gap, highest)
        require(reached, "preference.min_level_gap", expected, gap)

    @property
    def needs_actions(self) -> str:
        """Its own base is a clone."""
        if self.base == "bc":
            return "base=bc (base=airl does without)"
        return self.airl.needs_actions


def configure(settings: dict[str, Any]) -> dict[str, Any]:
    """Turns the settings of a preset and a domain into D-REX's: policies start anew."""
    return settings | {"policies": dataclasses.replace(settings["policies"], start="cold")}


def plan(
    config: DrexConfig, problem: Problem, checkpoint_seconds: float = 60.0
) -> tuple[Stage, ...]:
    """The stages of D-REX; see `methods.plan.execute`."""
    env, name = problem.env, config.merged_name
    reward_fn = _reward_fn(config)

    def imitate(key, directory):
        return pipeline.run_airl(key, config, problem, directory, checkpoint_seconds)

    def roll_out(key, directory, first):
        return pipeline.run_noise(key, config, problem, first, directory)

    def clone(key, directory):
        return cloning.train_bc(key, config.bc, problem, directory, checkpoint_seconds)

    def roll_out_clone(key, directory, cloned):
        return _run_noise(key, config, env, cloned, directory)

    def prefer(key, directory, noisy):
        return _run_preference(key, config, env, _batch(noisy), directory, checkpoint_seconds)

    def judge_rewards(key, directory, noisy, params):
        batch = _batch(noisy)
        learned = results.learned_returns(_rewards_of(config, params))
        found = results.judge_rewards(
            problem, results.noisy_groups(config, noisy), learned, directory
        )
        found[name] |= _accuracies(key, config, params, batch)
        return {"rewards": found}

    def train(key, directory, base, noisy, params):
        warm = config.policies.start == "phase1"
        starts = (lambda: [member_of(base.policy, 0)]) if warm else None
        return policy_learning.run(
            key,
            config.policies,
            config.population,
            env,
            [_objective(config, env, params, _batch(noisy), reward_fn)],
            reward_fn,
            starts,
            directory,
            checkpoint_seconds,
        )

    def judge_policies(key, directory, params, trained):
        episodes = results.agents_episodes(config.policies, env, (name,), trained)
        learned = results.learned_returns(_rewards_of(config, params))
        return results.judge_policies(
            key, config, problem, episodes, learned, trained.log, directory
        )

    if config.base == "airl":
        settings = {"airl": config.airl, "population": config.population}
        first = (
            Stage("airl", imitate, (), settings),
            Stage("noise", roll_out, ("airl",), {"noise": config.noise}),
        )
    else:
        first = (
            Stage("bc", clone, (), {"bc": config.bc}),
            Stage("noise", roll_out_clone, ("bc",), {"noise": config.noise}),
        )
    settings = {"policies": config.policies, "population": config.population}
    return (
        *(dataclasses.replace(stage, before_rewards=True) for stage in first),
        Stage("preference", prefer, ("noise",), {"preference": config.preference}),
        Stage(
            "reward_evaluation", judge_rewards, ("noise", "preference"), config.names, reports=True
        ),
        Stage("policies", train, (config.base, "noise", "preference"), settings),
        Stage(
            "policy_evaluation",
            judge_policies,
            ("preference", "policies"),
            config.names,
            reports=True,
        ),
    )


def load_rewards(
    config: DrexConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[..., jax.Array]]:
    """The reward of a run, by its only target."""
    example = jax.eval_shape(
        lambda key: preference.init(key, env.observation_size, config.preference),
        jax.random.PRNGKey(0),
    )
    params = directory.load_output("preference", example.params)
    return _rewards_of(config, params)


def _reward_fn(config: DrexConfig) -> RewardFn:
    def reward_fn(params, obs_t, action_t, next_obs_t):
        return preference.reward(params, obs_t, action_t, next_obs_t, config.preference)

    return reward_fn


def _rewards_of(config: DrexConfig, params: Params) -> dict[str, Callable[..., jax.Array]]:
    return {config.merged_name: lambda *rows: _reward_fn(config)(params, *rows)}


def _batch(noisy: NoisyData) -> TrajectoryBatch:
    """Rollouts of the only policy."""
    return member_of(noisy.trajectories, 0)


def _run_noise(key, config, env, cloned: Params, directory) -> NoisyData:
    def policy(params, obs_t, key):
        return bc.act(params, obs_t, key, config.bc, env.action_size)

    def no_reward(_, obs_t, action_t, next_obs_t):
        return jnp.zeros(obs_t.shape[:-1])

    stacked = jax.tree.map(lambda x: x[None], cloned)
    return pipeline.run_rollouts(
        key, config.noise, env, policy, stacked, no_reward, jnp.zeros(1), directory
    )


def _accuracies(key, config, params: Params, batch: TrajectoryBatch) -> dict[str, float]:
    """How often less noise is truly better, and how often the reward says so."""
    settings = config.preference
    ranking = preference.ranking_accuracy(
        batch.noise_level, rollouts.true_returns(batch), settings.min_level_gap
    )
    pairs = preference.pair_accuracy(params, batch, settings, key, 4096)
    return {"ranking_accuracy": float(ranking), "pair_accuracy": float(pairs)}


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
    # Where episodes end early their sums may be ordered and their means not: then by their spread.
    falls = clean - noisiest
    scale = 1.0 / jnp.maximum(jnp.where(falls > 0.0, falls, jnp.std(mean)), 1e-6)
    objective = policies.make_objective(params, scale, env, config.policies)
    return objective._replace(center=objective.center + scale * noisiest)
