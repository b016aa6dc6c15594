"""The loop on the host around a compiled step: progress bar, logs, checkpoints, resuming."""

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np

from represent_jax.errors import RepresentError
from represent_jax.runs import processes
from represent_jax.runs.directory import RunDirectory
from represent_jax.runs.progress import progress

State = TypeVar("State")


def advance(
    run: RunDirectory | None,
    stage: str,
    state: State | Callable[[], State],
    step_fn: Callable[[State], tuple[State, Mapping[str, Any]]],
    num_chunks: int,
    *,
    units_per_chunk: int = 1,
    unit: str = "env steps",
    checkpoint_seconds: float = 30.0,
    describe: Callable[[Mapping[str, Any]], str] | None = None,
    example: State | None = None,
) -> State:
    """Calls `step_fn` until `num_chunks` chunks are done, those of an interrupted run counted in.

    Args:
        run: where progress, logs and checkpoints go; None keeps everything off the disk.
        stage: name of the stage.
        state: the state to begin with where nothing was saved, or, with `example`, a function that
            makes it, called only then; `step_fn` may donate it.
        step_fn: advances the state by one chunk and returns it with scalar or array metrics.
        num_chunks: number of chunks in all.
        units_per_chunk: number of units in a chunk; logs and checkpoints count units.
        unit: name of the units, in plural.
        checkpoint_seconds: least time between two checkpoints.
        describe: what to show of the metrics beside the progress; the first three scalars if None.
        example: shapes and types of the state where `state` is a function.

    Returns:
        The state after the last chunk, which is left to the caller to save.

    Raises:
        RepresentError: a metric with "loss" in its name is not finite (the last checkpoint stays),
            or a saved state does not fit `state`.
    """
    units, saved = 0, None
    if run is not None:
        saved = run.load_progress(stage, state if example is None else example)
        if saved is not None:
            units, state = saved
        run.rewind_log(stage, units)
    if saved is None and example is not None:
        state = state()
    total = num_chunks * units_per_chunk
    saved_at = time.monotonic()
    with progress(stage, total, unit, initial=units) as bar:
        while units < total:
            state, metrics = step_fn(state)
            metrics = jax.device_get(metrics)
            units += units_per_chunk
            _check_losses(stage, f"{units:,} {unit}", metrics)
            if run is not None:
                run.log(stage, units, metrics)
            bar.update(units_per_chunk, (describe or _first_scalars)(metrics))
            due = processes.agreed(time.monotonic() - saved_at >= checkpoint_seconds)
            if run is not None and due and units < total:
                run.save_progress(stage, units, state)
                saved_at = time.monotonic()
    return state


def _check_losses(stage: str, when: str, metrics: Mapping[str, Any]) -> None:
    for name, value in metrics.items():
        if "loss" in name and not np.isfinite(value).all():
            raise RepresentError(f"{stage}: {name} is {value} after {when}: the training diverged")


def _first_scalars(metrics: Mapping[str, Any]) -> str:
    scalars = [(name, float(value)) for name, value in metrics.items() if np.ndim(value) == 0]
    return ", ".join(f"{name} {value:.4g}" for name, value in scalars[:3])
