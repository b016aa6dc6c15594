"""HalfCheetah with the observation, reward and reset of Gym's HalfCheetah-v3."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from represent_jax.envs.task import Task, load_gymnasium_model, qpos_along_track
from represent_jax.physics.engine import PhysicsState
from represent_jax.physics.mjx import MjxSolver


class HalfCheetah(Task):
    """Run forward: velocity minus a control cost, never terminating."""

    name = "half_cheetah"
    frame_skip = 5
    mjx_solver = MjxSolver(iterations=4, ls_iterations=4)

    def load_model(self) -> mujoco.MjModel:
        return load_gymnasium_model("half_cheetah.xml")

    def reset(self, key: jax.Array, init_qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_qpos, key_qvel = jax.random.split(key)
        noise = jax.random.uniform(key_qpos, init_qpos.shape, minval=-0.1, maxval=0.1)
        return init_qpos + noise, 0.1 * jax.random.normal(key_qvel, init_qpos.shape)

    def observe(self, physics: PhysicsState) -> jax.Array:
        return jnp.concatenate([physics.qpos[1:], physics.qvel])

    def reward(
        self, before: PhysicsState, action_t: jax.Array, after: PhysicsState, dt: float
    ) -> jax.Array:
        forward_velocity = (after.qpos[0] - before.qpos[0]) / dt
        return forward_velocity - 0.1 * jnp.sum(jnp.square(action_t))

    def qpos_of(self, model: mujoco.MjModel, obs: np.ndarray, dt: float) -> np.ndarray:
        del model
        return qpos_along_track(obs, dt)
