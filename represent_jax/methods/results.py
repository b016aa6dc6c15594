"""What a run found: rewards and policies compared with the truth, for the report and the records.

What the truth is not known of is left out: demonstrators without true rewards are not compared
with, and without test trajectories nothing is said of unseen ones. Rollouts always have the
environment's own reward.

This is where the true reward is looked at, and nothing is learned from what it says; D-REX's own
accuracies look at it too (`methods.drex`), only to be reported.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents import rollout as rollouts
from represent_jax.data.trajectories import TrajectoryBatch, pad
from represent_jax.envs import Episode
from represent_jax.methods.config import MethodConfig, Problem
from represent_jax.methods.policy_learning import Trained
from represent_jax.methods.population import member_of
from represent_jax.runs import RunDirectory, provenance
from represent_jax.stages import airl, curve, evaluation, noise, policies, style
from represent_jax.stages.airl import AirlConfig

# Episodes behind every return that a run reports.
FINAL_EPISODES = 10

# From trajectories to what a reward makes of them, `[num_trajectories]`.
LearnedReturns = Callable[[TrajectoryBatch], jax.Array]

# From a key to `FINAL_EPISODES` episodes of a policy.
Episodes = Callable[[jax.Array], TrajectoryBatch]


def describe(config: MethodConfig, problem: Problem) -> dict[str, Any]:
    """What every run's results begin with."""
    demonstrations = problem.demonstrations
    groups = [demonstrations.of_strategy(i) for i in range(demonstrations.num_strategies)]
    horizon = problem.env.horizon
    cut_short = [t for t in demonstrations.trajectories if t.length < horizon and not t.terminated]
    given = {
        "actions": demonstrations.has_actions,
        "rewards": demonstrations.has_rewards,
        "test": bool(problem.test),
    }

    def over(statistic, group):
        return float(statistic([t.total_reward for t in group])) if given["rewards"] else None

    return {
        "env": config.env,
        "preset": config.protocol,
        "seed": config.seed,
        "backend": problem.env.backend,
        "method": config.method,
        "strategies": len(groups),
        "targets": list(config.target_names),
        "demonstrators": [
            {
                "name": name,
                "return_mean": over(np.mean, group),
                "return_std": over(np.std, group),
                "num": len(group),
            }
            for name, group in zip(config.group_names, groups, strict=True)
        ],
        "horizon": horizon,
        "cut_short": len(cut_short),
        "cut_off": problem.num_cut,
        "source": demonstrations.metadata.get("source"),
        "missing": [what for what, there in given.items() if not there],
        **provenance(),
    }


def judge_airl(
    key: jax.Array,
    config: AirlConfig,
    problem: Problem,
    first: airl.AirlOutput,
    actions: str = "sampled",
) -> dict[str, Any]:
    """True returns of Phase 1's policies, and how well its rewards know the test trajectories.

    Args:
      key: PRNG key.
      config: settings of Phase 1.
      problem: holds the demonstrators and the test trajectories.
      first: what Phase 1 made; leaves are `[num_strategies, ...]`.
      actions: what is rolled out after it, "sampled" actions or the "mode" of them.
    """
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)
    test = pad(problem.test, problem.env.horizon) if problem.test else None

    def one(key, policy, reward):
        def act(params, obs_t, key):
            mode = actions == "mode"
            return airl.act(params, obs_t, key, config, env.action_size, deterministic=mode)

        def reward_fn(params, *transition):
            return airl.reward(params, *transition, config)

        batch = rollouts.rollout(env, act, policy, key, jnp.zeros(FINAL_EPISODES))
        found = None
        if test is not None:
            learned = rollouts.learned_returns(test, reward_fn, reward)
            found = evaluation.correlate(rollouts.true_returns(test), learned)
        return jnp.mean(rollouts.true_returns(batch)), found

    keys = jax.random.split(key, problem.demonstrations.num_strategies)
    returns, found = jax.jit(jax.vmap(one))(keys, first.policy, first.reward)
    judged = [{"return": float(value)} for value in returns]
    for i, one in enumerate(judged):
        if problem.demonstrations.has_rewards:
            one["ratio"] = _ratio(one["return"], problem.demonstrations.mean_return(i))
        if found is not None:
            one["pearson_test"] = float(found.pearson[i])
            one["spearman_test"] = float(found.spearman[i])
    return {"airl": judged}


