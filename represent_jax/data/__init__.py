"""Trajectories and the files that hold them."""

from represent_jax.data.npz import load_demonstrations, save_demonstrations
from represent_jax.data.trajectories import (
    Demonstrations,
    Trajectory,
    unpad,
)

__all__ = [
    "Demonstrations",
    "Trajectory",
    "load_demonstrations",
    "save_demonstrations",
    "unpad",
]
