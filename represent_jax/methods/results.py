"""What a run found: rewards and policies compared with the truth, for the report and the records.

This is the only place where the true reward is looked at.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents import rollout as rollouts
from represent_jax.agents.sac import PolicyParams
from represent_jax.data.trajectories import pad
from represent_jax.envs import Episode
from represent_jax.methods import pipeline
from represent_jax.methods.config import Problem, RepresentConfig, target_names
from represent_jax.runs import RunDirectory, provenance
from represent_jax.stages import airl, curve, evaluation, noise, policies, regression, style

# Episodes behind every return that a run reports.
FINAL_EPISODES = 10


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
    demonstrations = problem.demonstrations
    num_strategies = demonstrations.num_strategies
    returns = [
        [t.total_reward for t in demonstrations.of_strategy(i)] for i in range(num_strategies)
    ]
    demo_means = [float(np.mean(r)) for r in returns]
    key_airl, key_style, key_final = jax.random.split(key, 3)
    airl_returns = _airl_returns(key_airl, config, problem, first)
    results: dict[str, Any] = {
        "env": config.env,
        "preset": config.preset,
        "seed": config.seed,
        "backend": problem.env.backend,
        "method": config.method,
        "strategies": num_strategies,
        "targets": list(target_names(config)),
        "demonstrators": [
            {
                "name": config.group_names[i],
                "return_mean": float(np.mean(r)),
                "return_std": float(np.std(r)),
                "num": len(r),
            }
            for i, r in enumerate(returns)
        ],
        "airl": [
            {"return": value, "ratio": value / demo}
            for value, demo in zip(airl_returns, demo_means, strict=True)
        ],
        "curve": [
            _curve_results(jax.tree.map(lambda x, i=i: x[i], curves)) for i in range(num_strategies)
        ],
    }
    results |= provenance()
    results["rewards"] = _reward_results(config, problem, noisy, rewards, directory)
    classifier = style.fit(
        key_style,
        jnp.concatenate([t.obs[1:] for t in demonstrations.trajectories]),
        jnp.concatenate(
            [jnp.full(t.length, t.strategy, jnp.int32) for t in demonstrations.trajectories]
        ),
        num_strategies,
    )
    results["policies"] = _policy_results(
        key_final, config, problem, rewards, trained, classifier, demo_means, directory
    )
    return results


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


def _reward_results(
    config: RepresentConfig,
    problem: Problem,
    noisy: noise.NoisyData,
    rewards: regression.Rewards,
    directory: RunDirectory,
) -> dict[str, Any]:
    horizon = problem.env.horizon
    demonstrations = problem.demonstrations
    groups = {
        "demonstrations": pad(demonstrations.trajectories, horizon),
        "test": pad(problem.test, horizon),
    }
    for i in range(demonstrations.num_strategies):
        groups[f"noisy_{i + 1}"] = jax.tree.map(lambda x, i=i: x[i], noisy.trajectories)
    best_demonstration = max(t.total_reward for t in demonstrations.trajectories)
    true = {name: np.asarray(rollouts.true_returns(batch)) for name, batch in groups.items()}
    results, scatter = {}, {}
    for target, name in enumerate(target_names(config)):
        strategy = target - 1 if target else None

        @jax.jit
        def learned_of(batch, strategy=strategy):
            return rollouts.learned_returns(
                batch,
                lambda params, *args: regression.reward(params, *args, config.regression, strategy),
                rewards,
            )

        learned = {group: np.asarray(learned_of(batch)) for group, batch in groups.items()}
        for group in groups:
            scatter[f"{name}/{group}/true"] = true[group]
            scatter[f"{name}/{group}/learned"] = learned[group]
        noisy_groups = [group for group in groups if group.startswith("noisy")]
        above = true["test"] > best_demonstration
        results[name] = {
            **_correlations("test", true, learned, ["test"]),
            **_correlations("noisy", true, learned, noisy_groups),
            **_correlations("pooled", true, learned, list(groups)),
            "pearson_above_demonstrators": (
                float(evaluation.pearson(true["test"][above], learned["test"][above]))
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


def _policy_results(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    rewards: regression.Rewards,
    trained: PolicyParams,
    classifier: style.StyleClassifier,
    demo_means: list[float],
    directory: RunDirectory,
) -> dict[str, Any]:
    @jax.jit
    def final(key, policy, objective):
        batch, result = policies.rollout(
            key,
            problem.env,
            objective,
            policy,
            FINAL_EPISODES,
            config.policies,
            pipeline.reward_fn_of(config),
        )
        posterior = jnp.exp(style.log_posterior(classifier, batch.obs[:, 1:]))
        share = jnp.sum(posterior * batch.mask[..., None], axis=(0, 1)) / jnp.sum(batch.mask)
        return result, share

    log = directory.read_log("policies")
    objectives = pipeline.objectives_of(config, problem.env, rewards)
    results, curves = {}, {}
    for target, name in enumerate(target_names(config)):
        strategy = target - 1 if target else None
        policy = jax.tree.map(lambda x, target=target: x[target], trained)
        (true, learned), share = final(jax.random.fold_in(key, target), policy, objectives[target])
        path = {
            "env_steps": [line["step"] for line in log],
            "true_return": [line["true_return"][target] for line in log],
            "learned_return": [line["learned_return"][target] for line in log],
        }
        for quantity, values in path.items():
            curves[f"{name}/{quantity}"] = np.asarray(values, float)
        base = float(np.mean(demo_means)) if strategy is None else demo_means[strategy]
        final_return = float(np.mean(true))
        results[name] = {
            "return_final": final_return,
            "return_final_std": float(np.std(true)),
            "return_last": path["true_return"][-1],
            "return_best": max([*path["true_return"], final_return]),
            "learned_return_final": float(np.mean(learned)),
            "demonstrators_return": base,
            "ratio_to_demonstrators": final_return / base,
            "style_kept": None if strategy is None else float(share[strategy]),
        }
    directory.save_arrays("learning_curves", curves)
    return results
