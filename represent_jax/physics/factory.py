"""Chooses an engine by name or by platform."""

import jax
import mujoco

from represent_jax.errors import unknown
from represent_jax.physics.engine import Engine
from represent_jax.physics.mjx import MjxEngine, MjxSolver
from represent_jax.physics.mujoco import MujocoEngine

BACKENDS = ("auto", "mujoco", "mjx")


def resolve_backend(backend: str) -> str:
    """Returns "mujoco" or "mjx"; "auto" is C MuJoCo on CPU hosts and MJX on accelerators.

    Raises:
      UsageError: no backend of that name.
    """
    if backend not in BACKENDS:
        raise unknown("backend", backend, BACKENDS)
    if backend == "auto":
        return "mujoco" if jax.default_backend() == "cpu" else "mjx"
    return backend


def make_engine(
    backend: str,
    model: mujoco.MjModel,
    frame_skip: int,
    derived_fields: tuple[str, ...] = (),
    mjx_solver: MjxSolver | None = None,
) -> Engine:
    """Makes the engine of that name for a scene."""
    if resolve_backend(backend) == "mujoco":
        return MujocoEngine(model, frame_skip, derived_fields)
    return MjxEngine(model, frame_skip, derived_fields, mjx_solver)
