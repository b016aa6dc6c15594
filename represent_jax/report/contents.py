"""What a run's folder holds, as pages take it."""

import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from represent_jax.errors import RepresentError
from represent_jax.report import tables
from represent_jax.runs.directory import RunDirectory, load_config_json


class Contents(NamedTuple):
    """What is known of a run so far; parts whose stages are not done are empty.

    Attributes:
        run: the run's folder.
        config: the settings, as JSON holds them.
        results: what results.json holds.
        curves: the noise-performance curve, by strategy.
        points: true and learned returns [n], by target and group of trajectories.
        learning: "env_steps", "true_return" and "learned_return" [num_evals], by target.
        losses: the regression's loss as it was logged, mean over rewards [num_logs].
    """

    run: RunDirectory
    config: dict[str, Any]
    results: dict[str, Any]
    curves: dict[str, dict[str, Any]]
    points: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]
    learning: dict[str, dict[str, np.ndarray]]
    losses: np.ndarray


def load(run_path: str | os.PathLike) -> Contents:
    """Reads a run's folder.

    Raises:
        RepresentError: the folder holds no run, or its results cannot be read.
    """
    run = RunDirectory(run_path)
    config = load_config_json(run.path)
    results = run.read_results() if (run.path / "results.json").exists() else {}
    if not isinstance(results, dict):
        raise RepresentError(f"{run.path / 'results.json'}: not the results of a run")
    return Contents(
        run=run,
        config=config,
        results=results,
        curves=dict(zip(tables.groups(results), results.get("curve") or (), strict=False)),
        points=_scatter_points(_arrays(run, "scatter")),
        learning=_learning_curves(_arrays(run, "learning_curves")),
        losses=_losses(run),
    )


def _losses(run: RunDirectory) -> np.ndarray:
    lines = run.read_log("regression")
    # A line may be from before a kill, and its step logged again.
    by_step = {line["step"]: np.mean(line["ssrr_loss"]) for line in lines if "ssrr_loss" in line}
    return np.asarray([by_step[step] for step in sorted(by_step)], np.float64)


def _arrays(run: RunDirectory, name: str) -> dict[str, np.ndarray]:
    if not (run.path / "arrays" / f"{name}.npz").exists():
        return {}
    return run.load_arrays(name)


def _scatter_points(
    arrays: Mapping[str, np.ndarray],
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    points: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for key, true in arrays.items():
        target, group, which = _split(key, 3)
        learned = arrays.get(f"{target}/{group}/learned")
        if which == "true" and learned is not None and len(true):
            points.setdefault(target, {})[group] = (true, learned)
    return _in_order(points)


def _learning_curves(arrays: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    curves: dict[str, dict[str, np.ndarray]] = {}
    for key, values in arrays.items():
        target, name = _split(key, 2)
        curves.setdefault(target, {})[name] = values
    needed = {"env_steps", "true_return", "learned_return"}
    return _in_order({t: c for t, c in curves.items() if needed <= c.keys()})


def _split(key: str, num: int) -> tuple[str, ...]:
    parts = key.split("/")
    if len(parts) != num:
        raise RepresentError(f"array {key!r}: expected a name of {num} parts, found {len(parts)}")
    return tuple(parts)


def _in_order(by_target: dict[str, Any]) -> dict[str, Any]:
    """Returns the task first, then the strategies by number."""
    order = sorted(by_target, key=lambda t: (t != "task", len(t), t))
    return {target: by_target[target] for target in order}
