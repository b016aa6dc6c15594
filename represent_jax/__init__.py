"""Reward decomposition from suboptimal and heterogeneous demonstrations, end to end in JAX."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    # MJX prints a line for each optional package it does not find; Brax imports MJX.
    import mujoco.mjx  # noqa: F401