def noisy_groups(config: MethodConfig, noisy: noise.NoisyData) -> dict[str, TrajectoryBatch]:
    """Phase 2's rollouts by group, as `judge_rewards` takes them."""
    return {
        _noisy(name): member_of(noisy.trajectories, i) for i, name in enumerate(config.group_names)
    }


def _noisy(group: str) -> str:
    """ "noisy_1" for "strategy_1", "noisy_merged" for "merged"."""
    return f"noisy_{group.removeprefix('strategy_')}"


def learned_returns(
    rewards: Mapping[str, Callable[..., jax.Array]],
) -> dict[str, LearnedReturns]:
    """From functions of transitions to functions of trajectories, by target."""

    def returns_by(reward):
        return jax.jit(
            lambda batch: rollouts.learned_returns(batch, lambda _, *rows: reward(*rows), None)
        )

    return {name: returns_by(reward) for name, reward in rewards.items()}


def agents_episodes(
    config: policies.PoliciesConfig, env: Episode, names: Sequence[str], trained: Trained
) -> dict[str, Episodes]:
    """Episodes of trained agents as they are handed on, by target."""

    # One program for all targets: compiling the physics takes longer than the episodes.
    roll_out = jax.jit(
        lambda policy, key: policies.rollout(key, env, policy, FINAL_EPISODES, config)
    )
    return {name: functools.partial(roll_out, trained.policy(i)) for i, name in enumerate(names)}


def generators_episodes(
    env: Episode, names: Sequence[str], stacked: Any, act: Callable[..., jax.Array]
) -> dict[str, Episodes]:
    """Episodes of generators that were trained side by side, by strategy.

    Args:
      env: whole episodes.
      names: of the strategies.
      stacked: parameters, `[num_strategies, ...]`.
      act: `act(params, obs_t, key)`.
    """
    levels = jnp.zeros(FINAL_EPISODES)
    roll_out = jax.jit(lambda params, key: rollouts.rollout(env, act, params, key, levels))
    return {
        name: functools.partial(roll_out, member_of(stacked, i)) for i, name in enumerate(names)
    }


