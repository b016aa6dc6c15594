"""What research code needs of a finished run: its rewards and its policies."""

import os
from collections.abc import Callable

import jax
import jax.numpy as jnp

from represent_jax import config as configs
from represent_jax.envs import make_env
from represent_jax.errors import RepresentError, unknown
from represent_jax.methods.config import MethodConfig
from represent_jax.methods.registry import find_method
from represent_jax.runs import RunDirectory, load_config_json
from represent_jax.stages import policies, regression


def load_config(run_dir: str | os.PathLike) -> MethodConfig:
    """Loads the settings a run was made with.

    Raises:
      RepresentError: not a run directory, or one of an older format.
    """
    stored = load_config_json(run_dir)
    return configs.from_dict(find_method(stored.get("method", "represent")).config, stored)


def load_reward(run_dir: str | os.PathLike) -> Callable[..., jax.Array]:
    """Loads a run's rewards as one function.

    Returns:
      `reward(obs_t, action_t, next_obs_t, target="task")`, which takes NumPy or JAX arrays of
      shape `[..., dim]` and returns `[...]`; `target` is "task" (R^0), or "strategy_1" (R^1) and
      so on. It can be called under the caller's own jit and vmap.

    Raises:
      RepresentError: the run has not finished its regression.
      UsageError: (when called) no target of that name.
    """
    config = load_config(run_dir)
    run = RunDirectory(run_dir)
    if not run.is_done("regression"):
        raise RepresentError(f"{run_dir}: this run has no rewards yet, its regression is not done")
    env = make_env(config.env, config.backend)
    sizes = (env.observation_size, env.action_size, config.num_groups)
    example = jax.eval_shape(
        lambda key: regression.init(key, *sizes, config.regression), jax.random.PRNGKey(0)
    )
    rewards = run.load_output("regression", example.rewards)
    targets = config.target_names

    def reward(obs_t, action_t, next_obs_t, target: str = "task") -> jax.Array:
        if target not in targets:
            raise unknown("target", target, targets)
        strategy = targets.index(target) - 1 if targets.index(target) else None
        arrays = (jnp.asarray(x) for x in (obs_t, action_t, next_obs_t))
        return regression.reward(rewards, *arrays, config.regression, strategy)

    return reward


def load_policy(
    run_dir: str | os.PathLike, target: str = "task"
) -> Callable[[jax.Array], jax.Array]:
    """Loads one of a run's policies.

    Args:
      run_dir: folder of the run.
      target: "task", or "strategy_1" and so on.

    Returns:
      `policy(obs) -> action`, deterministic, for observations `[..., obs_dim]`.

    Raises:
      RepresentError: the run has not trained its policies.
      UsageError: no target of that name.
    """
    config = load_config(run_dir)
    run = RunDirectory(run_dir)
    targets = config.target_names
    if target not in targets:
        raise unknown("target", target, targets)
    if not run.is_done("policies"):
        raise RepresentError(f"{run_dir}: this run has no policies yet, it was not run to its end")
    env = make_env(config.env, config.backend)
    agent, settings = policies.agent_of(config.policies)
    learner = jax.eval_shape(
        lambda key: agent.init_learner(key, env.observation_size, env.action_size, settings),
        jax.random.PRNGKey(0),
    )
    example = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((len(targets), *x.shape), x.dtype), agent.policy_of(learner)
    )
    stacked = run.load_output("policies", example)
    params = jax.tree.map(lambda x: x[targets.index(target)], stacked)

    def policy(obs) -> jax.Array:
        unused_key = jax.random.PRNGKey(0)
        return agent.act(
            params, jnp.asarray(obs), unused_key, settings, env.action_size, deterministic=True
        )

    return policy
