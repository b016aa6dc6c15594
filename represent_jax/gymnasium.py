"""Learned rewards in Gymnasium, so that agents of any library train on them."""

import os
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from represent_jax.api import load_reward_for
from represent_jax.config import require
from represent_jax.errors import RepresentError


class LearnedReward(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Pays a run's learned reward; the environment's own is in `info["true_reward"]`.

    It belongs directly around the environment: a wrapper inside it that changes observations would
    change what the reward sees. Actions are bounded to the action space, as environments of
    Gymnasium do themselves.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        run_dir: str | os.PathLike,
        target: str = "task",
        scale: float = 1.0,
    ):
        """Loads the reward.

        Args:
          env: an environment with the run's observations and actions.
          run_dir: folder of the run.
          target: "task" (R^0), or "strategy_1" (R^1) and so on.
          scale: factor on the reward. REPRESENT's rewards sum to about 10 over an episode of a
            demonstrator, so horizon / 10 pays one about 1 a step.

        Raises:
          RepresentError: the run has not finished its reward learning, or its method learns none.
          UsageError: no target of that name, or spaces that are not the run's.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, run_dir=os.fspath(run_dir), target=target, scale=scale
        )
        gymnasium.Wrapper.__init__(self, env)
        self._reward = _Reward(run_dir, target, scale, env.observation_space, env.action_space)
        self._obs: np.ndarray | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        self._obs = np.array(obs)
        return obs, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        next_obs, true_reward, terminated, truncated, info = self.env.step(action)
        rows = (np.asarray(x)[None] for x in (self._obs, action, next_obs))
        reward = float(self._reward(*rows)[0])
        self._obs = np.array(next_obs)
        return next_obs, reward, terminated, truncated, info | {"true_reward": true_reward}


class LearnedRewardVector(gymnasium.vector.VectorWrapper):
    """Pays a run's learned reward in a vector environment, computed for all of it at once.

    The environments' own rewards are in `infos["true_reward"]`. A reward is always that of the
    step's true next observation, never of a reset's: where environments reset themselves in the
    same step it is taken from `infos["final_obs"]`; where they do so in the next step, that step
    pays nothing.
    """

    def __init__(
        self,
        env: gymnasium.vector.VectorEnv,
        run_dir: str | os.PathLike,
        target: str = "task",
        scale: float = 1.0,
    ):
        """Loads the reward.

        Args:
          env: a vector environment with the run's observations and actions, whose metadata name
            its `autoreset_mode`.
          run_dir: folder of the run.
          target: "task" (R^0), or "strategy_1" (R^1) and so on.
          scale: factor on the reward, see `LearnedReward`.

        Raises:
          RepresentError: the run has not finished its reward learning, or its method learns none.
          UsageError: no target of that name, spaces that are not the run's, or no autoreset mode.
        """
        super().__init__(env)
        mode = env.metadata.get("autoreset_mode")
        require(
            isinstance(mode, AutoresetMode),
            'metadata["autoreset_mode"]',
            "a gymnasium.vector.AutoresetMode",
            mode,
        )
        self._mode = mode
        self._reward = _Reward(
            run_dir, target, scale, env.single_observation_space, env.single_action_space
        )
        self._obs: np.ndarray | None = None
        self._ended = np.zeros(env.num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        # Read first: the environment takes the mask out of the options.
        restarted = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        obs, infos = self.env.reset(seed=seed, options=options)
        self._obs = np.array(obs)
        self._ended = self._ended & ~restarted
        return obs, infos

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        obs, true_rewards, terminated, truncated, infos = self.env.step(actions)
        obs_after, ended = np.array(obs), np.asarray(terminated) | np.asarray(truncated)
        resetting = self._ended & (self._mode is AutoresetMode.NEXT_STEP)
        true_obs = obs_after
        if self._mode is AutoresetMode.SAME_STEP and ended.any():
            true_obs = _with_final(obs_after, ended, infos)
        rewards = self._reward(self._obs, np.asarray(actions), true_obs)
        self._obs, self._ended = obs_after, ended
        infos = infos | {"true_reward": np.asarray(true_rewards), "_true_reward": ~resetting}
        return obs, np.where(resetting, 0.0, rewards), terminated, truncated, infos


class _Reward:
    """A run's reward for batches of the observations and actions of given spaces."""

    def __init__(
        self,
        run_dir: str | os.PathLike,
        target: str,
        scale: float,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
    ):
        for field, space in (
            ("observation_space", observation_space),
            ("action_space", action_space),
        ):
            is_vector = isinstance(space, Box) and len(space.shape) == 1
            require(is_vector, field, "a Box with one axis", space)
        require(
            np.isfinite([action_space.low, action_space.high]).all(),
            "action_space",
            "bounded actions, which the reward sees as [-1, 1]",
            action_space,
        )
        low, high = (bound.astype(np.float32) for bound in (action_space.low, action_space.high))
        learned = load_reward_for(
            run_dir, target, observation_space.shape[0], action_space.shape[0]
        )

        @jax.jit
        def reward(obs_t, action_t, next_obs_t):
            unit = 2.0 * (action_t - low) / (high - low) - 1.0
            return scale * learned(obs_t, jnp.clip(unit, -1.0, 1.0), next_obs_t)

        self._jitted = reward

    def __call__(
        self, obs_t: np.ndarray, action_t: np.ndarray, next_obs_t: np.ndarray
    ) -> np.ndarray:
        rows = (np.asarray(x, np.float32) for x in (obs_t, action_t, next_obs_t))
        return np.asarray(self._jitted(*rows), np.float64)


def _with_final(obs: np.ndarray, ended: np.ndarray, infos: dict[str, Any]) -> np.ndarray:
    """Puts the true final observations in the place of those of resets."""
    if "final_obs" not in infos:
        raise RepresentError(
            "an episode ended in a vector environment that resets in the same step, "
            'and infos["final_obs"] is missing'
        )
    obs = obs.copy()
    for i in np.flatnonzero(ended):
        obs[i] = infos["final_obs"][i]
    return obs
