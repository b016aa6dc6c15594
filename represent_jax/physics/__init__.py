"""Rigid-body physics as pure functions, with two engines behind one interface."""

from represent_jax.physics.engine import Engine, PhysicsState
from represent_jax.physics.factory import BACKENDS, make_engine, resolve_backend

__all__ = ["BACKENDS", "Engine", "PhysicsState", "make_engine", "resolve_backend"]