def describe_curves(curves: curve.Curve) -> list[dict[str, Any]]:
    """The noise-performance curve of every strategy, for the report."""
    num_strategies = curves.r2.shape[0]
    return [_curve_results(member_of(curves, i)) for i in range(num_strategies)]


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

    `task_share`, for which no true return is needed, is how much of what R^i knows of its own noisy
    rollouts is R^0's: near 1 where R~^i holds a style and nothing else.

    Args:
      problem: holds the demonstrations and the unseen test trajectories, as far as given.
      noisy: the noisy rollouts that rewards were trained on, by name ("noisy_1", ...).
      learned: the rewards, by target.
      directory: where the points go.
    """
    demonstrations = problem.demonstrations.trajectories
    groups = {}
    if problem.demonstrations.has_rewards:
        groups["demonstrations"] = pad(demonstrations, problem.env.horizon)
    if problem.test:
        groups["test"] = pad(problem.test, problem.env.horizon)
    groups |= noisy
    true = {name: np.asarray(rollouts.true_returns(batch)) for name, batch in groups.items()}
    judged = {
        name: {group: np.asarray(learned_of(batch)) for group, batch in groups.items()}
        for name, learned_of in learned.items()
    }
    results, scatter = {}, {}
    for name, found in judged.items():
        for group in groups:
            scatter[f"{name}/{group}/true"] = true[group]
            scatter[f"{name}/{group}/learned"] = found[group]
        results[name] = {
            **(_correlations("test", true, found, ["test"]) if problem.test else {}),
            **(_correlations("noisy", true, found, list(noisy)) if noisy else {}),
            **(_correlations("pooled", true, found, list(groups)) if groups else {}),
        }
        own = _noisy(name)
        if "task" in judged and own in noisy:
            share = evaluation.slope(found[own], judged["task"][own])
            results[name]["task_share"] = float(share)
        if problem.test and problem.demonstrations.has_rewards:
            above = true["test"] > max(t.total_reward for t in demonstrations)
            results[name]["pearson_above_demonstrators"] = (
                float(evaluation.pearson(true["test"][above], found["test"][above]))
                if above.sum() >= 5
                else None
            )
    if scatter:
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
    log: Sequence[Mapping[str, Any]],
    directory: RunDirectory,
) -> dict[str, Any]:
    """True return, learned return, style and the task's outcomes; saves learning curves.

    Args:
      key: PRNG key.
      config: settings.
      problem: holds the demonstrators.
      episodes: of the policies, by target.
      learned: the rewards they were trained on, by target; a cloned policy has none.
      log: what their training logged at every evaluation; empty where nothing was evaluated.
      directory: where curves go.

    Returns:
      What was found, under "policies".
    """
    key_style, key = jax.random.split(key)
    share_of_styles = _style_judge(key_style, problem)
    demonstrations = problem.demonstrations
    means = None
    if demonstrations.has_rewards:
        means = [demonstrations.mean_return(i) for i in range(demonstrations.num_strategies)]
    results, curves = {}, {}
    for i, (name, episodes_of) in enumerate(episodes.items()):
        batch = episodes_of(jax.random.fold_in(key, i))
        true = np.asarray(rollouts.true_returns(batch))
        group = config.group_names.index(name) if name in config.group_names else None
        final = float(np.mean(true))
        path = {"env_steps": np.asarray([line["step"] for line in log], float)} | {
            quantity: np.asarray([line[quantity][i] for line in log], float)
            for quantity in ("true_return", "learned_return")
        }
        curves |= {f"{name}/{quantity}": values for quantity, values in path.items()}
        shares = share_of_styles(batch)
        results[name] = {
            "return_final": final,
            "return_final_std": float(np.std(true)),
            "return_last": float(path["true_return"][-1]) if log else final,
            "return_best": float(np.fmax.reduce([*path["true_return"], final])),
            "env_steps_to_90_percent": _env_steps_to(0.9, path["env_steps"], path["true_return"]),
            "learned_return_final": (
                float(np.mean(learned[name](batch))) if name in learned else None
            ),
            # Of a single group's every state is taken for its own.
            "style_kept": (
                None
                if group is None or demonstrations.num_strategies == 1
                else float(shares[group])
            ),
            **{
                quantity: float(np.mean(values))
                for quantity, values in problem.env.unwrapped.outcomes(batch.obs).items()
            },
        }
        if means is not None:
            base = float(np.mean(means)) if group is None else means[group]
            results[name]["demonstrators_return"] = base
            results[name]["ratio_to_demonstrators"] = _ratio(final, base)
    if log:
        directory.save_arrays("learning_curves", curves)
    return {"policies": results}


def describe_selection(config: MethodConfig, trained: Trained) -> dict[str, Any]:
    """Whose policy every target is handed, and what all policies earn of its reward, if any."""
    if trained.selected is None:
        return {}
    names = config.policy_names
    returns = np.asarray(trained.selected.learned_returns)
    return {
        "selection": {
            name: {
                "trained_for": names[int(trained.selected.chosen[i])],
                "learned_returns": dict(zip(names, returns[:, i].tolist(), strict=True)),
            }
            for i, name in enumerate(names)
        }
    }


def _ratio(value: float, base: float) -> float | None:
    return value / base if base else None


def _env_steps_to(share: float, env_steps: np.ndarray, true_returns: np.ndarray) -> int | None:
    """Env steps after which a return was first within a share of the last; None without any."""
    if not len(true_returns):
        return None
    last = true_returns[-1]
    reached = true_returns >= last - (1.0 - share) * abs(last)
    return int(env_steps[np.argmax(reached)]) if reached.any() else None


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
