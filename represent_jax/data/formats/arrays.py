"""Plain arrays: an npz file of arrays by name, or a CSV table.

npz: see `formats.flat` for the names and the two layouts. CSV: a row for each observation, with
columns `obs_0`, `obs_1`, ...; `action_0`, ... and `reward` are empty in the last row of an episode;
`episode` tells episodes apart, `terminated` and `strategy` are those of the whole episode. All but
`obs_*` may be missing. A first line `# {...}` holds the environment's name and the metadata.
"""

import csv
import itertools
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from represent_jax.data.atomic import replacing
from represent_jax.data.formats import flat
from represent_jax.data.formats.foreign import OWN_KEY, assemble, describe
from represent_jax.data.npz import load_arrays
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError, UsageError


def read(path: str | os.PathLike, env_name: str = "") -> Demonstrations:
    """Reads one npz file of arrays, or one CSV file.

    Args:
        path: the file; its ending tells which it is.
        env_name: name of the environment; that in our own exports if empty.

    Raises:
        UsageError: another ending, or nobody names the environment.
        RepresentError: no whole file, or what it holds are no demonstrations.
    """
    is_csv = _is_csv(path)
    if is_csv:
        described, rows = _read_table(path)
    else:
        arrays = load_arrays(path)
        described = str(arrays.pop(OWN_KEY)) if OWN_KEY in arrays else None
    try:
        trajectories, notes = _from_table(rows) if is_csv else flat.from_arrays(arrays)
    except RepresentError as error:
        raise RepresentError(f"{path}: {error}") from error
    return assemble(str(path), trajectories, env_name, described, notes, format="arrays")


def write(path: str | os.PathLike, demonstrations: Demonstrations) -> None:
    """Writes an npz file with a row a step, or a CSV file; whole or not at all.

    Raises:
        UsageError: the path ends neither in .npz nor in .csv.
        RepresentError: no space is left, or the file cannot be written.
    """
    is_csv = _is_csv(path)
    with replacing(path) as temporary:
        if is_csv:
            with open(temporary, "w", newline="", encoding="utf-8") as text:
                text.write(f"# {describe(demonstrations)}\n")
                csv.writer(text).writerows(_table(demonstrations))
        else:
            arrays = flat.to_rows(demonstrations)
            arrays[OWN_KEY] = np.array(describe(demonstrations))
            with open(temporary, "wb") as file:
                np.savez_compressed(file, **arrays)


def _is_csv(path: str | os.PathLike) -> bool:
    suffix = Path(path).suffix.lower()
    if suffix not in (".npz", ".csv"):
        raise UsageError(f"{path}: expected a name that ends in .npz or .csv")
    return suffix == ".csv"


def _table(demonstrations: Demonstrations):
    yield [
        *("episode", "strategy", "terminated"),
        *(f"obs_{i}" for i in range(demonstrations.obs_dim)),
        *(f"action_{i}" for i in range(demonstrations.action_dim or 0)),
        *(["reward"] if demonstrations.has_rewards else []),
    ]
    for episode, t in enumerate(demonstrations.trajectories):
        for step, obs_t in enumerate(t.obs):
            last = step == t.length
            row = [episode, t.strategy, int(t.terminated), *obs_t]
            if t.actions is not None:
                row += [""] * t.actions.shape[1] if last else list(t.actions[step])
            if t.rewards is not None:
                row.append("" if last else t.rewards[step])
            yield row


def _read_table(path: str | os.PathLike) -> tuple[str | None, list[dict[str, str]]]:
    """Returns the comment of the first line, if any, and every row by column."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise RepresentError(f"{path}: no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise RepresentError(f"{path}: not a text file: {error}") from error
    described = lines.pop(0)[1:].strip() if lines and lines[0].startswith("#") else None
    if described is not None and not described.startswith("{"):
        described = None
    reader = csv.DictReader(lines, skipinitialspace=True)
    rows = list(reader)
    if any(None in row or None in row.values() for row in rows):
        raise RepresentError(f"{path}: not every row has {len(reader.fieldnames)} cells")
    return described, rows


def _from_table(rows: Sequence[Mapping[str, str]]) -> tuple[list[Trajectory], list[str]]:
    columns = list(rows[0]) if rows else []
    obs_columns, action_columns = _numbered(columns, "obs_"), _numbered(columns, "action_")
    if not obs_columns:
        raise RepresentError("no columns obs_0, obs_1, ...")
    flags = {"episode", "strategy", "terminated", "reward"}
    unused = [c for c in columns if c not in {*flags, *obs_columns, *action_columns}]
    notes = [f"left out: {', '.join(unused)}"] if unused else []
    whole, cut = [], []
    for _, group in itertools.groupby(rows, key=lambda row: row.get("episode", "")):
        episode = list(group)
        step_columns = [*action_columns, *(["reward"] if "reward" in columns else [])]
        last_is_empty = not any(episode[-1][column].strip() for column in step_columns)
        steps = episode[:-1] if last_is_empty else episode
        piece = (
            _floats(episode, obs_columns),
            _floats(steps, action_columns) if action_columns else None,
            _floats(steps, ["reward"])[:, 0] if "reward" in columns else None,
            _flag(episode[-1].get("terminated", "0"), "terminated"),
            flat.one_strategy(_floats(episode, ["strategy"])) if "strategy" in columns else 0,
        )
        (whole if last_is_empty else cut).append(piece)
    if cut and whole:
        raise RepresentError(
            "some episodes end in a row without action and reward, others do not: the last row "
            "of each must hold the final observation alone"
        )
    if cut:
        trajectories, more = flat.drop_last_steps(cut)
        return trajectories, notes + more
    return [Trajectory(*piece) for piece in whole], notes


def _numbered(columns: Sequence[str], prefix: str) -> list[str]:
    """Returns the columns prefix0, prefix1, ... that there are, in order."""
    return [name for i in range(len(columns)) if (name := f"{prefix}{i}") in columns]


def _floats(rows: Sequence[Mapping[str, str]], columns: Sequence[str]) -> np.ndarray:
    values = [[_number(row[column], column) for column in columns] for row in rows]
    return np.array(values, np.float64).reshape(len(rows), len(columns))


def _flag(text: str, column: str) -> bool:
    value = _number(text, column)
    if value not in (0.0, 1.0):
        raise RepresentError(f"column {column}: expected 0 or 1, found {text!r}")
    return value == 1.0


def _number(text: str, column: str) -> float:
    try:
        return float({"true": "1", "false": "0"}.get(text.strip().lower(), text))
    except ValueError as error:
        raise RepresentError(f"column {column}: expected a number, found {text!r}") from error
