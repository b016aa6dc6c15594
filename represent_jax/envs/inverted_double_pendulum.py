"""InvertedDoublePendulum with the observation, reward and reset of Gym's version 2."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from represent_jax.envs.keyboard import DirectKeyboard
from represent_jax.envs.task import Task, load_gymnasium_model
from represent_jax.physics.engine import PhysicsState
from represent_jax.physics.mjx import MjxSolver


class InvertedDoublePendulum(Task):
    """Balance two poles on a cart: a bonus minus the tip's distance and the joints' speed.

    Terminates by default when the tip falls to 1 m: the returns that the paper reports for this
    domain are those of episodes that end early.
    """

    name = "inverted_double_pendulum"
    frame_skip = 5
    derived_fields = ("site_xpos", "qfrc_constraint")
    mjx_solver = MjxSolver(iterations=2, ls_iterations=4)

    def __init__(self, terminates: bool = True):
        self.terminates = terminates

    def load_model(self) -> mujoco.MjModel:
        return load_gymnasium_model("inverted_double_pendulum.xml")

    def reset(self, key: jax.Array, init_qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_qpos, key_qvel = jax.random.split(key)
        noise = jax.random.uniform(key_qpos, init_qpos.shape, minval=-0.1, maxval=0.1)
        return init_qpos + noise, 0.1 * jax.random.normal(key_qvel, init_qpos.shape)

    def observe(self, physics: PhysicsState) -> jax.Array:
        return jnp.concatenate(
            [
                physics.qpos[:1],
                jnp.sin(physics.qpos[1:]),
                jnp.cos(physics.qpos[1:]),
                jnp.clip(physics.qvel, -10.0, 10.0),
                jnp.clip(physics.derived["qfrc_constraint"], -10.0, 10.0),
            ]
        )

    def reward(
        self, before: PhysicsState, action_t: jax.Array, after: PhysicsState, dt: float
    ) -> jax.Array:
        del before, action_t, dt
        tip_x, tip_height = _tip(after)
        distance_penalty = 0.01 * tip_x**2 + (tip_height - 2.0) ** 2
        velocity_penalty = 1e-3 * after.qvel[1] ** 2 + 5e-3 * after.qvel[2] ** 2
        return 10.0 - distance_penalty - velocity_penalty

    def terminated(self, physics: PhysicsState) -> jax.Array:
        _, tip_height = _tip(physics)
        return tip_height <= 1.0

    def readings(self, physics: PhysicsState) -> dict[str, jax.Array]:
        _, tip_height = _tip(physics)
        return {"height of the tip, m": tip_height}

    def qpos_of(self, model: mujoco.MjModel, obs: np.ndarray, dt: float) -> np.ndarray:
        del model, dt
        return np.column_stack([obs[:, 0], np.arctan2(obs[:, 1:3], obs[:, 3:5])])

    def keyboard(self, model: mujoco.MjModel) -> DirectKeyboard:
        pushes = (
            ("arrowleft", "push the cart to the left", 0, -0.5),
            ("arrowright", "push the cart to the right", 0, 0.5),
        )
        return DirectKeyboard(model.nu, pushes)


def _tip(physics: PhysicsState) -> tuple[jax.Array, jax.Array]:
    tip = physics.derived["site_xpos"][0]
    return tip[0], tip[2]
