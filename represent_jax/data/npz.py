"""Our own format: demonstrations as one compressed npz file without pickles.

The N trajectories are laid end to end: `obs` [sum(T_i + 1), obs_dim], `actions` [sum(T_i),
action_dim] and `rewards` [sum(T_i)], cut by `episode_lengths` [N]; `terminated` and `strategy` are
[N]; `env_name` and `metadata` (JSON) are strings; `format_version` is an int. In version 2
`actions` and `rewards` may be missing; it is written only where they are.
"""

import json
import os
import zipfile
import zlib
from collections.abc import Collection

import numpy as np

from represent_jax.data.atomic import replacing
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError

FORMAT_VERSION = 2

_OPTIONAL = ("actions", "rewards")

_KEYS = (
    "obs",
    "actions",
    "rewards",
    "terminated",
    "strategy",
    "episode_lengths",
    "env_name",
    "metadata",
)


def save_demonstrations(path: str | os.PathLike, demonstrations: Demonstrations) -> None:
    """Writes the demonstrations to a file, which is there whole or not at all.

    Raises:
        RepresentError: no space is left, or the file cannot be written.
    """
    trajectories = demonstrations.trajectories
    parts = {"obs": [t.obs for t in trajectories]}
    if demonstrations.has_actions:
        parts["actions"] = [t.actions for t in trajectories]
    if demonstrations.has_rewards:
        parts["rewards"] = [t.rewards for t in trajectories]
    version = 1 if len(parts) == 3 else FORMAT_VERSION
    arrays = {
        **{name: np.concatenate(rows) for name, rows in parts.items()},
        "terminated": np.array([t.terminated for t in trajectories], bool),
        "strategy": np.array([t.strategy for t in trajectories], np.int32),
        "episode_lengths": np.array([t.length for t in trajectories], np.int32),
        "env_name": np.array(demonstrations.env_name),
        "metadata": np.array(json.dumps(dict(demonstrations.metadata), sort_keys=True)),
        "format_version": np.array(version, np.int32),
    }
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)


def load_demonstrations(path: str | os.PathLike) -> Demonstrations:
    """Reads demonstrations from a file that `save_demonstrations` wrote.

    Raises:
        RepresentError: the file is missing, a directory, truncated, of another kind or of an
            unknown format version, or what it holds are no valid demonstrations.
    """
    arrays = load_arrays(path)
    if "format_version" not in arrays:
        raise RepresentError(f"{path}: not a file of demonstrations, it has no 'format_version'")
    version = arrays["format_version"]
    if version.shape or version not in range(1, FORMAT_VERSION + 1):
        raise RepresentError(f"{path}: format version {version}, known is {FORMAT_VERSION}")
    optional = _OPTIONAL if version > 1 else ()
    missing = [key for key in _KEYS if key not in arrays and key not in optional]
    if missing:
        raise RepresentError(f"{path}: not whole, it has no {', '.join(map(repr, missing))}")
    try:
        return _demonstrations(arrays)
    except (RepresentError, ValueError, TypeError) as error:
        raise RepresentError(f"{path}: {error}") from error


def load_arrays(path: str | os.PathLike, leave_out: Collection[str] = ()) -> dict[str, np.ndarray]:
    """Reads the arrays of an npz file, pickles refused.

    Args:
        path: the file.
        leave_out: names of arrays not to read.

    Raises:
        RepresentError: the file is missing, a directory, or not a whole npz file.
    """
    try:
        with open(path, "rb") as file:
            if not zipfile.is_zipfile(file):
                raise ValueError("it is truncated or of another kind")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return {key: arrays[key] for key in arrays.files if key not in leave_out}
    except FileNotFoundError as error:
        raise RepresentError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise RepresentError(f"{path}: a directory, expected an npz file") from error
    except (OSError, EOFError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise RepresentError(f"{path}: not a whole npz file: {error}") from error


def _demonstrations(arrays: dict[str, np.ndarray]) -> Demonstrations:
    lengths = arrays["episode_lengths"]
    num = len(lengths)
    rows = {
        "obs": int(lengths.sum()) + num,
        "actions": int(lengths.sum()),
        "rewards": int(lengths.sum()),
        "terminated": num,
        "strategy": num,
    }
    for key, expected in rows.items():
        if key in arrays and len(arrays[key]) != expected:
            raise RepresentError(
                f"{key!r} has {len(arrays[key])} rows, 'episode_lengths' asks for {expected}"
            )
    cuts = np.cumsum(lengths)[:-1]

    def split(key):
        return np.split(arrays[key], cuts) if key in arrays else [None] * num

    pieces = zip(
        np.split(arrays["obs"], cuts + np.arange(1, num)),
        split("actions"),
        split("rewards"),
        arrays["terminated"],
        arrays["strategy"],
        strict=True,
    )
    return Demonstrations(
        env_name=str(arrays["env_name"]),
        trajectories=tuple(Trajectory(*piece) for piece in pieces),
        metadata=json.loads(str(arrays["metadata"])),
    )
