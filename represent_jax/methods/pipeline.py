"""The stages on a run directory: population, progress, checkpoints, and loading what is done.

A stage itself (`represent_jax.stages`) knows of none of these. Methods call the functions here in
the order that makes the method.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents.sac import PolicyParams
from represent_jax.data.trajectories import Demonstrations, Trajectory, TrajectoryBatch, pad
from represent_jax.envs import Environment, Episode
from represent_jax.errors import RepresentError
from represent_jax.methods.config import Problem, RepresentConfig
from represent_jax.methods.population import Population, stack
from represent_jax.runs import RunDirectory
from represent_jax.runs.loop import advance
from represent_jax.stages import airl, bc, bc_rnn, curve, msrd, noise, policies, regression
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

    def policy(params, obs_t, key):
        return airl.act(params, obs_t, key, config.airl, problem.env.action_size)

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
    whole = Episode(env.env, env.horizon, auto_reset=False)

    def one(key, policy_params, reward_params):
        return noise.run(key, whole, policy, policy_params, reward_fn, reward_params, config)

    keys = jax.random.split(key, jax.tree.leaves(policy_params)[0].shape[0])
    inputs = (keys, policy_params, reward_params)
    if directory.is_done("noise"):
        return directory.load_output("noise", jax.eval_shape(jax.vmap(one), *inputs))
    output = jax.block_until_ready(jax.jit(jax.vmap(one))(*inputs))
    directory.save_output("noise", output)
    return output


def fit_curves(config: RepresentConfig, noisy: noise.NoisyData) -> curve.Curve:
    """The noise-performance curve of every strategy; leaves are `[num_strategies, ...]`.

    Raises:
      RepresentError: Phase 1's reward is not finite.
    """
    fit = jax.vmap(lambda levels, returns: curve.fit(levels, returns, config.curve))
    curves = jax.jit(fit)(noisy.levels, noisy.returns)
    _check_curves(curves)
    return curves


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

    targets = jnp.repeat(curves.fitted, config.noise.trajectories_per_level, axis=1)
    data = regression.RegressionData(noisy.trajectories, targets, padded_demonstrations(problem))

    def train(state, data, num_updates):
        return regression.train(state, data, config.regression, num_updates)

    return run_updates(
        "regression",
        key,
        init,
        train,
        data,
        lambda state: state.rewards,
        config.regression.num_updates,
        directory,
        checkpoint_seconds,
        describe=lambda m: "loss " + _numbers(m["ssrr_loss"]),
    )


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
        return directory.load_output(stage, finish(jax.eval_shape(init, key)))
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
    demonstrations = problem.demonstrations
    groups = [demonstrations.of_strategy(i) for i in range(demonstrations.num_strategies)]
    most = max(len(group) for group in groups)
    padded = [
        pad([group[j % len(group)] for j in range(most)], problem.env.horizon) for group in groups
    ]
    return stack(padded)


# --- Baselines ---


def run_bc(
    key: jax.Array,
    config: bc.BcConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> Params:
    """Behavioural cloning of all demonstrations together."""
    key_split, key = jax.random.split(key)
    every = _transitions(problem.demonstrations.trajectories)
    data = bc.split(key_split, every, config)
    return run_updates(
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


def run_bc_rnn(
    key: jax.Array,
    config: bc_rnn.BcRnnConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> bc_rnn.BcRnnParams:
    """Recurrent behavioural cloning of all demonstrations together."""
    data = pad(problem.demonstrations.trajectories, problem.env.horizon)
    data = jax.tree.map(jnp.asarray, data)
    return run_updates(
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


def run_msrd(
    key: jax.Array,
    config: msrd.MsrdConfig,
    problem: Problem,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> msrd.MsrdOutput:
    """MSRD's joint training of all strategies."""
    demonstrations = stack(transitions_of(problem.demonstrations))

    def init(key):
        return msrd.init(key, problem.env, demonstrations, config)

    if directory.is_done("msrd"):
        return directory.load_output("msrd", msrd.finish(jax.eval_shape(init, key)))
    per_step = config.sac.env_steps_per_step
    chunk_env_steps = _chunk(config.env_steps, per_step)
    num_steps = chunk_env_steps // per_step
    state = advance(
        directory,
        "msrd",
        jax.jit(init)(key),
        jax.jit(
            lambda state: msrd.train(state, problem.env, demonstrations, config, num_steps),
            donate_argnums=0,
        ),
        -(-config.env_steps // chunk_env_steps),
        units_per_chunk=chunk_env_steps,
        checkpoint_seconds=checkpoint_seconds,
        describe=lambda m: "discriminator " + _numbers(m["discriminator_loss"]),
    )
    output = msrd.finish(state)
    directory.save_output("msrd", output)
    return output


# --- Policies ---


def objectives_of(
    config: RepresentConfig, env: Episode, rewards: regression.Rewards
) -> list[policies.Objective]:
    """The objectives of a run's targets, in their order: R^0, and every R^i that there is."""
    scale = env.horizon / config.regression.return_scale
    return [
        policies.make_objective(
            regression.view(rewards, strategy, config.regression), scale, env, config.policies
        )
        for strategy in (None, *range(len(config.target_names) - 1))
    ]


def reward_fn_of(config: RepresentConfig) -> RewardFn:
    """R^0 or R^i as a function of its `regression.View`."""

    def reward_fn(view, obs_t, action_t, next_obs_t):
        return regression.view_reward(view, obs_t, action_t, next_obs_t, config.regression)

    return reward_fn


def run_policies(
    key: jax.Array,
    config: RepresentConfig,
    env: Episode,
    objectives: Sequence[policies.Objective],
    reward_fn: RewardFn,
    starts: Sequence[PolicyParams] | None,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> PolicyParams:
    """Policies on learned rewards; leaves of the result are `[num_objectives, ...]`.

    Args:
      key: PRNG key.
      config: settings.
      env: episodes to learn in.
      objectives: what to maximise. The first is the task's: it starts from the policy of highest
        learned task return; the others start from `starts` in order.
      reward_fn: the reward whose parameters the objectives hold.
      starts: Phase 1's policies; None where there are none, for a cold start.
      directory: where the stage is saved, and restored from.
      checkpoint_seconds: least time between two checkpoints.
    """
    settings = config.policies
    key_start, key = jax.random.split(key)
    if starts is None:
        starts = [_random_policy(key_start, env, settings)] * len(objectives)

    def init(key, member):
        return policies.init(key, env, *member, settings, reward_fn)

    if directory.is_done("policies"):
        state = jax.eval_shape(init, key, (objectives[0], starts[0]))
        example = policies.finish(state, settings)
        return directory.load_output(
            "policies", jax.tree.map(lambda x: _shape_like(x, len(objectives)), example)
        )
    best = _best_start(key_start, env, objectives[0], starts, settings, reward_fn)
    members = list(zip(objectives, [best, *starts[: len(objectives) - 1]], strict=True))
    population = Population(
        members, config.population, lambda state: policies.population_axes(state, settings)
    )
    step = population.stepper(
        lambda state, member: policies.train(state, env, member[0], settings, reward_fn)
    )
    per_step = policies.agent_of(settings)[1].env_steps_per_step
    chunk_env_steps = max(1, settings.eval_env_steps // per_step) * per_step
    states = advance(
        directory,
        "policies",
        population.init(init, key),
        step,
        -(-settings.env_steps // chunk_env_steps),
        units_per_chunk=chunk_env_steps,
        checkpoint_seconds=checkpoint_seconds,
        describe=lambda m: "learned return " + _numbers(m["learned_return"]),
    )
    output = stack([policies.finish(state, settings) for state in population.members(states)])
    directory.save_output("policies", output)
    return output


def load_agents(
    config: policies.PoliciesConfig,
    names: Sequence[str],
    env: Environment,
    directory: RunDirectory,
) -> dict[str, Callable[[jax.Array], jax.Array]]:
    """What `run_policies` saved, as deterministic functions of observations, by name."""
    agent, settings = policies.agent_of(config)
    key, action_dim = jax.random.PRNGKey(0), env.action_size
    example = jax.eval_shape(lambda key: _random_policy(key, env, config), key)
    stacked = directory.load_output(
        "policies", jax.tree.map(lambda x: _shape_like(x, len(names)), example)
    )

    def policy_of(i):
        params = jax.tree.map(lambda x: x[i], stacked)
        # The key is not used: actions are modes.
        return lambda obs: agent.act(params, obs, key, settings, action_dim, deterministic=True)

    return {name: policy_of(i) for i, name in enumerate(names)}


def _random_policy(key: jax.Array, env: Episode, config: policies.PoliciesConfig) -> PolicyParams:
    agent, settings = policies.agent_of(config)
    return agent.policy_of(agent.init_learner(key, env.observation_size, env.action_size, settings))


def _best_start(
    key: jax.Array,
    env: Episode,
    task: policies.Objective,
    starts: Sequence[PolicyParams],
    config: policies.PoliciesConfig,
    reward_fn: RewardFn,
) -> PolicyParams:
    """The Phase 1 policy with the highest learned task return."""
    score = jax.jit(
        lambda policy: policies.evaluate(key, env, task, policy, config, reward_fn).learned_return
    )
    return starts[int(np.argmax([float(score(policy)) for policy in starts]))]


def _chunk(env_steps: int, per_step: int) -> int:
    """Environment steps between two host round trips: a twentieth of the budget."""
    return max(1, env_steps // 20 // per_step) * per_step


def _shape_like(leaf: Any, num_members: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((num_members, *leaf.shape), leaf.dtype)


def _numbers(values: Any) -> str:
    return " ".join(f"{float(value):.3g}" for value in np.atleast_1d(values))
