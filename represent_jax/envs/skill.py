"""Environments seen by a policy that has several skills."""

import jax
import jax.numpy as jnp
from brax.envs import base


class SkillConditioned(base.Env):
    """Appends a one-hot skill to every observation; the skill is the caller's to set.

    The skill lives in `info["skill"]` and survives resets, so that each vectorised environment
    belongs to one skill.

    Attributes:
      env: the episodes inside.
      num_skills: number of skills.
    """

    def __init__(self, env: base.Env, num_skills: int):
        self.env = env
        self.num_skills = num_skills

    @property
    def observation_size(self) -> int:
        return self.env.observation_size + self.num_skills

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return self.env.backend

    @property
    def horizon(self) -> int:
        """Steps after which an episode is cut off."""
        return self.env.horizon

    @property
    def terminates(self) -> bool:
        """Whether episodes can end before that."""
        return self.env.terminates

    @property
    def unwrapped(self) -> base.Env:
        return self.env.unwrapped

    def reset(self, rng: jax.Array, skill: jax.Array | int = 0) -> base.State:
        """Starts an episode of one skill, `[]` int."""
        return self._append(self.env.reset(rng), jax.nn.one_hot(skill, self.num_skills))

    def step(self, state: base.State, action: jax.Array) -> base.State:
        skill = state.info["skill"]
        inner = {k: v for k, v in state.info.items() if k != "skill"}
        obs = state.obs[: -self.num_skills]
        return self._append(self.env.step(state.replace(obs=obs, info=inner), action), skill)

    def _append(self, state: base.State, skill: jax.Array) -> base.State:
        info = state.info | {
            "skill": skill,
            "next_obs": jnp.concatenate([state.info["next_obs"], skill]),
        }
        return state.replace(obs=jnp.concatenate([state.obs, skill]), info=info)
