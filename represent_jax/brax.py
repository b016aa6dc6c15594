"""Learned rewards in Brax and MuJoCo Playground, for agents written in JAX."""

import os
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs import base
from brax.envs.wrappers import training

from represent_jax.api import load_reward_for
from represent_jax.config import require
from represent_jax.envs import Episode


class LearnedReward(base.Wrapper):
    """Pays a run's learned reward; the environment's own is in `metrics["true_reward"]`.

    It belongs directly around the environment, inside wrappers that vectorise, end and reset
    episodes: a reset would put another observation in the place of the true next one. Pure, so
    that it can be called under the caller's own jit and vmap.

    Attributes:
      env: the environment inside, of Brax, of MuJoCo Playground or of `make_env`.
      obs_key: which of several observations the reward sees.
    """

    def __init__(
        self,
        env: base.Env,
        run_dir: str | os.PathLike,
        target: str = "task",
        scale: float = 1.0,
        obs_key: str = "state",
    ):
        """Loads the reward.

        Args:
          env: an environment with the run's observations, and actions in [-1, 1].
          run_dir: folder of the run.
          target: "task" (R^0), or "strategy_1" (R^1) and so on.
          scale: factor on the reward. REPRESENT's rewards sum to about 10 over an episode of a
            demonstrator, so horizon / 10 pays one about 1 a step.
          obs_key: which observation the reward sees where the environment has several.

        Raises:
          RepresentError: the run has not finished its reward learning, or its method learns none.
          UsageError: no target of that name, sizes that are not the run's, or an environment that
            resets itself.
        """
        super().__init__(env)
        self.obs_key = obs_key
        for inside in _layers(env):
            require(
                not _resets_itself(inside),
                "env",
                "one that does not reset itself (wrap it before it is made to)",
                type(inside).__name__,
            )
        size = env.observation_size
        if isinstance(size, Mapping):
            require(obs_key in size, "obs_key", f"one of {', '.join(sorted(size))}", obs_key)
            size = size[obs_key]
        size = size if isinstance(size, int) else size[-1]
        self._reward = load_reward_for(run_dir, target, size, env.action_size)
        self._scale = scale

    def reset(self, rng: jax.Array, *args: Any, **kwargs: Any) -> base.State:
        state = self.env.reset(rng, *args, **kwargs)
        metrics = {**state.metrics, "true_reward": jnp.zeros_like(state.reward)}
        return state.replace(metrics=metrics)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        # Copied, since environments of Playground write into the metrics they are given.
        metrics = {name: value for name, value in state.metrics.items() if name != "true_reward"}
        before = self._seen(state)
        after = self.env.step(state.replace(metrics=metrics), action)
        learned = self._reward(before, jnp.clip(action, -1.0, 1.0), self._seen(after))
        return after.replace(
            reward=(self._scale * learned).astype(after.reward.dtype),
            metrics={**after.metrics, "true_reward": after.reward},
        )

    def _seen(self, state: base.State) -> jax.Array:
        return state.obs[self.obs_key] if isinstance(state.obs, Mapping) else state.obs


def _layers(env: Any) -> Iterator[Any]:
    """Yields an environment and what it wraps, the outermost first."""
    yield env
    while "env" in vars(env):
        env = env.env
        yield env


def _resets_itself(env: Any) -> bool:
    if isinstance(env, Episode):
        return env.auto_reset
    # Playground's own is not one of Brax's, and Playground need not be installed.
    named = type(env).__name__ == "BraxAutoResetWrapper"
    return named or isinstance(env, training.AutoResetWrapper)
