"""What research code needs of a finished run: its rewards and its policies."""

import os
from collections.abc import Callable

import jax
import jax.numpy as jnp

from represent_jax import config as configs
from represent_jax.data.trajectories import Demonstrations
from represent_jax.envs import make_env
from represent_jax.errors import unknown
from represent_jax.methods.config import MethodConfig
from represent_jax.methods.registry import find_method
from represent_jax.runs import RunDirectory, load_config_json
from represent_jax.stages import strategies


def load_config(run_dir: str | os.PathLike) -> MethodConfig:
    """Loads the settings a run was made with.

    Raises:
      RepresentError: not a run directory, or one of an older format.
    """
    stored = load_config_json(run_dir)
    return configs.from_dict(find_method(stored.get("method", "represent")).config, stored)


def infer_strategies(
    demonstrations: Demonstrations, num_strategies: int = 0, seed: int = 0
) -> Demonstrations:
    """Labels demonstrations by strategy; the labels that they carry are not looked at.

    Args:
      demonstrations: the pool.
      num_strategies: how many strategies there are; 0 if that is to be found out.
      seed: seed of the random features and of the resamples.

    Returns:
      The same demonstrations with strategies numbered by first appearance; the metadata holds the
      confidence of each trajectory's label, under "inferred_strategies".

    Raises:
      RepresentError: a trajectory is too short to tell.
    """
    config = strategies.StrategiesConfig(num_strategies=num_strategies)
    found = strategies.infer(jax.random.PRNGKey(seed), demonstrations.trajectories, config)
    return strategies.label(demonstrations, found)


def load_reward(run_dir: str | os.PathLike) -> Callable[..., jax.Array]:
    """Loads a run's rewards as one function.

    Returns:
      `reward(obs_t, action_t, next_obs_t, target="task")`, which takes NumPy or JAX arrays of
      shape `[..., dim]` and returns `[...]`; `target` is "task" (R^0), or "strategy_1" (R^1) and
      so on. It can be called under the caller's own jit and vmap. Actions may be None unless the
      reward was made to see them.

    Raises:
      RepresentError: the run has not finished its reward learning, or its method learns none.
      UsageError: (when called) no target of that name.
    """
    config = load_config(run_dir)
    env = make_env(config.env, config.backend)
    rewards = find_method(config.method).load_rewards(config, env, RunDirectory(run_dir))

    def reward(obs_t, action_t, next_obs_t, target: str = "task") -> jax.Array:
        if target not in rewards:
            raise unknown("target", target, rewards)
        rows = (obs_t, action_t, next_obs_t)
        return rewards[target](*(None if x is None else jnp.asarray(x) for x in rows))

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
      RepresentError: the run has not trained its policies, or they carry a hidden state.
      UsageError: no target of that name.
    """
    config = load_config(run_dir)
    if target not in config.policy_names:
        raise unknown("target", target, config.policy_names)
    env = make_env(config.env, config.backend)
    policies = find_method(config.method).load_policies(config, env, RunDirectory(run_dir))
    if target not in policies:
        raise unknown("policy", target, policies)
    return lambda obs: policies[target](jnp.asarray(obs))
