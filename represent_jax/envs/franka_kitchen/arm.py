"""Kinematics of the kitchen's arm as pure functions: where the hand is, and what carries it there.

All functions see one arm; batches are made by `jax.vmap`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

NUM_ARM = 7
_HAND_SITE, _FINGERS = "end_effector", ("panda0_leftfinger", "panda0_rightfinger")
_GRAVITY = 9.81
# Seconds of an environment step.
STEP = 0.08


class Arm(NamedTuple):
    """What the model says of the arm, links 1 to 7 from the root; all in SI units.

    Attributes:
      base_position, base_rotation: of what the first link stands on, `[3]` and `[3, 3]`.
      position, rotation: of each link in the one before, `[7, 3]` and `[7, 3, 3]`. Every joint
        turns about its link's third axis.
      mass: with the fingers counted to the last link, `[7]`.
      center: centre of that mass in the link, `[7, 3]`.
      hand_position, hand_rotation: of the hand in the last link, `[3]` and `[3, 3]`.
      low, high: joint limits, `[7]`.
      sag_per_torque: how far a joint sinks below its target for each N m of weight, `[7]`.
      share: of the way to its target that a damped joint goes in one step, `[7]`.
    """

    base_position: np.ndarray
    base_rotation: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    mass: np.ndarray
    center: np.ndarray
    hand_position: np.ndarray
    hand_rotation: np.ndarray
    low: np.ndarray
    high: np.ndarray
    sag_per_torque: np.ndarray
    share: np.ndarray


class HandState(NamedTuple):
    """Where the hand is and how the joints move it.

    Attributes:
      position: in the axes of the kitchen, `[3]`.
      rotation: `[3, 3]`.
      jacobian: of position, then of turning, by the joints, `[6, 7]`.
      weight: torques of gravity on the joints that their targets have to make up for, `[7]`.
    """

    position: jax.Array
    rotation: jax.Array
    jacobian: jax.Array
    weight: jax.Array


def read_arm(model: mujoco.MjModel) -> Arm:
    """Reads the arm out of the full scene or the light one."""
    links = [int(model.jnt_bodyid[i]) for i in range(NUM_ARM)]
    site = model.site(_HAND_SITE).id
    data, base = mujoco.MjData(model), model.body_parentid[links[0]]
    mujoco.mj_kinematics(model, data)
    mass, center = model.body_mass[links], model.body_ipos[links]
    for finger in _FINGERS:
        body = model.body(finger).id
        held = model.body_pos[body] + _rotation(model.body_quat[body]) @ model.body_ipos[body]
        total = mass[-1] + model.body_mass[body]
        center[-1] += (held - center[-1]) * model.body_mass[body] / total
        mass[-1] = total
    low, high = model.jnt_range[:NUM_ARM].T
    stiffness, damping = model.actuator_gainprm[:NUM_ARM, 0], model.dof_damping[:NUM_ARM]
    return Arm(
        base_position=data.xpos[base].copy(),
        base_rotation=data.xmat[base].reshape(3, 3).copy(),
        position=model.body_pos[links],
        rotation=np.stack([_rotation(quat) for quat in model.body_quat[links]]),
        mass=mass,
        center=center,
        hand_position=model.site_pos[site],
        hand_rotation=_rotation(model.site_quat[site]),
        low=low,
        high=high,
        sag_per_torque=1.0 / stiffness,
        share=1.0 - np.exp(-STEP * stiffness / damping),
    )


def locate_hand(arm: Arm, joints: jax.Array) -> HandState:
    """Forward kinematics and its derivatives.

    Args:
      arm: the arm.
      joints: angles, `[7]`.
    """
    position, rotation = jnp.asarray(arm.base_position), jnp.asarray(arm.base_rotation)
    axes, anchors, centers = [], [], []
    for i in range(NUM_ARM):
        position = position + rotation @ arm.position[i]
        rotation = rotation @ arm.rotation[i]
        axes.append(rotation[:, 2])
        anchors.append(position)
        cos, sin = jnp.cos(joints[i]), jnp.sin(joints[i])
        first, second, third = rotation.T
        rotation = jnp.stack([cos * first + sin * second, cos * second - sin * first, third], 1)
        centers.append(position + rotation @ arm.center[i])
    axes, anchors, centers = jnp.stack(axes), jnp.stack(anchors), jnp.stack(centers)
    hand = position + rotation @ arm.hand_position
    moving = jnp.cross(axes, hand - anchors)
    # A joint carries its own link and all behind it.
    lifting = jnp.cross(axes[:, None], centers[None] - anchors[:, None])[..., 2]
    weight = jnp.sum(jnp.triu(lifting) * arm.mass, axis=1) * _GRAVITY
    jacobian = jnp.concatenate([moving.T, axes.T])
    return HandState(hand, rotation @ arm.hand_rotation, jacobian, weight)


def turn_between(rotation: jax.Array, wanted: jax.Array) -> jax.Array:
    """Half-angle sine times two of the turn that leads from one rotation to another, `[3]`.

    In the axes of the kitchen; for small turns it is the rotation vector, and beyond it never
    points the wrong way.
    """
    between = wanted @ rotation.T
    axis = jnp.stack(
        [
            between[2, 1] - between[1, 2],
            between[0, 2] - between[2, 0],
            between[1, 0] - between[0, 1],
        ]
    )
    # |axis| is 2 sin; dividing by 2 cos of half the angle leaves 2 sin of half the angle.
    cos_half = jnp.sqrt(jnp.maximum(0.25 * (1.0 + jnp.trace(between)), 1e-4))
    return axis / (2.0 * cos_half)


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion / np.linalg.norm(quaternion))
    return matrix.reshape(3, 3)
