"""What a run found: rewards and policies compared with the truth, for the report and the records.

This is the only place where the true reward is looked at.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents import rollout as rollouts
from represent_jax.agents.sac import PolicyParams
from represent_jax.data.trajectories import TrajectoryBatch, pad
from represent_jax.envs import Episode
from represent_jax.methods import pipeline
from represent_jax.methods.config import MethodConfig, Problem, RepresentConfig
from represent_jax.runs import RunDirectory, provenance
from represent_jax.stages import airl, curve, evaluation, noise, policies, regression, style

# Episodes behind every return that a run reports.
FINAL_EPISODES = 10

# From trajectories to what a reward makes of them, `[num_trajectories]`.
LearnedReturns = Callable[[TrajectoryBatch], jax.Array]

# From a key to `FINAL_EPISODES` deterministic episodes of a policy.
Episodes = Callable[[jax.Array], TrajectoryBatch]


def describe(config: MethodConfig, problem: Problem) -> dict[str, Any]:
    """What every run's results begin with."""
    groups = [
        [t.total_reward for t in problem.demonstrations.of_strategy(i)]
        for i in range(problem.demonstrations.num_strategies)
    ]
    return {
        "env": config.env,
        "preset": config.preset,
        "seed": config.seed,
        "backend": problem.env.backend,
        "method": config.method,
        "strategies": len(groups),
        "targets": list(config.target_names),
        "demonstrators": [
            {
                "name": name,
                "return_mean": float(np.mean(returns)),
                "return_std": float(np.std(returns)),
                "num": len(returns),
            }
            for name, returns in zip(config.group_names, groups, strict=True)
        ],
        **provenance(),
    }


def evaluate(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    first: airl.AirlOutput,
    noisy: noise.NoisyData,
    curves: curve.Curve,
    rewards: regression.Rewards,
    trained: PolicyParams,
    directory: RunDirectory,
) -> dict[str, Any]:
    """Compares rewards and policies with the truth, saves plot data, and returns the results."""
    num_strategies = problem.demonstrations.num_strategies
    key_airl, key_policies = jax.random.split(key)
    results = describe(config, problem)
    results["airl"] = [
        {"return": value, "ratio": value / one["return_mean"]}
        for value, one in zip(
            _airl_returns(key_airl, config, problem, first), results["demonstrators"], strict=True
        )
    ]
    results["curve"] = [
        _curve_results(jax.tree.map(lambda x, i=i: x[i], curves)) for i in range(num_strategies)
    ]
    objectives = pipeline.objectives_of(config, problem.env, rewards)
    objectives = dict(zip(config.target_names, objectives, strict=True))
    reward_fn = pipeline.reward_fn_of(config)
    noisy_groups = {
        f"noisy_{i + 1}": jax.tree.map(lambda x, i=i: x[i], noisy.trajectories)
        for i in range(num_strategies)
    }
    learned = {
        name: jax.jit(
            lambda batch, objective=objective: rollouts.learned_returns(
                batch, reward_fn, objective.params
            )
        )
        for name, objective in objectives.items()
    }
    results["rewards"] = judge_rewards(problem, noisy_groups, learned, directory)
    episodes = {
        name: policy_episodes(
            config.policies,
            problem.env,
            jax.tree.map(lambda x, i=i: x[i], trained),
        )
        for i, name in enumerate(config.target_names)
    }
    results["policies"] = judge_policies(
        key_policies, config, problem, episodes, learned, directory
    )
    return results


def policy_episodes(
    config: policies.PoliciesConfig, env: Episode, policy: PolicyParams
) -> Episodes:
    """Deterministic episodes of a trained agent."""
    return jax.jit(lambda key: policies.rollout(key, env, policy, FINAL_EPISODES, config))


def _airl_returns(
    key: jax.Array, config: RepresentConfig, problem: Problem, first: airl.AirlOutput
) -> list[float]:
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)

    def one(key, policy):
        def act(params, obs_t, key):
            return airl.act(params, obs_t, key, config.airl, env.action_size)

        batch = rollouts.rollout(env, act, policy, key, jnp.zeros(FINAL_EPISODES))
        return jnp.mean(rollouts.true_returns(batch))

    keys = jax.random.split(key, problem.demonstrations.num_strategies)
    return [float(value) for value in jax.jit(jax.vmap(one))(keys, first.policy)]


def _curve_results(fitted: curve.Curve) -> dict[str, Any]:
    return {
        "x0": float(fitted.x0),
        "y0": float(fitted.y0),
        "c": float(fitted.c),
        "k": float(fitted.k),
        "r2": float(fitted.r2),
        "status": curve.CurveStatus(int(fitted.status)).name.lower(),
        "levels": np.asarray(fitted.levels).tolist(),
        "returns": np.asarray(fitted.scaled_returns).tolist(),
        "fitted": np.asarray(fitted.fitted).tolist(),
    }


