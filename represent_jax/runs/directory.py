"""One folder per run: its configuration, logs, checkpoints, results and plot data.

config.json          format version and configuration
metrics.jsonl        one line of metrics per logged step
tensorboard/<stage>  the same for TensorBoard
checkpoints/<stage>  `output` once the stage is done, `progress/<step>` until then
arrays/<name>.npz    plot data
findings/<stage>.json what a stage found
results.json         what the run found
figures/ videos/ report.html

Of several processes that run one program, the first writes and all read: see `runs.processes`.
"""

import fcntl
import json
import math
import os
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

import jax
import numpy as np
from absl import logging

from represent_jax import config as configs
from represent_jax.data.atomic import disk_errors, replacing
from represent_jax.data.npz import load_arrays
from represent_jax.errors import RepresentError, UsageError
from represent_jax.runs import checkpoint, processes
from represent_jax.runs.tensorboard import ScalarLog
from represent_jax.runs.tracking import Tracker

FORMAT_VERSION = 1

_PROGRESS_KEPT = 2

Tree = TypeVar("Tree")


class RunDirectory:
    """The folder of one run; a context manager that keeps others out and closes its logs.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: str | os.PathLike, tracker: Tracker | None = None):
        """Refers to a folder, and touches nothing; `open_run` makes or checks one."""
        self.path = Path(path)
        self._tracker = tracker
        self._scalar_logs: dict[str, ScalarLog] = {}
        self._purge_steps: dict[str, int] = {}
        self._lock: IO | None = None

    def __enter__(self) -> "RunDirectory":
        """Takes the folder for this process.

        Raises:
            UsageError: another one works in it.
        """
        if processes.agreed(not self._take()):
            raise UsageError(f"{self.path}: another process works in this folder")
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _take(self) -> bool:
        """Locks the folder until `close`, or until the process ends however it ends."""
        if not processes.is_first():
            return True
        with disk_errors(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = open(self.path / ".lock", "w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            return False
        except OSError:
            # A file system without locks: as good as none, which nobody else can tell either.
            logging.debug("%s: cannot be locked", self.path)
        return True

    def close(self) -> None:
        """Closes the logs, and leaves the folder to others."""
        if self._lock is not None:
            self._lock.close()
        for stage in list(self._scalar_logs):
            self._close_scalar_log(stage)
        if self._tracker is not None:
            self._tracker.close()

    @property
    def figures(self) -> Path:
        """Folder of the figures."""
        return self.path / "figures"

    @property
    def videos(self) -> Path:
        """Folder of the videos."""
        return self.path / "videos"

    def is_done(self, stage: str) -> bool:
        """Returns whether the stage's output is saved."""
        return processes.agreed(checkpoint.is_whole(self._checkpoints(stage) / "output"))

    def save_output(self, stage: str, output: Any) -> None:
        """Saves the stage's final output, after which it is done and its progress is dropped."""
        output = processes.whole(output)
        if processes.is_first():
            checkpoint.save(self._checkpoints(stage) / "output", output)
            shutil.rmtree(self._checkpoints(stage) / "progress", ignore_errors=True)
            self._close_scalar_log(stage)
        processes.wait()

    def load_output(self, stage: str, example: Tree) -> Tree:
        """Returns the stage's output, bit for bit.

        Args:
            stage: name of the stage.
            example: a pytree of the same structure, shapes and types; `jax.ShapeDtypeStruct` do.

        Raises:
            RepresentError: the stage is not done, or its output differs from the example.
        """
        if not self.is_done(stage):
            raise RepresentError(f"{self.path}: stage {stage!r} is not done, it has no output")
        return checkpoint.load(self._checkpoints(stage) / "output", example)

    def save_progress(self, stage: str, step: int, state: Any) -> None:
        """Saves the state of a stage under way; the state saved before stays, all others go."""
        state = processes.whole(state)
        if not processes.is_first():
            return
        newest = self._checkpoints(stage) / "progress" / f"{step:012d}"
        checkpoint.save(newest, state)
        # A later step is a broken one that was skipped, or there would be no way to this one.
        kept = [f for f in self._progress(stage) if f.name <= newest.name][:_PROGRESS_KEPT]
        for folder in newest.parent.iterdir():
            if folder not in kept:
                shutil.rmtree(folder, ignore_errors=True)

    def load_progress(self, stage: str, example: Tree) -> tuple[int, Tree] | None:
        """Returns the newest sound state of a stage under way and its step, or None.

        Raises:
            RepresentError: the saved state has another structure, shape or type than the example.
        """
        found = None
        for folder in self._progress(stage):
            try:
                found = int(folder.name), checkpoint.load(folder, example)
                break
            except checkpoint.BrokenCheckpoint as error:
                logging.warning("%s: going on from the checkpoint before it", error)
        processes.wait()  # The first process may drop what others still read.
        return found

    def log(self, stage: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Logs the metrics of a stage; arrays as lists, and numbers that are not finite as null."""
        if not processes.is_first():
            return
        values = {name: plain(value) for name, value in metrics.items()}
        line = json.dumps({"stage": stage, "step": step, **values, "time": round(time.time(), 3)})
        with disk_errors(self.path / "metrics.jsonl"):
            with open(self.path / "metrics.jsonl", "a") as file:
                file.write(line + "\n")
            self._scalar_log(stage).write(step, _scalars(values))
        if self._tracker is not None:
            self._tracker.write(stage, step, _scalars(values))

    def read_log(self, stage: str | None = None) -> list[dict[str, Any]]:
        """Returns the logged lines, oldest first, of one stage or of all of them."""
        path = self.path / "metrics.jsonl"
        lines = []
        for text in path.read_text().splitlines() if path.exists() else ():
            try:
                line = json.loads(text)
            except ValueError:
                continue  # A killed run may leave half of its last line.
            if stage is None or line["stage"] == stage:
                lines.append(line)
        return lines

    def rewind_log(self, stage: str, step: int) -> None:
        """Drops what the stage logged after a step, to be logged again."""
        if not processes.is_first():
            return
        self._close_scalar_log(stage)
        self._purge_steps[stage] = step + 1
        lines = [line for line in self.read_log() if line["stage"] != stage or line["step"] <= step]
        with replacing(self.path / "metrics.jsonl") as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in lines))

    def has_findings(self, stage: str) -> bool:
        """Returns whether what the stage found is saved."""
        return processes.agreed(self._findings(stage).is_file())

    def save_findings(self, stage: str, findings: Mapping[str, Any]) -> None:
        """Writes findings/<stage>.json; arrays as lists, numbers that are not finite as null."""
        _write_json(self._findings(stage), plain(findings))

    def load_findings(self, stage: str) -> dict[str, Any]:
        """Returns what a stage found.

        Raises:
            RepresentError: there are no findings of it, or they are no JSON.
        """
        return _read_json(self._findings(stage))

    def write_results(self, results: Mapping[str, Any]) -> None:
        """Writes results.json; arrays as lists, and numbers that are not finite as null."""
        _write_json(self.path / "results.json", plain(results))

    def read_results(self) -> dict[str, Any]:
        """Returns what results.json holds.

        Raises:
            RepresentError: there are no results, or they are no JSON.
        """
        return _read_json(self.path / "results.json")

    def save_arrays(self, name: str, arrays: Mapping[str, Any]) -> None:
        """Saves named arrays, such as the points of a figure, as arrays/<name>.npz."""
        if processes.is_first():
            values = {key: np.asarray(array) for key, array in arrays.items()}
            with replacing(self._arrays(name)) as temporary, open(temporary, "wb") as file:
                np.savez_compressed(file, **values)
        processes.wait()

    def load_arrays(self, name: str) -> dict[str, np.ndarray]:
        """Returns the named arrays of arrays/<name>.npz.

        Raises:
            RepresentError: the file is missing or not whole.
        """
        return load_arrays(self._arrays(name))

    def _findings(self, stage: str) -> Path:
        return self.path / "findings" / f"{stage}.json"

    def _arrays(self, name: str) -> Path:
        return self.path / "arrays" / f"{name}.npz"

    def _checkpoints(self, stage: str) -> Path:
        return self.path / "checkpoints" / stage

    def _progress(self, stage: str) -> list[Path]:
        """Returns the whole checkpoints of a stage under way, the newest first."""
        folders = (self._checkpoints(stage) / "progress").glob("[0-9]*")
        return sorted((f for f in folders if checkpoint.is_whole(f)), reverse=True)

    def _scalar_log(self, stage: str) -> ScalarLog:
        if stage not in self._scalar_logs:
            folder = self.path / "tensorboard" / stage
            self._scalar_logs[stage] = ScalarLog(folder, self._purge_steps.get(stage))
        return self._scalar_logs[stage]

    def _close_scalar_log(self, stage: str) -> None:
        if stage in self._scalar_logs:
            with disk_errors(self.path / "tensorboard" / stage):
                self._scalar_logs.pop(stage).close()


def open_run(
    path: str | os.PathLike, config: Any, resume: bool = False, tracker: Tracker | None = None
) -> RunDirectory:
    """Makes a run's folder, or opens one to go on with its run.

    Args:
        path: the folder.
        config: the run's configuration, a dataclass or a dictionary.
        resume: whether to go on with the run that the folder may hold.
        tracker: takes what the run logs, beside its own files.

    Raises:
        UsageError: the folder is not empty and `resume` is not set, or what it holds is no run, a
            run of another configuration or of another format version.
        RepresentError: no space is left, or the folder cannot be written.
    """
    path = Path(path)
    values = dict(config) if isinstance(config, Mapping) else configs.to_dict(config)
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: a file, expected a folder for the run")
    begun = path.is_dir() and any(not entry.name.startswith(".") for entry in path.iterdir())
    if processes.agreed(begun):
        if not resume:
            raise UsageError(f"{path}: not empty; resume the run in it, or choose another folder")
        _check_same_config(path, load_config_json(path), json.loads(json.dumps(values)))
    else:
        _write_json(path / "config.json", {"format_version": FORMAT_VERSION, "config": values})
    return RunDirectory(path, tracker)


def load_config_json(path: str | os.PathLike) -> dict[str, Any]:
    """Returns the configuration of the run in a folder, as `config.to_dict` gave it.

    Raises:
        UsageError: the folder holds no run, or one of another format version.
    """
    file = Path(path) / "config.json"
    if not file.is_file():
        raise UsageError(f"{path}: not the folder of a run, it has no config.json")
    stored = _read_json(file)
    version = stored.get("format_version")
    if version != FORMAT_VERSION:
        raise UsageError(f"{path}: a run of format version {version}, known is {FORMAT_VERSION}")
    return stored["config"]


def plain(value: Any) -> Any:
    """Returns the value as strict JSON holds it: arrays as lists, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic, jax.Array)):
        return plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _scalars(values: Mapping[str, Any]) -> dict[str, float]:
    """Returns every number among the values by its tag: `name`, or `name/0`, `name/1`, ..."""
    scalars = {}
    for name, value in values.items():
        if isinstance(value, list):
            scalars |= _scalars({f"{name}/{i}": item for i, item in enumerate(value)})
        elif isinstance(value, (bool, int, float)):
            scalars[name] = float(value)
    return scalars


def _check_same_config(path: Path, stored: dict[str, Any], given: dict[str, Any]) -> None:
    keys = configs.diff(stored, given)
    if keys:
        shown = ", ".join(f"{k} ({_at(stored, k)} there, {_at(given, k)} here)" for k in keys[:3])
        more = f" and {len(keys) - 3} more" if len(keys) > 3 else ""
        raise UsageError(f"{path}: holds a run of another configuration: {shown}{more}")


def _at(values: Any, dotted_key: str) -> str:
    for key in dotted_key.split("."):
        if key not in values:
            return "absent"
        values = values[key]
    return repr(values)


def _write_json(path: Path, value: Any) -> None:
    if processes.is_first():
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(value, indent=2) + "\n")
    processes.wait()


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except FileNotFoundError as error:
        raise RepresentError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        raise RepresentError(f"{path}: cannot be read ({error})") from error
