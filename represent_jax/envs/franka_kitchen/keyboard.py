"""Keys that move the hand of the arm; joint velocities follow from damped least squares."""

import mujoco
import numpy as np

from represent_jax.envs.franka_kitchen.arm import NUM_ARM, STEP
from represent_jax.envs.keyboard import Keyboard
from represent_jax.physics.engine import PhysicsState

# Metres and radians per second of a held key, and by how much shift slows it down.
LINEAR_SPEED, ANGULAR_SPEED, SLOW = 0.15, 0.6, 0.25

# What a key does, which entry of the hand's velocity (linear, then angular) it sets, and its sign.
# Axes are those of the kitchen: x to the right, y away from the robot, z up.
_MOVES = {
    "w": ("move forward", 1, 1.0),
    "s": ("move back", 1, -1.0),
    "a": ("move left", 0, -1.0),
    "d": ("move right", 0, 1.0),
    "q": ("move up", 2, 1.0),
    "e": ("move down", 2, -1.0),
    "arrowup": ("pitch up", 3, 1.0),
    "arrowdown": ("pitch down", 3, -1.0),
    "arrowleft": ("turn left", 5, 1.0),
    "arrowright": ("turn right", 5, -1.0),
    "z": ("roll left", 4, -1.0),
    "x": ("roll right", 4, 1.0),
}
# Of both ways to drive the hand.
OTHER_KEYS = {" ": "close or open the fingers", "shift": "slowly"}
_NUM_JOINTS = 9
# What least squares give up first: turning as wanted counts this much of moving as wanted, in m.
TURN_WEIGHT, DAMPING = 0.15, 0.02
# Rate at which the hand returns to how it was last turned, per second, and a joint to its middle.
TURN_BACK, TO_MIDDLE, MIDDLE_WEIGHT = 2.0, 0.3, 0.01
# A joint this near to its limit, in rad, moves no nearer.
_MARGIN = 0.02


class Fingers:
    """Open, until space closes them, and so on with every new press."""

    def __init__(self):
        self._closing, self._space_was_held = False, False

    def action(self, held: frozenset[str]) -> float:
        """Their entry of the action: 1 opens them, -1 closes."""
        if " " in held and not self._space_was_held:
            self._closing = not self._closing
        self._space_was_held = " " in held
        return -1.0 if self._closing else 1.0


class KitchenKeyboard(Keyboard):
    """Moves and turns the hand in the axes of the kitchen, opens and closes the fingers.

    Space closes the fingers, or opens them again; they keep what they were told. Joints are
    carried against gravity, which FrankaKitchen's own control lets sink them.
    """

    def __init__(self, model: mujoco.MjModel):
        """Takes the scene's model, full or light."""
        self.keys = {key: does for key, (does, _, _) in _MOVES.items()} | OTHER_KEYS
        self._model, self._data = model, mujoco.MjData(model)
        self._site = model.site("end_effector").id
        self._low, self._high = model.jnt_range[:NUM_ARM].T
        self._stiffness = model.actuator_gainprm[:NUM_ARM, 0]
        # Share of the way to its target that a damped joint goes within one step.
        self._share = 1.0 - np.exp(-STEP * self._stiffness / model.dof_damping[:NUM_ARM])
        self.reset()

    def reset(self) -> None:
        self._fingers = Fingers()
        self._turned: np.ndarray | None = None

    def action(self, held: frozenset[str], physics: PhysicsState) -> np.ndarray:
        data = self._data
        data.qpos[:], data.qvel[:] = physics.qpos, 0.0
        mujoco.mj_forward(self._model, data)
        speeds = self._joint_speeds(self._hand_velocity(held))
        sag = data.qfrc_bias[:NUM_ARM] / self._stiffness
        action = np.full(_NUM_JOINTS, self._fingers.action(held), np.float32)
        action[:NUM_ARM] = np.clip(speeds / (2.0 * self._share) + sag / (2.0 * STEP), -1.0, 1.0)
        return action

    def _hand_velocity(self, held: frozenset[str]) -> np.ndarray:
        """Linear and angular velocity in the axes of the kitchen, `[6]`."""
        velocity = np.zeros(6)
        for key in held & _MOVES.keys():
            _, entry, sign = _MOVES[key]
            velocity[entry] += sign * (LINEAR_SPEED if entry < 3 else ANGULAR_SPEED)
        velocity *= SLOW if "shift" in held else 1.0
        now = np.zeros(4)
        mujoco.mju_mat2Quat(now, self._data.site_xmat[self._site])
        if self._turned is None:
            self._turned = now.copy()
        # The orientation the keys asked for so far; the hand is led back to it.
        mujoco.mju_quatIntegrate(self._turned, _in_frame(self._turned, velocity[3:]), STEP)
        back = np.zeros(3)
        mujoco.mju_subQuat(back, self._turned, now)
        world = np.zeros(3)
        mujoco.mju_rotVecQuat(world, back, now)
        velocity[3:] += TURN_BACK * world
        return velocity

    def _joint_speeds(self, velocity: np.ndarray) -> np.ndarray:
        """Speeds of the arm's joints that give the hand a velocity, `[7]`."""
        data = self._data
        jacobian = np.zeros((6, self._model.nv))
        mujoco.mj_jacSite(self._model, data, jacobian[:3], jacobian[3:], self._site)
        qpos = data.qpos[:NUM_ARM]
        weights = np.repeat([1.0, TURN_WEIGHT], 3)
        rows = np.concatenate(
            [
                weights[:, None] * jacobian[:, :NUM_ARM],
                DAMPING * np.eye(NUM_ARM),
                MIDDLE_WEIGHT * np.eye(NUM_ARM),
            ]
        )
        middle = TO_MIDDLE * (0.5 * (self._low + self._high) - qpos)
        wanted = np.concatenate([weights * velocity, np.zeros(NUM_ARM), MIDDLE_WEIGHT * middle])
        free, speeds = np.ones(NUM_ARM, bool), np.zeros(NUM_ARM)
        for _ in range(NUM_ARM):
            speeds[:] = 0.0
            speeds[free] = np.linalg.lstsq(rows[:, free], wanted)[0]
            stuck = (speeds > 0.0) & (qpos > self._high - _MARGIN)
            stuck |= (speeds < 0.0) & (qpos < self._low + _MARGIN)
            if not np.any(stuck):
                break
            free &= ~stuck
        return speeds


def _in_frame(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A vector of the world in the frame that a quaternion turns to."""
    inverse, result = np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(inverse, quaternion)
    mujoco.mju_rotVecQuat(result, vector, inverse)
    return result
