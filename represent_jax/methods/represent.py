"""REPRESENT (Xue, Chen, Gombolay; RA-L 2025), Algorithm 1: the stages in order, resumable.

demonstrations -> airl -> noise and curve -> regression -> policies -> evaluation
"""

import dataclasses
import resource
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents import rollout as rollouts
from represent_jax.agents import sac
from represent_jax.config import require
from represent_jax.data.trajectories import Demonstrations, Trajectory, TrajectoryBatch, pad
from represent_jax.envs import Environment, Episode
from represent_jax.errors import RepresentError
from represent_jax.methods.population import Population, stack
from represent_jax.runs import RunDirectory
from represent_jax.runs.loop import advance
from represent_jax.stages import airl, curve, evaluation, noise, policies, regression, style
from represent_jax.stages.airl import AirlConfig
from represent_jax.stages.curve import CurveConfig
from represent_jax.stages.noise import NoiseConfig
from represent_jax.stages.policies import PoliciesConfig
from represent_jax.stages.regression import RegressionConfig
from represent_jax.types import Transition


@dataclasses.dataclass(frozen=True)
class RepresentConfig:
    """Settings of the whole pipeline.

    Attributes:
      env: the environment's name.
      preset: name of the preset the settings began as.
      seed: seed of everything after the demonstrations.
      backend: physics engine.
      num_strategies: strategies used of those demonstrated; the first ones.
      demonstrations: name or file of the demonstrations; the environment's own if empty.
      horizon: environment steps of an episode; 0 is the environment's own.
      population: how members run together, see `methods.population`.
      airl, noise, curve, regression, policies: settings of the stages.
    """

    env: str = "half_cheetah"
    preset: str = "quick"
    seed: int = 0
    backend: str = "auto"
    num_strategies: int = 2
    demonstrations: str = ""
    horizon: int = 0
    population: str = "auto"
    airl: AirlConfig = AirlConfig()
    noise: NoiseConfig = NoiseConfig()
    curve: CurveConfig = CurveConfig()
    regression: RegressionConfig = RegressionConfig()
    policies: PoliciesConfig = PoliciesConfig()

    def __post_init__(self) -> None:
        require(self.num_strategies >= 1, "num_strategies", "at least 1", self.num_strategies)
        require(self.seed >= 0, "seed", "at least 0", self.seed)
        require(self.horizon >= 0, "horizon", "at least 0", self.horizon)


class Problem(NamedTuple):
    """What the method is given.

    Attributes:
      env: episodes that reset themselves.
      demonstrations: of the strategies in use.
      test: unseen trajectories; only evaluation looks at them.
    """

    env: Episode
    demonstrations: Demonstrations
    test: tuple[Trajectory, ...]


def make_problem(
    config: RepresentConfig, env: Environment, demonstrations: Demonstrations, test: Demonstrations
) -> Problem:
    """Checks demonstrations and test trajectories against the environment and cuts them to size.

    Raises:
      RepresentError: they do not fit the environment, or too few strategies are demonstrated.
    """
    horizon = config.horizon or env.horizon
    for data in (demonstrations, test):
        data.check_against(env.observation_size, env.action_size, -1.0, 1.0)
    if config.num_strategies > demonstrations.num_strategies:
        raise RepresentError(
            f"num_strategies: expected at most {demonstrations.num_strategies}, as many as are "
            f"demonstrated, found {config.num_strategies}"
        )
    own = [t for t in demonstrations.trajectories if t.strategy < config.num_strategies]
    return Problem(
        Episode(env, horizon),
        dataclasses.replace(
            demonstrations, trajectories=tuple(_truncate(t, horizon) for t in own)
        ),
        tuple(_truncate(t, horizon) for t in test.trajectories),
    )


def _truncate(t: Trajectory, horizon: int) -> Trajectory:
    if t.length <= horizon:
        return t
    return Trajectory(
        t.obs[: horizon + 1], t.actions[:horizon], t.rewards[:horizon], False, t.strategy
    )