def judge_rewards(
    problem: Problem,
    noisy: Mapping[str, TrajectoryBatch],
    learned: Mapping[str, LearnedReturns],
    directory: RunDirectory,
) -> dict[str, Any]:
    """Correlates learned with true returns, and saves the points for figures.

    Args:
      problem: holds the demonstrations and the unseen test trajectories.
      noisy: the noisy rollouts that rewards were trained on, by name ("noisy_1", ...).
      learned: the rewards, by target.
      directory: where the points go.
    """
    groups = {
        "demonstrations": pad(problem.demonstrations.trajectories, problem.env.horizon),
        "test": pad(problem.test, problem.env.horizon),
        **noisy,
    }
    best_demonstration = max(t.total_reward for t in problem.demonstrations.trajectories)
    true = {name: np.asarray(rollouts.true_returns(batch)) for name, batch in groups.items()}
    above = true["test"] > best_demonstration
    results, scatter = {}, {}
    for name, learned_of in learned.items():
        found = {group: np.asarray(learned_of(batch)) for group, batch in groups.items()}
        for group in groups:
            scatter[f"{name}/{group}/true"] = true[group]
            scatter[f"{name}/{group}/learned"] = found[group]
        results[name] = {
            **_correlations("test", true, found, ["test"]),
            **(_correlations("noisy", true, found, list(noisy)) if noisy else {}),
            **_correlations("pooled", true, found, list(groups)),
            "pearson_above_demonstrators": (
                float(evaluation.pearson(true["test"][above], found["test"][above]))
                if above.sum() >= 5
                else None
            ),
        }
    directory.save_arrays("scatter", scatter)
    return results


def _correlations(label: str, true: dict, learned: dict, groups: list[str]) -> dict[str, float]:
    found = evaluation.correlate(
        np.concatenate([true[group] for group in groups]),
        np.concatenate([learned[group] for group in groups]),
    )
    return {f"pearson_{label}": float(found.pearson), f"spearman_{label}": float(found.spearman)}


def judge_policies(
    key: jax.Array,
    config: MethodConfig,
    problem: Problem,
    episodes: Mapping[str, Episodes],
    learned: Mapping[str, LearnedReturns],
    directory: RunDirectory,
) -> dict[str, Any]:
    """True return, learned return and style of policies; saves their learning curves.

    Args:
      key: PRNG key.
      config: settings.
      problem: holds the demonstrators.
      episodes: of the policies, by target.
      learned: the rewards they were trained on, by target; a cloned policy has none.
      directory: holds the training's log, and where curves go.
    """
    key_style, key = jax.random.split(key)
    share_of_styles = _style_judge(key_style, problem)
    log = directory.read_log("policies")
    means = [
        float(np.mean([t.total_reward for t in problem.demonstrations.of_strategy(i)]))
        for i in range(problem.demonstrations.num_strategies)
    ]
    results, curves = {}, {}
    for i, (name, episodes_of) in enumerate(episodes.items()):
        batch = episodes_of(jax.random.fold_in(key, i))
        true = np.asarray(rollouts.true_returns(batch))
        group = config.group_names.index(name) if name in config.group_names else None
        base = float(np.mean(means)) if group is None else means[group]
        final = float(np.mean(true))
        path = {"env_steps": [line["step"] for line in log]} | {
            quantity: [line[quantity][i] for line in log]
            for quantity in ("true_return", "learned_return")
        }
        for quantity, values in path.items():
            curves[f"{name}/{quantity}"] = np.asarray(values, float)
        shares = share_of_styles(batch)
        results[name] = {
            "return_final": final,
            "return_final_std": float(np.std(true)),
            "return_last": path["true_return"][-1] if log else final,
            "return_best": max([*path["true_return"], final]),
            "learned_return_final": (
                float(np.mean(learned[name](batch))) if name in learned else None
            ),
            "demonstrators_return": base,
            "ratio_to_demonstrators": final / base,
            "style_kept": None if group is None else float(shares[group]),
        }
    if log:
        directory.save_arrays("learning_curves", curves)
    return results


def _style_judge(key: jax.Array, problem: Problem) -> Callable[[TrajectoryBatch], jax.Array]:
    """From episodes to the share of their states that each strategy is taken for."""
    trajectories = problem.demonstrations.trajectories
    classifier = style.fit(
        key,
        jnp.concatenate([t.obs[1:] for t in trajectories]),
        jnp.concatenate([jnp.full(t.length, t.strategy) for t in trajectories]),
        problem.demonstrations.num_strategies,
    )

    @jax.jit
    def shares(batch):
        posterior = jnp.exp(style.log_posterior(classifier, batch.obs[:, 1:]))
        return jnp.sum(posterior * batch.mask[..., None], axis=(0, 1)) / jnp.sum(batch.mask)

    return shares
