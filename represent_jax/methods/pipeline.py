"""The stages on a run directory: population, progress, checkpoints, and loading what is done.

A stage itself (`represent_jax.stages`) knows of none of these. Methods call the functions here in
the order that makes the method.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.data.trajectories import Demonstrations, Trajectory, TrajectoryBatch, pad
from represent_jax.envs import Environment, Episode
from represent_jax.errors import RepresentError
from represent_jax.methods.config import Problem, RepresentConfig
from represent_jax.methods.population import Population, stack
from represent_jax.runs import RunDirectory
from represent_jax.runs.loop import advance
from represent_jax.stages import airl, curve, decomposition, noise, regression
from represent_jax.types import Metrics, Params, PolicyFn, RewardFn, Transition

# --- Phase 1 ---


def run_airl(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> airl.AirlOutput:
    """Phase 1 for all strategies; leaves of the result are `[num_strategies, ...]`."""
    members = transitions_of(problem.lessons)
    population = Population(members, config.population, airl.population_axes)

    def init(key, demonstrations):
        return airl.init(key, problem.env, demonstrations, config.airl)

    if directory.is_done("airl"):
        example = airl.finish(jax.eval_shape(init, key, members[0]))
        example = jax.tree.map(lambda x: shape_like(x, len(members)), example)
        return directory.load_output("airl", example)
    per_step = airl.generator(config.airl)[1].env_steps_per_step
    chunk_env_steps = chunk_of(config.airl.env_steps, per_step)
    step = population.stepper(
        lambda state, demonstrations: airl.train(
            state, problem.env, demonstrations, config.airl, chunk_env_steps // per_step
        )
    )
    states = advance(
        directory,
        "airl",
        lambda: population.init(init, key),
        step,
        -(-config.airl.env_steps // chunk_env_steps),
        units_per_chunk=chunk_env_steps,
        checkpoint_seconds=checkpoint_seconds,
        describe=lambda m: "discriminator " + numbers(m["discriminator_loss"]),
        example=population.example(init),
    )
    output = stack([airl.finish(state) for state in population.members(states)])
    directory.save_output("airl", output)
    return output


def transitions_of(demonstrations: Demonstrations) -> list[Transition]:
    """Transitions of each strategy, repeated to one common number, `[num_transitions]`."""
    gathered = [
        transitions(demonstrations.of_strategy(i)) for i in range(demonstrations.num_strategies)
    ]
    longest = max(len(rows.reward_t) for rows in gathered)
    return [
        jax.tree.map(lambda x: jnp.asarray(np.resize(x, (longest, *x.shape[1:]))), rows)
        for rows in gathered
    ]


def transitions(trajectories: tuple[Trajectory, ...]) -> Transition:
    """Transitions of trajectories one after the other, without the true reward.

    `action_t` is None where actions are missing: a static fact, which stages branch on.
    """
    discount = [np.ones(t.length, np.float32) for t in trajectories]
    for rows, t in zip(discount, trajectories, strict=True):
        rows[-1] = 0.0 if t.terminated else 1.0
    discount_t = np.concatenate(discount)
    nothing = np.zeros_like(discount_t)
    return Transition(
        obs_t=np.concatenate([t.obs[:-1] for t in trajectories]),
        action_t=(
            None
            if trajectories[0].actions is None
            else np.concatenate([t.actions for t in trajectories])
        ),
        next_obs_t=np.concatenate([t.obs[1:] for t in trajectories]),
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
    mode = config.noise.actions == "mode"

    def policy(params, obs_t, key):
        return airl.act(params, obs_t, key, config.airl, problem.env.action_size, mode)

    def reward(params, obs_t, action_t, next_obs_t):
        return airl.reward(params, obs_t, action_t, next_obs_t, config.airl)

    return run_rollouts(
        key, config.noise, problem.env, policy, first.policy, reward, first.reward, directory
    )


def run_rollouts(
    key: jax.Array,
    config: noise.NoiseConfig,
    env: Episode,
    policy: PolicyFn,
    policy_params: Params,
    reward_fn: RewardFn,
    reward_params: Params,
    directory: RunDirectory,
) -> noise.NoisyData:
    """Noisy rollouts of any policies; parameters and result are `[num_policies, ...]`."""
    whole = Episode(env.env, env.horizon, auto_reset=False, noise_size=config.action_size)

    def one(key, policy_params, reward_params):
        return noise.run(key, whole, policy, policy_params, reward_fn, reward_params, config)

    keys = jax.random.split(key, jax.tree.leaves(policy_params)[0].shape[0])
    inputs = (keys, policy_params, reward_params)
    if directory.is_done("noise"):
        return directory.load_output("noise", jax.eval_shape(jax.vmap(one), *inputs))
    output = jax.block_until_ready(jax.jit(jax.vmap(one))(*inputs))
    directory.save_output("noise", output)
    return output


def fit_curves(
    config: RepresentConfig, problem: Problem, first: airl.AirlOutput, noisy: noise.NoisyData
) -> curve.Curve:
    """The noise-performance curve of every strategy; leaves are `[num_strategies, ...]`.

    Raises:
      RepresentError: Phase 1's reward is not finite.
    """
    returns = noisy.returns
    if config.curve.reward_floor is not None:
        returns = floored_returns(config, transitions_of(problem.lessons), first, noisy)
    fit = jax.vmap(lambda levels, returns: curve.fit(levels, returns, config.curve))
    curves = jax.jit(fit)(noisy.levels, returns)
    _check_curves(curves)
    return curves


def floored_returns(
    config: RepresentConfig,
    demonstrations: list[Transition],
    first: airl.AirlOutput,
    noisy: noise.NoisyData,
) -> jax.Array:
    """Initial returns in which no step counts less than `curve.reward_floor` says.

    Returns:
      `[num_strategies, num_levels, trajectories_per_level]`.
    """

    @jax.vmap
    def judge(params, rows, trajectories):
        demonstrated = airl.reward(params, *rows[:3], config.airl)
        floor = jnp.quantile(demonstrated, config.curve.reward_floor)

        def reward(params, *transition):
            return jnp.maximum(airl.reward(params, *transition, config.airl), floor)

        return noise.judge(trajectories, reward, params)

    returns = jax.jit(judge)(first.reward, stack(demonstrations), noisy.trajectories)
    return returns.reshape(noisy.returns.shape)


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
) -> decomposition.Rewards:
    """Phase 3: all rewards at once."""
    num_strategies = problem.demonstrations.num_strategies
    sizes = (problem.env.observation_size, problem.env.action_size, num_strategies)
    data = _regression_data(config, problem, noisy, curves)

    def init(key):
        return regression.init(key, *sizes, config.regression)

    def train(state, data, num_updates):
        return regression.train(state, data, config.regression, num_updates)

    return run_updates(
        "regression",
        key,
        init,
        train,
        data,
        lambda state: regression.finish(state, data, config.regression),
        config.regression.num_updates,
        directory,
        checkpoint_seconds,
        describe=lambda m: "loss " + numbers(m["ssrr_loss"]),
    )


def run_regressions(
    key: jax.Array,
    config: RepresentConfig,
    problem: Problem,
    noisy: noise.NoisyData,
    curves: curve.Curve,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> decomposition.Rewards:
    """A single reward of every strategy by itself; leaves are `[num_strategies, ...]`."""
    data = _regression_data(config, problem, noisy, curves)
    num_strategies = data.targets.shape[0]
    members = [jax.tree.map(lambda x, i=i: x[i, None], data) for i in range(num_strategies)]
    sizes = (problem.env.observation_size, problem.env.action_size, 1)

    def init(key, _):
        return regression.init(key, *sizes, config.regression)

    if directory.is_done("regression"):
        example = decomposition.example(*sizes, config.regression)
        example = jax.tree.map(lambda x: shape_like(x, num_strategies), example)
        return directory.load_output("regression", example)
    population = Population(members, config.population)
    per_chunk = max(1, config.regression.num_updates // 20)
    states = advance(
        directory,
        "regression",
        population.init(init, key),
        population.stepper(
            lambda state, data: regression.train(state, data, config.regression, per_chunk)
        ),
        -(-config.regression.num_updates // per_chunk),
        units_per_chunk=per_chunk,
        unit="updates",
        checkpoint_seconds=checkpoint_seconds,
        describe=lambda m: "loss " + numbers(m["ssrr_loss"]),
    )
    output = stack(
        [
            regression.finish(state, member, config.regression)
            for state, member in zip(population.members(states), members, strict=True)
        ]
    )
    directory.save_output("regression", output)
    return output


def _regression_data(
    config: RepresentConfig, problem: Problem, noisy: noise.NoisyData, curves: curve.Curve
) -> regression.RegressionData:
    values = curves.fitted if config.curve.targets == "curve" else curves.scaled_returns
    targets = jnp.repeat(values, config.noise.trajectories_per_level, axis=1)
    return regression.RegressionData(noisy.trajectories, targets, padded_demonstrations(problem))


def run_updates(
    stage: str,
    key: jax.Array,
    init: Callable[[jax.Array], Any],
    train: Callable[[Any, Any, int], tuple[Any, Metrics]],
    data: Any,
    finish: Callable[[Any], Any],
    num_updates: int,
    directory: RunDirectory,
    checkpoint_seconds: float,
    describe: Callable[[Metrics], str] | None = None,
) -> Any:
    """Supervised learning in twenty chunks; returns and saves what `finish` reads.

    Args:
      stage: its name in the run directory.
      key: PRNG key.
      init: `init(key)`, the state to begin with.
      train: `train(state, data, num_updates)`, the state after them, and metrics.
      data: what it learns from; an argument of the compiled program, not a constant in it.
      finish: reads the stage's output from the last state.
      num_updates: budget.
      directory: where the stage is saved, and restored from.
      checkpoint_seconds: least time between two checkpoints.
      describe: what to show of the metrics beside the progress.
    """
    if directory.is_done(stage):
        example = jax.eval_shape(lambda key: finish(init(key)), key)
        return directory.load_output(stage, example)
    per_chunk = max(1, num_updates // 20)
    compiled = jax.jit(lambda state, data: train(state, data, per_chunk), donate_argnums=0)
    state = advance(
        directory,
        stage,
        jax.jit(init)(key),
        lambda state: compiled(state, data),
        -(-num_updates // per_chunk),
        units_per_chunk=per_chunk,
        unit="updates",
        checkpoint_seconds=checkpoint_seconds,
        describe=describe,
    )
    output = finish(state)
    directory.save_output(stage, output)
    return output


def padded_demonstrations(problem: Problem) -> TrajectoryBatch:
    """Demonstrations `[num_strategies, num_demonstrations]`, repeated to one common number."""
    demonstrations = problem.lessons
    groups = [demonstrations.of_strategy(i) for i in range(demonstrations.num_strategies)]
    most = max(len(group) for group in groups)
    padded = [
        pad([group[j % len(group)] for j in range(most)], problem.env.horizon) for group in groups
    ]
    return stack(padded)


def chunk_of(env_steps: int, per_step: int) -> int:
    """Environment steps between two host round trips: a twentieth of the budget."""
    return max(1, env_steps // 20 // per_step) * per_step


def blank_transitions(env: Environment, *shape: int) -> Transition:
    """Transitions of zeros, `[*shape]`, for what asks stages for shapes alone."""
    obs, nothing = jnp.zeros((*shape, env.observation_size)), jnp.zeros(shape)
    action = jnp.zeros((*shape, env.action_size))
    return Transition(obs, action, obs, nothing, nothing, nothing)


def shape_like(leaf: Any, num_members: int) -> jax.ShapeDtypeStruct:
    """Shape and type of a leaf of a population."""
    return jax.ShapeDtypeStruct((num_members, *leaf.shape), leaf.dtype)


def numbers(values: Any) -> str:
    """One number, or one of each member, for a progress bar."""
    return " ".join(f"{float(value):.3g}" for value in np.atleast_1d(values))