def run(config: RepresentConfig, problem: Problem, directory: RunDirectory) -> dict[str, Any]:
    """Runs every stage that is not done yet and returns the results.

    Args:
      config: settings.
      problem: environment, demonstrations, test trajectories.
      directory: where stages are saved as they end, and restored from.
    """
    keys = dict(
        zip(
            ("airl", "noise", "regression", "policies", "evaluation"),
            jax.random.split(jax.random.PRNGKey(config.seed), 5),
            strict=True,
        )
    )
    clock = _Clock(directory)
    with clock("airl"):
        first = run_airl(keys["airl"], config, problem, directory)
    with clock("noise"):
        noisy = run_noise(keys["noise"], config, problem, first, directory)
    curves = jax.jit(
        lambda levels, returns: jax.vmap(curve.fit, in_axes=(0, 0, None))(
            levels, returns, config.curve
        )
    )(noisy.levels, noisy.returns)
    _check_curves(curves)
    with clock("regression"):
        rewards = run_regression(keys["regression"], config, problem, noisy, curves, directory)
    with clock("policies"):
        trained = run_policies(keys["policies"], config, problem, first, rewards, directory)
    with clock("evaluation"):
        results = evaluate(
            keys["evaluation"], config, problem, first, noisy, curves, rewards, trained, directory
        )
    results["seconds"] = clock.seconds
    results["peak_memory_gib"] = round(
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2
    )
    directory.write_results(results)
    return results


class _Clock:
    """Seconds spent in each stage, kept across restarts in the run's log."""

    def __init__(self, directory: RunDirectory):
        self._directory = directory
        self.seconds: dict[str, float] = {}
        for line in directory.read_log("clock"):
            self._add(line)

    def _add(self, line: dict[str, Any]) -> None:
        name = line["name"]
        self.seconds[name] = round(self.seconds.get(name, 0.0) + line["seconds"], 1)

    def __call__(self, name: str) -> "_Clock":
        self._name = name
        return self

    def __enter__(self) -> None:
        self._start = time.monotonic()

    def __exit__(self, *exception: object) -> None:
        line = {"name": self._name, "seconds": time.monotonic() - self._start}
        self._directory.log("clock", 0, line)
        self._add(line)


# --- Phase 1 ---


def run_airl(
    key: jax.Array, config: RepresentConfig, problem: Problem, directory: RunDirectory
) -> airl.AirlOutput:
    """Phase 1 for all strategies; leaves of the result are `[num_strategies, ...]`."""
    members = transitions_of(problem.demonstrations)
    population = Population(members, config.population, _airl_axes)

    def init(key, demonstrations):
        return airl.init(key, problem.env, demonstrations, config.airl)

    if directory.is_done("airl"):
        example = airl.finish(jax.eval_shape(init, key, members[0]))
        example = jax.tree.map(lambda x: _shape_like(x, len(members)), example)
        return directory.load_output("airl", example)
    chunk_env_steps = _chunk(config.airl.env_steps, config.airl.sac.num_envs)
    step = population.stepper(
        lambda state, demonstrations: airl.train(
            state, problem.env, demonstrations, config.airl,
            chunk_env_steps // config.airl.sac.num_envs,
        )
    )
    states = advance(
        directory,
        "airl",
        population.init(init, key),
        step,
        -(-config.airl.env_steps // chunk_env_steps),
        units_per_chunk=chunk_env_steps,
        describe=lambda m: "discriminator " + _numbers(m["discriminator_loss"]),
    )
    output = stack([airl.finish(state) for state in population.members(states)])
    directory.save_output("airl", output)
    return output


def _airl_axes(state: airl.AirlState) -> airl.AirlState:
    return jax.tree.map(lambda _: 0, state).replace(sac=sac.population_axes(state.sac))


def transitions_of(demonstrations: Demonstrations) -> list[Transition]:
    """Transitions of each strategy, repeated to one common number, `[num_transitions]`."""
    gathered = [
        _transitions(demonstrations.of_strategy(i)) for i in range(demonstrations.num_strategies)
    ]
    longest = max(len(rows.reward_t) for rows in gathered)
    return [
        jax.tree.map(lambda x: jnp.asarray(np.resize(x, (longest, *x.shape[1:]))), rows)
        for rows in gathered
    ]


def _transitions(trajectories: tuple[Trajectory, ...]) -> Transition:
    discount = [np.ones(t.length, np.float32) for t in trajectories]
    for rows, t in zip(discount, trajectories, strict=True):
        rows[-1] = 0.0 if t.terminated else 1.0
    discount_t = np.concatenate(discount)
    nothing = np.zeros_like(discount_t)
    return Transition(
        obs_t=np.concatenate([t.obs[:-1] for t in trajectories]),
        action_t=np.concatenate([t.actions for t in trajectories]),
        next_obs_t=np.concatenate([t.obs[1:] for t in trajectories]),
        # The true reward stays out: nothing before the evaluation may see it.
        reward_t=nothing,
        discount_t=discount_t,
        noise_level_t=nothing,
    )


# --- Phase 2 ---


def run_noise(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    first: airl.AirlOutput,
    directory: RunDirectory,
) -> noise.NoisyData:
    """Phase 2's rollouts; leaves of the result are `[num_strategies, ...]`."""
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)

    def policy(params, obs_t, key):
        return sac.act(params, obs_t, key, config.airl.sac, env.action_size)

    def reward(params, obs_t, action_t, next_obs_t):
        return airl.reward(params, obs_t, action_t, next_obs_t, config.airl)

    def one(key, first):
        return noise.run(key, env, policy, first.policy, reward, first.reward, config.noise)

    keys = jax.random.split(key, problem.demonstrations.num_strategies)
    if directory.is_done("noise"):
        return directory.load_output("noise", jax.eval_shape(jax.vmap(one), keys, first))
    output = jax.block_until_ready(jax.jit(jax.vmap(one))(keys, first))
    directory.save_output("noise", output)
    return output


