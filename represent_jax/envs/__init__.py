"""Tasks on top of the physics: Brax environments with Gym's observations and rewards."""

from represent_jax.envs.environment import Environment
from represent_jax.envs.episode import Episode
from represent_jax.envs.playground import Adapted
from represent_jax.envs.registry import make_env, names, register
from represent_jax.envs.task import Task

__all__ = ["Adapted", "Environment", "Episode", "Task", "make_env", "names", "register"]
