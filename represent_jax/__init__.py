"""Reward decomposition from suboptimal and heterogeneous demonstrations, end to end in JAX.

The names below are loaded when first used, so that importing the package is quick and starts no
device.
"""

import contextlib
import importlib
import io
from typing import Any

_HOME = {
    "make_env": "represent_jax.envs",
    "load_demonstrations": "represent_jax.data.catalogue",
    "make_config": "represent_jax.methods.presets",
    "learn": "represent_jax.api",
    "load_config": "represent_jax.api",
    "load_reward": "represent_jax.api",
    "load_policy": "represent_jax.api",
    "infer_strategies": "represent_jax.api",
}

# Learned rewards in the interfaces of other libraries.
_MODULES = ("brax", "gymnasium")

__all__ = [
    "infer_strategies",
    "learn",
    "load_config",
    "load_demonstrations",
    "load_policy",
    "load_reward",
    "make_config",
    "make_env",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME, *_MODULES})


with contextlib.redirect_stdout(io.StringIO()):
    # MJX prints a line for each optional package it does not find; Brax imports MJX.
    import mujoco.mjx  # noqa: F401