def _check_curves(curves: curve.Curve) -> None:
    for i, status in enumerate(np.asarray(curves.status)):
        if status == curve.CurveStatus.NON_FINITE:
            raise RepresentError(f"curve of strategy {i + 1}: {curve.describe(status)}")


# --- Phase 3 ---


def run_regression(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    noisy: noise.NoisyData,
    curves: curve.Curve,
    directory: RunDirectory,
) -> regression.Rewards:
    """Phase 3: all rewards at once."""
    num_strategies = problem.demonstrations.num_strategies
    sizes = (problem.env.observation_size, problem.env.action_size, num_strategies)

    def init(key):
        return regression.init(key, *sizes, config.regression)

    if directory.is_done("regression"):
        return directory.load_output("regression", jax.eval_shape(init, key).rewards)
    targets = jnp.repeat(curves.fitted, config.noise.trajectories_per_level, axis=1)
    data = regression.RegressionData(
        noisy.trajectories, targets, _padded_demonstrations(problem)
    )
    updates_per_chunk = max(1, config.regression.num_updates // 20)
    compiled = jax.jit(
        lambda state, data: regression.train(state, data, config.regression, updates_per_chunk),
        donate_argnums=0,
    )
    state = advance(
        directory,
        "regression",
        jax.jit(init)(key),
        lambda state: compiled(state, data),
        -(-config.regression.num_updates // updates_per_chunk),
        units_per_chunk=updates_per_chunk,
        unit="updates",
        describe=lambda m: "loss " + _numbers(m["ssrr_loss"]),
    )
    directory.save_output("regression", state.rewards)
    return state.rewards


def _padded_demonstrations(problem: Problem) -> TrajectoryBatch:
    """Demonstrations `[num_strategies, num_demonstrations]`, repeated to one common number."""
    demonstrations = problem.demonstrations
    groups = [demonstrations.of_strategy(i) for i in range(demonstrations.num_strategies)]
    most = max(len(group) for group in groups)
    padded = [
        pad([group[j % len(group)] for j in range(most)], problem.env.horizon) for group in groups
    ]
    return stack(padded)


# --- Policies ---


def target_names(num_strategies: int) -> tuple[str, ...]:
    """Names of the rewards a run learns: "task", "strategy_1", ..."""
    return ("task", *(f"strategy_{i + 1}" for i in range(num_strategies)))


def run_policies(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    first: airl.AirlOutput,
    rewards: regression.Rewards,
    directory: RunDirectory,
) -> sac.PolicyParams:
    """Policies on R^0 and every R^i; leaves of the result are `[1 + num_strategies, ...]`."""
    env, num_strategies = problem.env, problem.demonstrations.num_strategies
    learning = (config.policies, config.regression)
    key_start, key = jax.random.split(key)
    targets = [
        policies.make_target(rewards, strategy, env.horizon, *learning)
        for strategy in (None, *range(num_strategies))
    ]
    starts = [jax.tree.map(lambda x, i=i: x[i], first.policy) for i in range(num_strategies)]
    task_start = _best_start(key_start, env, targets[0], starts, config)
    members = list(zip(targets, [starts[task_start], *starts], strict=True))

    def init(key, member):
        return policies.init(key, env, *member, *learning)

    if directory.is_done("policies"):
        example = sac.policy_of(jax.eval_shape(init, key, members[0]).learner)
        return directory.load_output(
            "policies", jax.tree.map(lambda x: _shape_like(x, len(members)), example)
        )
    population = Population(members, config.population, sac.population_axes)
    step = population.stepper(
        lambda state, member: policies.train(state, env, member[0], *learning)
    )
    num_envs = config.policies.sac.num_envs
    chunk_env_steps = max(1, config.policies.eval_env_steps // num_envs) * num_envs
    states = advance(
        directory,
        "policies",
        population.init(init, key),
        step,
        -(-config.policies.env_steps // chunk_env_steps),
        units_per_chunk=chunk_env_steps,
        describe=lambda m: "learned return " + _numbers(m["learned_return"]),
    )
    output = stack([sac.policy_of(state.learner) for state in population.members(states)])
    directory.save_output("policies", output)
    return output


def _best_start(
    key: jax.Array,
    env: Episode,
    task: policies.Target,
    starts: list[sac.PolicyParams],
    config: RepresentConfig,
) -> int:
    """Index of the Phase 1 policy with the highest learned task return."""
    score = jax.jit(
        lambda policy: policies.evaluate(
            key, env, task, policy, config.policies, config.regression
        ).learned_return
    )
    return int(np.argmax([float(score(policy)) for policy in starts]))


# --- Evaluation ---


def evaluate(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    first: airl.AirlOutput,
    noisy: noise.NoisyData,
    curves: curve.Curve,
    rewards: regression.Rewards,
    trained: sac.PolicyParams,
    directory: RunDirectory,
) -> dict[str, Any]:
    """Compares rewards and policies with the truth, saves plot data, and returns the results."""
    demonstrations = problem.demonstrations
    num_strategies = demonstrations.num_strategies
    returns = [[t.total_reward for t in demonstrations.of_strategy(i)] for i in range(num_strategies)]
    demo_means = [float(np.mean(r)) for r in returns]
    key_airl, key_style, key_final = jax.random.split(key, 3)
    airl_returns = _airl_returns(key_airl, config, problem, first)
    results: dict[str, Any] = {
        "env": config.env,
        "preset": config.preset,
        "seed": config.seed,
        "backend": problem.env.backend,
        "strategies": num_strategies,
        "demonstrators": [
            {
                "strategy": i,
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
        "curve": [_curve_results(jax.tree.map(lambda x, i=i: x[i], curves)) for i in range(num_strategies)],
    }
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
            return sac.act(params, obs_t, key, config.airl.sac, env.action_size)

        batch = rollouts.rollout(env, act, policy, key, jnp.zeros(10))
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
        "means": np.asarray(fitted.scaled_means).tolist(),
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
    for target, name in enumerate(target_names(demonstrations.num_strategies)):
        strategy = target - 1 if target else None

        @jax.jit
        def learned_of(batch, strategy=strategy):
            return rollouts.learned_returns(
                batch,
                lambda params, *args: regression.reward(
                    params, *args, config.regression, strategy
                ),
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
    trained: sac.PolicyParams,
    classifier: style.StyleClassifier,
    demo_means: list[float],
    directory: RunDirectory,
) -> dict[str, Any]:
    env = Episode(problem.env.env, problem.env.horizon, auto_reset=False)
    log = directory.read_log("policies")
    results, curves = {}, {}
    for target, name in enumerate(target_names(len(demo_means))):
        strategy = target - 1 if target else None
        reward_target = policies.make_target(
            rewards, strategy, env.horizon, config.policies, config.regression
        )
        policy = jax.tree.map(lambda x, target=target: x[target], trained)

        @jax.jit
        def final(key, policy, reward_target):
            def act(params, obs_t, key):
                return sac.act(
                    params, obs_t, key, config.policies.sac, env.action_size, deterministic=True
                )

            batch = rollouts.rollout(env, act, policy, key, jnp.zeros(10))
            learned = rollouts.learned_returns(
                batch,
                lambda *args: policies.learned_reward(*args, config.regression),
                reward_target,
            )
            posterior = jnp.exp(style.log_posterior(classifier, batch.obs[:, 1:]))
            share = jnp.sum(posterior * batch.mask[..., None], axis=(0, 1)) / jnp.sum(batch.mask)
            return rollouts.true_returns(batch), learned, share

        true, learned, share = final(jax.random.fold_in(key, target), policy, reward_target)
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
            "return_best": max([*path["true_return"], final_return]),
            "learned_return_final": float(np.mean(learned)),
            "demonstrators_return": base,
            "ratio_to_demonstrators": final_return / base,
            "style_kept": None if strategy is None else float(share[strategy]),
        }
    directory.save_arrays("learning_curves", curves)
    return results


def _chunk(env_steps: int, num_envs: int) -> int:
    """Environment steps between two host round trips: a twentieth of the budget."""
    return max(1, env_steps // 20 // num_envs) * num_envs


def _shape_like(leaf: Any, num_members: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((num_members, *leaf.shape), leaf.dtype)


def _numbers(values: Any) -> str:
    return " ".join(f"{float(value):.3g}" for value in np.atleast_1d(values))
