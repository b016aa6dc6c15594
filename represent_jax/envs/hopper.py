"""Hopper with the observation, reward and reset of Gym's Hopper-v3."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from represent_jax.envs.task import Task, load_gymnasium_model, qpos_along_track
from represent_jax.physics.engine import PhysicsState
from represent_jax.physics.mjx import MjxSolver


class Hopper(Task):
    """Hop forward: velocity, a bonus while healthy, minus a control cost.

    Without termination (the default, as in the paper) the bonus is paid in healthy states only;
    with it, Gym pays the bonus on the terminating step as well.
    """

    name = "hopper"
    frame_skip = 4
    mjx_solver = MjxSolver(iterations=4, ls_iterations=4)

    def __init__(self, terminates: bool = False):
        self.terminates = terminates

    def load_model(self) -> mujoco.MjModel:
        return load_gymnasium_model("hopper.xml")

    def reset(self, key: jax.Array, init_qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        noise = jax.random.uniform(key, (2, *init_qpos.shape), minval=-5e-3, maxval=5e-3)
        return init_qpos + noise[0], noise[1]

    def observe(self, physics: PhysicsState) -> jax.Array:
        return jnp.concatenate([physics.qpos[1:], jnp.clip(physics.qvel, -10.0, 10.0)])

    def reward(
        self, before: PhysicsState, action_t: jax.Array, after: PhysicsState, dt: float
    ) -> jax.Array:
        forward_velocity = (after.qpos[0] - before.qpos[0]) / dt
        healthy_bonus = 1.0 if self.terminates else _is_healthy(after).astype(jnp.float32)
        return forward_velocity + healthy_bonus - 1e-3 * jnp.sum(jnp.square(action_t))

    def terminated(self, physics: PhysicsState) -> jax.Array:
        return ~_is_healthy(physics)

    def qpos_of(self, model: mujoco.MjModel, obs: np.ndarray, dt: float) -> np.ndarray:
        del model
        return qpos_along_track(obs, dt)


def _is_healthy(physics: PhysicsState) -> jax.Array:
    height, angle = physics.qpos[1], physics.qpos[2]
    bounded = jnp.concatenate([physics.qpos[2:], physics.qvel])
    return (height > 0.7) & (jnp.abs(angle) < 0.2) & jnp.all(jnp.abs(bounded) < 100.0)
