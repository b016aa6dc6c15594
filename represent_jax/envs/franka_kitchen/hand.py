"""Franka Kitchen with fewer and tamer controls: the velocity of the hand instead of the joints'."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from represent_jax.envs.franka_kitchen import arm as kinematics
from represent_jax.envs.franka_kitchen import scene
from represent_jax.envs.franka_kitchen.arm import NUM_ARM, Arm
from represent_jax.envs.franka_kitchen.keyboard import (
    ANGULAR_SPEED,
    DAMPING,
    LINEAR_SPEED,
    MIDDLE_WEIGHT,
    OTHER_KEYS,
    SLOW,
    TO_MIDDLE,
    TURN_BACK,
    TURN_WEIGHT,
    Fingers,
)
from represent_jax.envs.franka_kitchen.task import ARM_START, TARGET_BOUNDS, FrankaKitchen
from represent_jax.envs.keyboard import Keyboard
from represent_jax.physics.engine import PhysicsState

# What a roll of 1 is, in rad; beyond it the wrist comes near its limit.
ROLL = 0.5 * np.pi
# Within this of its limit, in rad, a joint is held back the more the nearer it is.
_MARGIN = 0.1
_PASSES = 3

# What a key does, which entry of the action it sets, and its sign.
_MOVES = {
    "a": ("move left", 0, -1.0),
    "d": ("move right", 0, 1.0),
    "s": ("move back", 1, -1.0),
    "w": ("move forward", 1, 1.0),
    "e": ("move down", 2, -1.0),
    "q": ("move up", 2, 1.0),
    "z": ("roll left", 3, -1.0),
    "x": ("roll right", 3, 1.0),
}


class FrankaKitchenHand(FrankaKitchen):
    """The kitchen driven by its hand: an option of ours, for when joints are too hard to explore.

    Scene, observation, reward and start are those of `FrankaKitchen`. An action holds, in
    [-1, 1]: the hand's velocity along the axes of the kitchen (x to the right, y away from the
    robot, z up; 1 is 0.15 m/s), how far it should be rolled about its own axis (1 is a quarter
    turn) and the speed of the fingers (1 opens them). The rest of the hand's turn stays as it was
    at the start. Joint velocities follow from damped least squares, with what gravity would make
    the joints sink made up for; they go through the control law of FrankaKitchen-v1.
    """

    name = "franka_kitchen_hand"
    action_dim = 5

    def control(
        self, obs_t: jax.Array, action_t: jax.Array, center: jax.Array, scale: jax.Array
    ) -> jax.Array:
        arm, action_t = _arm(), jnp.clip(action_t, -1.0, 1.0)
        hand = kinematics.locate_hand(arm, obs_t[:NUM_ARM])
        turn = kinematics.turn_between(hand.rotation, _rolled(ROLL * action_t[3]) @ _start())
        turn = turn * TURN_BACK
        turn = turn * jnp.minimum(1.0, ANGULAR_SPEED / (jnp.linalg.norm(turn) + 1e-6))
        velocity = jnp.concatenate([LINEAR_SPEED * action_t[:3], turn])
        speeds = _joint_speeds(arm, hand.jacobian, obs_t[:NUM_ARM], velocity)
        # The law's unit is 2 rad/s, and a joint goes but a share of the way to its target.
        sag = hand.weight * arm.sag_per_torque
        joints = speeds / (2.0 * arm.share) + sag / (2.0 * kinematics.STEP)
        fingers = jnp.full(2, action_t[4])
        return super().control(obs_t, jnp.concatenate([joints, fingers]), center, scale)

    def keyboard(self, model: mujoco.MjModel) -> Keyboard:
        del model
        return HandKeyboard()


class HandKeyboard(Keyboard):
    """Keys for the entries of the action; roll and fingers stay as they were told."""

    def __init__(self):
        self.keys = {key: does for key, (does, _, _) in _MOVES.items()} | OTHER_KEYS
        self.reset()

    def reset(self) -> None:
        self._roll, self._fingers = 0.0, Fingers()

    def action(self, held: frozenset[str], physics: PhysicsState) -> np.ndarray:
        del physics
        action = np.zeros(5, np.float32)
        for key in held & _MOVES.keys():
            _, entry, sign = _MOVES[key]
            action[entry] += sign
        action *= SLOW if "shift" in held else 1.0
        self._roll += action[3] * ANGULAR_SPEED * kinematics.STEP / ROLL
        self._roll = float(np.clip(self._roll, -1.0, 1.0))
        action[3], action[4] = self._roll, self._fingers.action(held)
        return action


@functools.cache
def _arm() -> Arm:
    arm = kinematics.read_arm(scene.load_light())
    return arm._replace(
        low=np.maximum(arm.low, TARGET_BOUNDS[:NUM_ARM, 0]),
        high=np.minimum(arm.high, TARGET_BOUNDS[:NUM_ARM, 1]),
    )


@functools.cache
def _start() -> np.ndarray:
    """How the hand is turned where episodes start."""
    with jax.ensure_compile_time_eval():
        return np.asarray(kinematics.locate_hand(_arm(), jnp.asarray(ARM_START[:7])).rotation)


def _rolled(angle: jax.Array) -> jax.Array:
    """A turn about the axis away from the robot, `[3, 3]`."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def _joint_speeds(
    arm: Arm, jacobian: jax.Array, joints: jax.Array, velocity: jax.Array
) -> jax.Array:
    """Speeds of the arm's joints that give the hand a velocity, `[7]`."""
    weights = jnp.repeat(jnp.array([1.0, TURN_WEIGHT]), 3)
    middle = TO_MIDDLE * (0.5 * (arm.low + arm.high) - joints)
    free = jnp.ones(NUM_ARM)
    for _ in range(_PASSES):
        # Joints held back leave their part to the others.
        rows = weights[:, None] * jacobian * free
        normal = rows.T @ rows + (DAMPING**2 + MIDDLE_WEIGHT**2) * jnp.eye(NUM_ARM)
        right = rows.T @ (weights * velocity) + MIDDLE_WEIGHT**2 * free * middle
        speeds = free * jnp.linalg.solve(normal, right)
        room = jnp.where(speeds > 0.0, arm.high - joints, joints - arm.low)
        free = free * jnp.clip(room / _MARGIN, 0.0, 1.0)
    return speeds
