"""Franka Kitchen with the observation, control and start of FrankaKitchen-v1; kettle only."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from represent_jax.envs.franka_kitchen import scene
from represent_jax.envs.franka_kitchen.keyboard import KitchenKeyboard
from represent_jax.envs.task import Task
from represent_jax.physics.engine import PhysicsState
from represent_jax.physics.mjx import MjxSolver

NUM_JOINTS = 9
NUM_FIXTURES = 14

# Where FrankaKitchen-v1 starts: arm and fingers, fixtures, kettle (its quaternion as it is there).
ARM_START = np.array(
    [
        *(1.48388023e-01, -1.76848573e00, 1.84390296e00, -2.47685760e00, 2.60252026e-01),
        *(7.12533105e-01, 1.59515394e00, 4.79267505e-02, 3.71350919e-02),
    ]
)
FIXTURES_START = np.array(
    [
        *(-2.66279850e-04, -5.18043486e-05, 3.12877220e-05, -4.51199853e-05, -3.90842156e-06),
        *(-4.22629655e-05, 6.28065475e-05, 4.04984708e-05, 4.62730939e-04, -2.26906415e-04),
        *(-4.65501369e-04, -6.44129196e-03, -1.77048263e-03, 1.08009684e-03),
    ]
)
KETTLE_START = np.array(
    [
        *(-2.69397440e-01, 3.50383255e-01, 1.61944683e00),
        *(1.00618764e00, 4.06395120e-03, -6.62095997e-03, -2.68278933e-04),
    ]
)
KETTLE_GOAL = np.array([-0.23, 0.75, 1.62])

# The control law of FrankaKitchen-v1: an action of 1 is 2 rad/s (or m/s, for the fingers), and a
# target is that many seconds ahead, within these bounds.
SPEED, SECONDS_AHEAD = 2.0, 0.08
TARGET_BOUNDS = np.array(
    [
        *([-2.9, 2.9], [-1.8, 1.8], [-2.9, 2.9], [-3.1, 0.0], [-2.9, 2.9]),
        *([0.0, 3.8], [-2.9, 2.9], [0.0, 0.04], [0.0, 0.04]),
    ]
)

# Half-widths of its noise: 1 % of the robot's amplitudes and 0.05 % of those it lists for what else
# moves. Its amplitudes of positions are those of one entry earlier, as in its source.
_AMPLITUDES = (0.1, *[0.005] * 2, *[5e-4] * 6, *[0.005] * 3, *[0.1] * 3, *[0.005] * 3, *[0.1] * 3)
_SPEED_AMPLITUDES = (*[0.005] * 11, *[0.1] * 3, *[0.005] * 3, *[0.1] * 3)
OBSERVATION_NOISE = np.array([*[1e-3] * 18, *(5e-4 * np.array([*_AMPLITUDES, *_SPEED_AMPLITUDES]))])

# The kettle's place in an observation: where it is and how it is turned.
KETTLE_ENTRIES = range(2 * NUM_JOINTS + NUM_FIXTURES, 2 * NUM_JOINTS + NUM_FIXTURES + 7)
_KETTLE = slice(KETTLE_ENTRIES.start, KETTLE_ENTRIES.stop)
_REACHED, _UPRIGHT = 0.05, np.cos(np.deg2rad(15.0))


class FrankaKitchen(Task):
    """Move the kettle to the top left burner: minus its distance from there, at every step.

    Actions are velocities of the nine joints. Engines that the whole kitchen does not suit get a
    light scene, in which the fixtures are missing and their part of the observation is constant.
    """

    name = "franka_kitchen"
    frame_skip = 40
    horizon = 500
    mjx_solver = MjxSolver(iterations=4, ls_iterations=8)

    def __init__(self, noisy: bool = False):
        """Makes the task.

        Args:
          noisy: whether observations, and with them the control, have FrankaKitchen-v1's noise.
        """
        self.observation_noise = OBSERVATION_NOISE if noisy else None

    def load_model(self) -> mujoco.MjModel:
        return scene.load_full()

    def load_light_model(self) -> mujoco.MjModel:
        return scene.load_light()

    def reset(self, key: jax.Array, init_qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        del key
        whole = init_qpos.size == NUM_JOINTS + NUM_FIXTURES + 7
        parts = (ARM_START, FIXTURES_START, KETTLE_START) if whole else (ARM_START, KETTLE_START)
        return jnp.concatenate(parts, dtype=jnp.float32), jnp.zeros(init_qpos.size - 1)

    def control(
        self, obs_t: jax.Array, action_t: jax.Array, center: jax.Array, scale: jax.Array
    ) -> jax.Array:
        del center, scale
        velocity = SPEED * jnp.clip(action_t, -1.0, 1.0)
        return jnp.clip(obs_t[:NUM_JOINTS] + SECONDS_AHEAD * velocity, *TARGET_BOUNDS.T)

    def observe(self, physics: PhysicsState) -> jax.Array:
        qpos, qvel = physics.qpos, physics.qvel
        whole = qpos.size == NUM_JOINTS + NUM_FIXTURES + 7
        fixtures = () if whole else (jnp.asarray(FIXTURES_START, jnp.float32),)
        still = () if whole else (jnp.zeros(NUM_FIXTURES),)
        return jnp.concatenate(
            [
                *(qpos[:NUM_JOINTS], qvel[:NUM_JOINTS]),
                *(*fixtures, qpos[NUM_JOINTS:]),
                *(*still, qvel[NUM_JOINTS:]),
            ]
        )

    def reward(
        self, before: PhysicsState, action_t: jax.Array, after: PhysicsState, dt: float
    ) -> jax.Array:
        del before, action_t, dt
        return -jnp.linalg.norm(after.qpos[-7:-4] - jnp.asarray(KETTLE_GOAL, jnp.float32))

    def qpos_of(self, model: mujoco.MjModel, obs: np.ndarray, dt: float) -> np.ndarray:
        del dt
        others = obs[:, 2 * NUM_JOINTS : _KETTLE.stop]
        if model.nq < NUM_JOINTS + others.shape[1]:
            others = others[:, NUM_FIXTURES:]
        return np.column_stack([obs[:, :NUM_JOINTS], others])

    def outcomes(self, obs: jax.Array) -> dict[str, jax.Array]:
        """Final distance of the kettle in m, and whether it stands within 5 cm of its goal."""
        kettle = obs[..., -1, _KETTLE]
        distance = jnp.linalg.norm(kettle[..., :3] - KETTLE_GOAL, axis=-1)
        x, y = kettle[..., 4], kettle[..., 5]
        upright = 1.0 - 2.0 * (x**2 + y**2) / jnp.sum(kettle[..., 3:] ** 2, axis=-1) > _UPRIGHT
        success = (distance < _REACHED) & upright
        return {"kettle_distance": distance, "success": success.astype(jnp.float32)}

    def readings(self, physics: PhysicsState) -> dict[str, jax.Array]:
        goal = jnp.asarray(KETTLE_GOAL, jnp.float32)
        return {"kettle to its goal, m": jnp.linalg.norm(physics.qpos[-7:-4] - goal)}

    def keyboard(self, model: mujoco.MjModel) -> KitchenKeyboard:
        return KitchenKeyboard(model)
