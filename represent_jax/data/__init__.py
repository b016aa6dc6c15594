"""Trajectories and the files that hold them."""

from represent_jax.data.npz import load_demonstrations, save_demonstrations
from represent_jax.data.trajectories import (
    Demonstrations,
    Trajectory,
    TrajectoryBatch,
    pad,
    returns,
    unpad,
    without_pauses,
)

__all__ = [
    "Demonstrations",
    "Trajectory",
    "TrajectoryBatch",
    "load_demonstrations",
    "pad",
    "returns",
    "save_demonstrations",
    "unpad",
    "without_pauses",
]
