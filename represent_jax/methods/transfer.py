"""Policies in Gymnasium's own environments, against the returns they have in ours."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import SyncVectorEnv

from represent_jax.agents import rollout as rollouts
from represent_jax.envs import Episode
from represent_jax.errors import unknown

Policy = Callable[[jax.Array], jax.Array]


class GymnasiumTask(NamedTuple):
    """What Gymnasium calls a task.

    Attributes:
      id: the environment's id.
      options: arguments it is made with.
    """

    id: str
    options: Mapping[str, Any]


# Version 4 is version 3 (2 of the double pendulum) of Gym, which the tasks copy, on today's MuJoCo.
TASKS = {
    "hopper": GymnasiumTask("Hopper-v4", {"terminate_when_unhealthy": False}),
    "half_cheetah": GymnasiumTask("HalfCheetah-v4", {}),
    "inverted_double_pendulum": GymnasiumTask("InvertedDoublePendulum-v4", {}),
}


class Comparison(NamedTuple):
    """A policy's mean return here and there.

    Attributes:
      ours, ours_error: mean over our episodes, and its standard error.
      gymnasium, gymnasium_error: the same of Gymnasium's.
      difference: Gymnasium's mean minus ours, in units of the difference's standard error; 0 where
        neither side varies and they agree.
    """

    ours: float
    ours_error: float
    gymnasium: float
    gymnasium_error: float
    difference: float


def compare(ours: np.ndarray, gymnasiums: np.ndarray) -> Comparison:
    """Compares the returns of independent episodes, `[num_episodes]` each, at least two."""
    (our_mean, our_error), (mean, error) = (
        (float(np.mean(x)), float(np.std(x, ddof=1) / np.sqrt(len(x))))
        for x in (np.asarray(ours, np.float64), np.asarray(gymnasiums, np.float64))
    )
    apart, both = mean - our_mean, float(np.hypot(our_error, error))
    with np.errstate(divide="ignore"):
        difference = 0.0 if apart == 0.0 else float(np.divide(apart, both))
    return Comparison(our_mean, our_error, mean, error, difference)


def our_returns(env: Episode, policy: Policy, num_episodes: int, seed: int) -> np.ndarray:
    """True returns of a policy in our episodes, `[num_episodes]`."""
    whole = Episode(env.env, env.horizon, auto_reset=False)

    @jax.jit
    def returns(key):
        batch = rollouts.rollout(
            whole, lambda _, obs_t, key: policy(obs_t), None, key, jnp.zeros(num_episodes)
        )
        return rollouts.true_returns(batch)

    return np.asarray(returns(jax.random.PRNGKey(seed)))


def gymnasium_returns(
    env_name: str, horizon: int, policy: Policy, num_episodes: int, seed: int
) -> np.ndarray:
    """Returns of a policy in Gymnasium's own environment, `[num_episodes]`.

    Raises:
      UsageError: Gymnasium has no environment of that task.
    """
    if env_name not in TASKS:
        raise unknown("task of Gymnasium", env_name, TASKS)
    task = TASKS[env_name]

    def make():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Version 4 is what is wanted, and is called outdated.
            return gymnasium.make(task.id, max_episode_steps=horizon, **task.options)

    act = jax.jit(policy)
    envs = SyncVectorEnv([make] * num_episodes)
    obs, _ = envs.reset(seed=seed)
    returns, running = np.zeros(num_episodes), np.ones(num_episodes, bool)
    while running.any():
        actions = np.asarray(act(jnp.asarray(obs, jnp.float32)))
        obs, rewards, terminated, truncated, _ = envs.step(actions)
        returns += np.where(running, rewards, 0.0)
        running &= ~(terminated | truncated)
    envs.close()
    return returns


def transfer(
    env_name: str, env: Episode, policies: Mapping[str, Policy], num_episodes: int, seed: int
) -> dict[str, Comparison]:
    """Runs policies in our episodes and in Gymnasium's, by target.

    Args:
      env_name: name of the task.
      env: our episodes of it; Gymnasium's are cut off after as many steps.
      policies: by target.
      num_episodes: episodes on each side, at least two.
      seed: of the initial states.

    Raises:
      UsageError: Gymnasium has no environment of that task.
    """
    return {
        target: compare(
            our_returns(env, policy, num_episodes, seed),
            gymnasium_returns(env_name, env.horizon, policy, num_episodes, seed),
        )
        for target, policy in policies.items()
    }
