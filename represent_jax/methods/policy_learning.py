"""Policies on learned rewards, all targets as one population on a run directory, and selection."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents import rollout as rollouts
from represent_jax.agents.sac import PolicyParams
from represent_jax.envs import Environment, Episode
from represent_jax.methods.config import MethodConfig
from represent_jax.methods.pipeline import numbers, shape_like
from represent_jax.methods.population import Population, member_of, stack
from represent_jax.runs import RunDirectory
from represent_jax.runs.loop import advance
from represent_jax.stages import policies, selection
from represent_jax.stages.policies import PoliciesConfig
from represent_jax.types import RewardFn


class Selected(NamedTuple):
    """What a selection hands on.

    Attributes:
      policies: leaves `[num_objectives, ...]`, in the order of the objectives.
      chosen: the objective each was trained on, `[num_objectives]`.
      learned_returns: of every trained policy (rows) under every reward (columns).
    """

    policies: PolicyParams
    chosen: jax.Array
    learned_returns: jax.Array


class Trained(NamedTuple):
    """Policies and how they came about.

    Attributes:
      policies: leaves `[num_objectives, ...]`, in the order of the objectives.
      log: what was logged at every evaluation of the policy trained on each.
      selected: how they were selected; None where each objective has its own.
    """

    policies: PolicyParams
    log: list[dict[str, Any]]
    selected: Selected | None = None

    def policy(self, i: int) -> PolicyParams:
        """Returns the policy of objective i."""
        return member_of(self.policies, i)


def run(
    key: jax.Array,
    config: PoliciesConfig,
    population: str,
    env: Episode,
    objectives: Sequence[policies.Objective],
    reward_fn: RewardFn,
    starts: Callable[[], Sequence[PolicyParams]] | None,
    directory: RunDirectory,
    checkpoint_seconds: float,
) -> Trained:
    """Trains a policy on every objective.

    Args:
      key: PRNG key.
      config: settings.
      population: how they run together, see `methods.population`.
      env: episodes to learn in.
      objectives: what to maximise.
      reward_fn: the reward whose parameters the objectives hold.
      starts: makes the policy that each begins as; None where there are none, for a cold start.
      directory: where the stage is saved, and restored from.
      checkpoint_seconds: least time between two checkpoints.
    """
    key_start, key = jax.random.split(key)

    def init(key, member):
        return policies.init(key, env, *member, config, reward_fn)

    if directory.is_done("policies"):
        example = jax.eval_shape(lambda key: _random_policy(key, env, config), key)
        example = jax.tree.map(lambda x: shape_like(x, len(objectives)), example)
        return Trained(directory.load_output("policies", example), directory.read_log("policies"))
    if starts is None:
        begun = [_random_policy(key_start, env, config)] * len(objectives)
    else:
        begun = starts()
    members = list(zip(objectives, begun, strict=True))
    population = Population(
        members, population, lambda state: policies.population_axes(state, config)
    )
    step = population.stepper(
        lambda state, member: policies.train(state, env, member[0], config, reward_fn)
    )
    _, settings = policies.agent_of(config)
    chunk_env_steps = policies.steps_per_evaluation(config) * settings.env_steps_per_step
    states = advance(
        directory,
        "policies",
        lambda: population.init(init, key),
        step,
        -(-config.env_steps // chunk_env_steps),
        units_per_chunk=chunk_env_steps,
        checkpoint_seconds=checkpoint_seconds,
        describe=lambda m: "learned return " + numbers(m["learned_return"]),
        example=population.example(init),
    )
    output = stack([policies.finish(state, config) for state in population.members(states)])
    directory.save_output("policies", output)
    return Trained(output, directory.read_log("policies"))


def select(
    key: jax.Array,
    config: PoliciesConfig,
    margins: Sequence[float],
    env: Episode,
    objectives: Sequence[policies.Objective],
    reward_fn: RewardFn,
    trained: Trained,
    directory: RunDirectory,
    task: policies.Objective | None = None,
    floors: Sequence[float] | None = None,
) -> Trained:
    """Hands every objective its own policy or a better one of another's, see `stages.selection`.

    Args:
      key: PRNG key.
      config: settings of the policies.
      margins: of every objective, as `selection.choose` takes them.
      env: episodes to judge in.
      objectives: what was maximised.
      reward_fn: the reward whose parameters the objectives hold.
      trained: the policies, of the objectives in their order.
      directory: where the stage is saved, and restored from.
      task, floors: R^0, and what of it a policy has to earn to be handed to each objective; without
        them none has to earn anything.
    """
    if directory.is_done("selection"):
        example = _selected_like(trained.policies, len(objectives))
        selected = directory.load_output("selection", example)
    else:
        candidates = [trained.policy(i) for i in range(len(objectives))]
        judges = [*objectives, *([] if task is None else [task])]
        returns = learned_returns(key, env, judges, candidates, config, reward_fn)
        returns, of_task = returns[:, : len(objectives)], returns[:, -1]
        floors = None if floors is None else jnp.asarray(floors)
        chosen = selection.choose(returns, jnp.asarray(margins), of_task, floors)
        handed_on = jax.tree.map(lambda x: x[chosen], trained.policies)
        selected = Selected(handed_on, chosen, returns)
        directory.save_output("selection", selected)
    return Trained(selected.policies, trained.log, selected)


def best_start(
    key: jax.Array,
    env: Episode,
    objective: policies.Objective,
    starts: Sequence[PolicyParams],
    config: PoliciesConfig,
    reward_fn: RewardFn,
) -> PolicyParams:
    """The policy with the highest learned return."""
    returns = learned_returns(key, env, [objective], starts, config, reward_fn)[:, 0]
    return starts[int(np.argmax(np.where(np.isfinite(returns), returns, -np.inf)))]


def learned_returns(
    key: jax.Array,
    env: Episode,
    objectives: Sequence[policies.Objective],
    candidates: Sequence[PolicyParams],
    config: PoliciesConfig,
    reward_fn: RewardFn,
) -> jax.Array:
    """Mean learned return of policies in the same episodes, `[num_policies, num_objectives]`."""
    rewards = stack([objective.params for objective in objectives])

    @jax.jit
    def judge(policy):
        batch = policies.rollout(key, env, policy, config.eval_episodes, config)
        return jax.vmap(
            lambda params: jnp.mean(rollouts.learned_returns(batch, reward_fn, params))
        )(rewards)

    return jnp.stack([judge(policy) for policy in candidates])


def load(
    config: MethodConfig, env: Environment, directory: RunDirectory
) -> dict[str, Callable[[jax.Array], jax.Array]]:
    """The policies that a run of any method with `policies` hands on, by target.

    They take a key beside observations, for actions that are to be sampled; see `policies.act`.
    """
    names = config.policy_names
    key = jax.random.PRNGKey(0)
    example = jax.eval_shape(lambda key: _random_policy(key, env, config.policies), key)
    example = jax.tree.map(lambda x: shape_like(x, len(names)), example)
    if directory.is_done("selection"):
        example = _selected_like(example, len(names))
        stacked = directory.load_output("selection", example).policies
    else:
        stacked = directory.load_output("policies", example)

    def policy_of(i):
        params = member_of(stacked, i)
        return lambda obs, key=None: policies.act(
            params, obs, env.action_size, config.policies, key
        )

    return {name: policy_of(i) for i, name in enumerate(names)}


def _random_policy(
    key: jax.Array, env: Environment | Episode, config: PoliciesConfig
) -> PolicyParams:
    agent, settings = policies.agent_of(config)
    return agent.policy_of(agent.init_learner(key, env.observation_size, env.action_size, settings))


def _selected_like(policies_like: PolicyParams, num_objectives: int) -> Selected:
    """Shapes and types of a selection's output."""
    shape = (num_objectives,)
    return Selected(
        jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), policies_like),
        jax.ShapeDtypeStruct(shape, jnp.int32),
        jax.ShapeDtypeStruct(shape * 2, jnp.float32),
    )
