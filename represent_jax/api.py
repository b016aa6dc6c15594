"""What research code needs: to make a run, and of a finished one its rewards and policies."""

import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax import config as configs
from represent_jax.data.trajectories import Demonstrations
from represent_jax.envs import make_env
from represent_jax.errors import UsageError, unknown
from represent_jax.methods.config import MethodConfig, make_problem
from represent_jax.methods.plan import execute, stage_names
from represent_jax.methods.registry import find_method
from represent_jax.runs import RunDirectory, load_config_json, open_run
from represent_jax.stages import strategies

# What a folder's settings begin with where it holds no run of a method.
_OTHER_FOLDERS = {
    "kind": "a stage of a campaign; experiments.represent with the same preset, seed and settings "
    "makes the same run in a folder of its own",
    "run": "a policy of experiments.train_policy",
}


def learn(
    run_dir: str | os.PathLike,
    config: MethodConfig,
    demonstrations: Demonstrations,
    test: Demonstrations | None = None,
    until: str = "",
    resume: bool = False,
) -> dict[str, Any] | None:
    """Runs a method in a folder, as `python -m experiments.represent` does.

    Args:
      run_dir: folder of the run, new unless it is resumed.
      config: settings, such as those of `make_config`.
      demonstrations: of every strategy; the true reward in them is not learned from.
      test: unseen trajectories, on which learned rewards are judged; may be none.
      until: the last stage to run, such as "regression"; all if empty.
      resume: whether to go on with what the folder holds.

    Returns:
      What was found, None where the run stopped before its last stage.

    Raises:
      UsageError: no stage of that name, or the folder holds a run already.
      RepresentError: the data do not fit the environment, or a loss diverged.
    """
    problem = make_problem(config, make_env(config.env, config.backend), demonstrations, test)
    stages = find_method(config.method).plan(config, problem)
    stage_names(stages, until)
    with open_run(run_dir, config, resume=resume) as run:
        return execute(config, problem, stages, run, until)


def load_config(run_dir: str | os.PathLike) -> MethodConfig:
    """Loads the settings a run was made with.

    Raises:
      UsageError: not the folder of a method's run, or one of an older format.
    """
    stored = load_config_json(run_dir)
    if "method" not in stored:
        what = _OTHER_FOLDERS.get(next(iter(stored), ""), "something else")
        raise UsageError(
            f"{run_dir}: expected a run of a method, of experiments.represent or rj.learn, found "
            f"{what}"
        )
    return configs.restore(find_method(stored["method"]).config, stored)


def infer_strategies(
    demonstrations: Demonstrations, num_strategies: int = 0, seed: int = 0
) -> Demonstrations:
    """Labels demonstrations by strategy; the labels that they carry are not looked at.

    Args:
      demonstrations: the pool.
      num_strategies: how many strategies there are; 0 if that is to be found out.
      seed: seed of what is drawn where actions are missing; without effect elsewhere.

    Returns:
      The same demonstrations with strategies numbered by first appearance; the metadata holds the
      confidence of each trajectory's label, under "inferred_strategies".

    Raises:
      RepresentError: more strategies are asked for than there are trajectories, or one without
        actions is too short to tell.
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
      UsageError: (when called) no target of that name, or arrays of other shapes.
    """
    config = load_config(run_dir)
    env = make_env(config.env, config.backend)
    rewards = find_method(config.method).load_rewards(config, env, RunDirectory(run_dir))

    def reward(obs_t, action_t, next_obs_t, target: str = "task") -> jax.Array:
        if target not in rewards:
            raise unknown("target", target, rewards)
        leading = np.shape(next_obs_t)[:-1]
        return rewards[target](
            _sized("obs_t", obs_t, (*leading, env.observation_size)),
            None if action_t is None else _sized("action_t", action_t, (*leading, env.action_size)),
            _sized("next_obs_t", next_obs_t, (*leading, env.observation_size)),
        )

    return reward


def load_reward_for(
    run_dir: str | os.PathLike, target: str, observation_size: int, action_size: int
) -> Callable[..., jax.Array]:
    """Loads one of a run's rewards for an environment that was made elsewhere.

    Args:
      run_dir: folder of the run.
      target: "task", or "strategy_1" and so on.
      observation_size: entries of that environment's observations.
      action_size: entries of its actions.

    Returns:
      `reward(obs_t, action_t, next_obs_t)`, for actions in [-1, 1]; see `load_reward`.

    Raises:
      RepresentError: the run has not finished its reward learning, or its method learns none.
      UsageError: no target of that name, or the run's environment has other sizes.
    """
    config = load_config(run_dir)
    env = make_env(config.env, config.backend)
    for field, expected, found in (
        ("observation size", env.observation_size, observation_size),
        ("action size", env.action_size, action_size),
    ):
        in_run = f"{expected}, that of {config.env} in {run_dir}"
        configs.require(found == expected, field, in_run, found)
    rewards = find_method(config.method).load_rewards(config, env, RunDirectory(run_dir))
    if target not in rewards:
        raise unknown("target", target, rewards)
    return rewards[target]


def load_policy(run_dir: str | os.PathLike, target: str = "task") -> Callable[..., jax.Array]:
    """Loads one of a run's policies.

    Args:
      run_dir: folder of the run.
      target: "task", or "strategy_1" and so on.

    Returns:
      `policy(obs, key=None) -> action`, a pure function of observations `[..., obs_dim]`. Where
      policies are to sample (`policies.actions`, in the kitchens), the noise is drawn from the key,
      and without one from the observation's own bits: then episodes that start alike go on alike.

    Raises:
      RepresentError: the run has not trained its policies, or they carry a hidden state.
      UsageError: no target of that name, or (when called) observations of another size.
    """
    config = load_config(run_dir)
    if target not in config.policy_names:
        raise unknown("target", target, config.policy_names)
    env = make_env(config.env, config.backend)
    policies = find_method(config.method).load_policies(config, env, RunDirectory(run_dir))
    if target not in policies:
        raise unknown("policy", target, policies)

    def policy(obs, key=None) -> jax.Array:
        shape = (*np.shape(obs)[:-1], env.observation_size)
        return policies[target](_sized("obs", obs, shape), key)

    return policy


def _sized(field: str, values: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    configs.require(
        np.shape(values) == shape, field, f"an array of shape {shape}", np.shape(values)
    )
    return jnp.asarray(values)
