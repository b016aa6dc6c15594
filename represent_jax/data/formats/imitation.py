"""Trajectories of the `imitation` library (https://imitation.readthedocs.io).

A folder that its `serialize.save` wrote: a HuggingFace dataset with a row a trajectory, `obs` (T+1
rows), `acts`, `infos` (a JSON string a step), `terminal` and, where known, `rews`. Its older npz
files are read too. The library itself is not needed, HuggingFace's `datasets` is.

The library's rollouts set `terminal` at a time limit too; the last step's info says which it was,
under the key of Stable-Baselines3. Files without infos leave that open: their word is taken.
"""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from represent_jax.data.formats.foreign import assemble, describe, library, rounded
from represent_jax.data.npz import load_arrays
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError, UsageError

# Keys of a step's info: the strategy, in our own exports; and whether a time limit ended it.
_STRATEGY = "strategy"
_TIME_LIMIT = "TimeLimit.truncated"
_ASSUMED = "terminal episodes may have ended at a time limit: no info says so"


def read(path: str | os.PathLike, env_name: str = "") -> Demonstrations:
    """Reads one folder, or one npz file of the library's older versions.

    `infos` are not kept, but for what they say of time limits and, in our exports, of strategies.

    Args:
        path: the folder or file.
        env_name: name of the environment; that in our own exports if empty.

    Raises:
        UsageError: `datasets` is not installed, or nobody names the environment.
        RepresentError: neither a folder nor a file of trajectories.
    """
    if not Path(path).exists():
        raise RepresentError(f"{path}: no such file or folder")
    if Path(path).is_dir():
        described, rows = _read_folder(path)
    else:
        described, rows = None, list(_read_npz(path))
    notes = []
    if described is None:
        if not Path(path).is_dir() or any(row["infos"] for row in rows):
            notes.append("left out: infos")
        open_ends = (row["terminal"] and _TIME_LIMIT not in row["infos"] for row in rows)
        notes += [_ASSUMED] if any(open_ends) else []
    trajectories = []
    for i, row in enumerate(rows):
        try:
            trajectories.append(_trajectory(row))
        except (RepresentError, ValueError, TypeError) as error:
            raise RepresentError(f"{path}: trajectory {i}: {error}") from error
        notes += rounded(obs=row["obs"], acts=row["acts"], rews=row["rews"])
    return assemble(
        str(path), trajectories, env_name, described, list(dict.fromkeys(notes)), format="imitation"
    )


def write(path: str | os.PathLike, demonstrations: Demonstrations) -> None:
    """Writes a folder that `imitation.data.serialize.load` reads.

    Raises:
        UsageError: `datasets` is not installed, the folder is there already, or actions are
            missing, for which the format has no form.
        RepresentError: the folder cannot be written.
    """
    datasets = library("datasets", "imitation")
    if Path(path).exists():
        raise UsageError(f"{path}: already there, choose another folder")
    if not demonstrations.has_actions:
        raise UsageError(f"{path}: imitation's trajectories need actions, these have none")
    trajectories = demonstrations.trajectories
    columns: dict[str, list[Any]] = {
        "obs": [t.obs for t in trajectories],
        "acts": [t.actions for t in trajectories],
        "infos": [[json.dumps({_STRATEGY: t.strategy})] * t.length for t in trajectories],
        "terminal": [t.terminated for t in trajectories],
    }
    if demonstrations.has_rewards:
        columns["rews"] = [t.rewards for t in trajectories]
    info = datasets.DatasetInfo(description=describe(demonstrations))
    with _quiet(datasets):
        try:
            datasets.Dataset.from_dict(columns, info=info).save_to_disk(str(path))
        except OSError as error:
            raise RepresentError(f"{path}: cannot be written ({error})") from error


def _read_folder(path: str | os.PathLike) -> tuple[str | None, list[dict[str, Any]]]:
    """Returns our description, if any, and the rows, with the infos of each row's last step."""
    datasets = library("datasets", "imitation")
    try:
        dataset = datasets.load_from_disk(str(path))
    except (OSError, ValueError, KeyError) as error:
        raise RepresentError(f"{path}: not a dataset of trajectories: {error}") from error
    missing = {"obs", "acts", "infos", "terminal"} - set(getattr(dataset, "features", None) or ())
    if not isinstance(dataset, datasets.Dataset) or missing:
        raise RepresentError(f"{path}: not a dataset of trajectories of the imitation library")
    text = dataset.info.description or ""
    described = text if text.startswith('{"env_name"') else None
    return described, [_row(row) for row in dataset]


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    try:
        infos = json.loads(row["infos"][-1]) if row["infos"] else {}
    except ValueError:
        infos = {}
    return {
        "obs": np.asarray(row["obs"]),
        "acts": np.asarray(row["acts"]),
        "rews": None if row.get("rews") is None else np.asarray(row["rews"]),
        "terminal": row["terminal"],
        "infos": infos if isinstance(infos, dict) else {},
    }


def _read_npz(path: str | os.PathLike) -> Iterator[dict[str, Any]]:
    arrays = load_arrays(path, leave_out=("infos",))
    missing = {"obs", "acts", "terminal", "indices"} - arrays.keys()
    if missing:
        raise RepresentError(f"{path}: not a file of trajectories, it has no {sorted(missing)}")
    cuts, num = arrays["indices"], len(arrays["terminal"])
    rewards = np.split(arrays["rews"], cuts) if "rews" in arrays else [None] * num
    pieces = zip(
        np.split(arrays["obs"], cuts + np.arange(1, num)),
        np.split(arrays["acts"], cuts),
        rewards,
        arrays["terminal"],
        strict=True,
    )
    for obs, acts, rews, terminal in pieces:
        yield {"obs": obs, "acts": acts, "rews": rews, "terminal": terminal, "infos": {}}


def _trajectory(row: Mapping[str, Any]) -> Trajectory:
    infos = row["infos"]
    terminated = bool(row["terminal"]) and not infos.get(_TIME_LIMIT, False)
    return Trajectory(row["obs"], row["acts"], row["rews"], terminated, infos.get(_STRATEGY, 0))


@contextlib.contextmanager
def _quiet(datasets) -> Iterator[None]:
    """Without progress bars."""
    hidden = datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    try:
        yield
    finally:
        if not hidden:
            datasets.enable_progress_bars()
