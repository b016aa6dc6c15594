"""REPRESENT (Xue, Chen, Gombolay; RA-L 2025), Algorithm 1: the stages in order, resumable.

demonstrations -> airl -> noise and curve -> regression -> policies -> evaluation
"""

import resource
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents.sac import PolicyParams
from represent_jax.data.trajectories import Demonstrations, Trajectory, TrajectoryBatch, pad
from represent_jax.envs import Episode
from represent_jax.errors import RepresentError, unknown
from represent_jax.methods import results as found
from represent_jax.methods.config import Problem, RepresentConfig, target_names
from represent_jax.methods.population import Population, stack
from represent_jax.runs import RunDirectory
from represent_jax.runs.loop import advance
from represent_jax.stages import airl, curve, noise, policies, regression
from represent_jax.types import Transition

STAGES = ("airl", "noise", "regression", "policies", "evaluation")


def run(
    config: RepresentConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float = 60.0,
    until: str = STAGES[-1],
) -> dict[str, Any] | None:
    """Runs every stage that is not done yet and returns the results.

    Args:
      config: settings.
      problem: environment, demonstrations, test trajectories.
      directory: where stages are saved as they end, and restored from.
      checkpoint_seconds: least time between two checkpoints of a stage under way.
      until: the last of `STAGES` to run; called again, the run goes on behind it.

    Returns:
      The results, None where the run stopped before its evaluation.

    Raises:
      UsageError: no stage of that name.
      RepresentError: a loss diverged, or Phase 1's reward is not finite.
    """
    if until not in STAGES:
        raise unknown("stage", until, STAGES)
    stage_keys = jax.random.split(jax.random.PRNGKey(config.seed), len(STAGES))
    keys = dict(zip(STAGES, stage_keys, strict=True))
    clock = _Clock(directory)
    with clock("airl"):
        first = run_airl(keys["airl"], config, problem, directory, checkpoint_seconds)
    if until == "airl":
        return None
    with clock("noise"):
        noisy = run_noise(keys["noise"], config, problem, first, directory)
    curves = jax.jit(
        lambda levels, returns: jax.vmap(curve.fit, in_axes=(0, 0, None))(
            levels, returns, config.curve
        )
    )(noisy.levels, noisy.returns)
    _check_curves(curves)
    if until == "noise":
        return None
    with clock("regression"):
        rewards = run_regression(
            keys["regression"], config, problem, noisy, curves, directory, checkpoint_seconds
        )
    if until == "regression":
        return None
    with clock("policies"):
        trained = run_policies(
            keys["policies"], config, problem, first, rewards, directory, checkpoint_seconds
        )
    if until == "policies":
        return None
    with clock("evaluation"):
        results = found.evaluate(
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
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> airl.AirlOutput:
    """Phase 1 for all strategies; leaves of the result are `[num_strategies, ...]`."""
    members = transitions_of(problem.demonstrations)
    population = Population(members, config.population, airl.population_axes)

    def init(key, demonstrations):
        return airl.init(key, problem.env, demonstrations, config.airl)

    if directory.is_done("airl"):
        example = airl.finish(jax.eval_shape(init, key, members[0]))
        example = jax.tree.map(lambda x: _shape_like(x, len(members)), example)
        return directory.load_output("airl", example)
    per_step = airl.generator(config.airl)[1].env_steps_per_step
    chunk_env_steps = _chunk(config.airl.env_steps, per_step)
    step = population.stepper(
        lambda state, demonstrations: airl.train(
            state, problem.env, demonstrations, config.airl, chunk_env_steps // per_step
        )
    )
    states = advance(
        directory,
        "airl",
        population.init(init, key),
        step,
        -(-config.airl.env_steps // chunk_env_steps),
        units_per_chunk=chunk_env_steps,
        checkpoint_seconds=checkpoint_seconds,
        describe=lambda m: "discriminator " + _numbers(m["discriminator_loss"]),
    )
    output = stack([airl.finish(state) for state in population.members(states)])
    directory.save_output("airl", output)
    return output


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
        return airl.act(params, obs_t, key, config.airl, env.action_size)

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
    checkpoint_seconds: float,
) -> regression.Rewards:
    """Phase 3: all rewards at once."""
    num_strategies = problem.demonstrations.num_strategies
    sizes = (problem.env.observation_size, problem.env.action_size, num_strategies)

    def init(key):
        return regression.init(key, *sizes, config.regression)

    if directory.is_done("regression"):
        return directory.load_output("regression", jax.eval_shape(init, key).rewards)
    targets = jnp.repeat(curves.fitted, config.noise.trajectories_per_level, axis=1)
    data = regression.RegressionData(noisy.trajectories, targets, _padded_demonstrations(problem))
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
        checkpoint_seconds=checkpoint_seconds,
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


def run_policies(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    first: airl.AirlOutput,
    rewards: regression.Rewards,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> PolicyParams:
    """Policies on R^0 and every R^i; leaves of the result are `[num_targets, ...]`."""
    env, num_strategies = problem.env, problem.demonstrations.num_strategies
    num_targets = len(target_names(config))
    learning = (config.policies, config.regression)
    _, settings = policies.agent_of(config.policies)
    key_start, key = jax.random.split(key)
    targets = [
        policies.make_target(rewards, strategy, env, *learning)
        for strategy in (None, *range(num_targets - 1))
    ]
    starts = [jax.tree.map(lambda x, i=i: x[i], first.policy) for i in range(num_strategies)]

    def init(key, member):
        return policies.init(key, env, *member, *learning)

    if directory.is_done("policies"):
        state = jax.eval_shape(init, key, (targets[0], starts[0]))
        example = policies.finish(state, config.policies)
        return directory.load_output(
            "policies", jax.tree.map(lambda x: _shape_like(x, len(targets)), example)
        )
    task_start = _best_start(key_start, env, targets[0], starts, config)
    members = list(zip(targets, [starts[task_start], *starts[: num_targets - 1]], strict=True))
    population = Population(
        members, config.population, lambda state: policies.population_axes(state, config.policies)
    )
    step = population.stepper(
        lambda state, member: policies.train(state, env, member[0], *learning)
    )
    per_step = settings.env_steps_per_step
    chunk_env_steps = max(1, config.policies.eval_env_steps // per_step) * per_step
    states = advance(
        directory,
        "policies",
        population.init(init, key),
        step,
        -(-config.policies.env_steps // chunk_env_steps),
        units_per_chunk=chunk_env_steps,
        checkpoint_seconds=checkpoint_seconds,
        describe=lambda m: "learned return " + _numbers(m["learned_return"]),
    )
    output = stack(
        [policies.finish(state, config.policies) for state in population.members(states)]
    )
    directory.save_output("policies", output)
    return output


def _best_start(
    key: jax.Array,
    env: Episode,
    task: policies.Target,
    starts: list[PolicyParams],
    config: RepresentConfig,
) -> int:
    """Index of the Phase 1 policy with the highest learned task return."""
    score = jax.jit(
        lambda policy: (
            policies.evaluate(
                key, env, task, policy, config.policies, config.regression
            ).learned_return
        )
    )
    return int(np.argmax([float(score(policy)) for policy in starts]))


def _chunk(env_steps: int, per_step: int) -> int:
    """Environment steps between two host round trips: a twentieth of the budget."""
    return max(1, env_steps // 20 // per_step) * per_step


def _shape_like(leaf: Any, num_members: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((num_members, *leaf.shape), leaf.dtype)


def _numbers(values: Any) -> str:
    return " ".join(f"{float(value):.3g}" for value in np.atleast_1d(values))
