"""Records of what was measured: one JSON object a line, appended by any number of processes."""

import fcntl
import functools
import json
import os
import platform
import subprocess
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from represent_jax.data.atomic import disk_errors
from represent_jax.errors import RepresentError, UsageError, unknown
from represent_jax.host import num_cpus
from represent_jax.runs.directory import plain

FIELDS = (
    "domain",
    "method",
    "target",
    "quantity",
    "seed",
    "value",
    "preset",
    "commit",
    "config_hash",
    "backend",
    "device",
    "versions",
    "seconds",
)

_PACKAGES = (
    "represent_jax",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "brax",
    "flax",
    "optax",
    "orbax-checkpoint",
    "gymnasium",
    "numpy",
)


def append_record(path: str | os.PathLike, **fields: Any) -> None:
    """Appends one record to a file.

    Args:
        path: the file, made when missing.
        **fields: a value for each of `FIELDS`; commit, device and versions are those of
            `provenance` when left out. A value that is not finite becomes null.

    Raises:
        UsageError: a field is unknown or missing.
        RepresentError: no space is left, or the file cannot be written.
    """
    for name in fields:
        if name not in FIELDS:
            raise unknown("field of a record", name, FIELDS)
    given = provenance() | fields
    missing = [name for name in FIELDS if name not in given]
    if missing:
        raise UsageError(f"a record needs {', '.join(missing)}")
    line = json.dumps({name: plain(given[name]) for name in FIELDS}) + "\n"
    path = Path(path)
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(line)
            file.flush()
            os.fsync(file.fileno())


def read_records(path: str | os.PathLike, **filters: Any) -> list[dict[str, Any]]:
    """Returns the records of a file, oldest first, that have the given values.

    Args:
        path: the file; one that is missing holds no records.
        **filters: the values asked for, by field.

    Raises:
        RepresentError: a line is no record.
        UsageError: a filter names no field.
    """
    for name in filters:
        if name not in FIELDS:
            raise unknown("field of a record", name, FIELDS)
    path = Path(path)
    records = []
    for number, line in enumerate(path.read_text().splitlines() if path.exists() else (), start=1):
        try:
            record = json.loads(line)
            if all(record[name] == value for name, value in filters.items()):
                records.append(record)
        except (ValueError, KeyError, TypeError) as error:
            raise RepresentError(f"{path}: line {number} is no record") from error
    return records


@functools.cache
def provenance() -> dict[str, Any]:
    """Returns the commit, the device and the versions that a result comes from.

    The commit is "unknown" outside a checkout, and ends in "-dirty" where the code differs from it.
    """
    return {"commit": _commit(), "device": _device(), "versions": _versions()}


def _commit() -> str:
    try:
        root = Path(_git(Path(__file__).parent, "rev-parse", "--show-toplevel"))
        commit = _git(root, "rev-parse", "--short=12", "HEAD")
        # Records themselves are tracked files, so only changes of the code count.
        changes = _git(root, "status", "--porcelain", "--", "represent_jax", "experiments")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    if not (root / "represent_jax").is_dir():
        return "unknown"
    return f"{commit}-dirty" if changes else commit


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def _device() -> str:
    cpu = f"{_cpu_model()} ({num_cpus()} cores)"
    device = jax.devices()[0]
    return cpu if device.platform == "cpu" else f"{device.device_kind}, {cpu}"


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def append_results(
    path: str | os.PathLike,
    method: str,
    config_hash: str,
    results: Mapping[str, Any],
    only_new: bool = False,
) -> None:
    """Appends every figure of a run's results: demonstrators, rewards and policies.

    Args:
      path: the file.
      method: name of the method.
      config_hash: hash of the run's configuration.
      results: what the method returned, or the part of it that there is so far.
      only_new: leaves out figures that are the last the file holds for the same run already.
    """
    common = {
        "domain": results["env"],
        "method": method,
        "seed": results["seed"],
        "preset": results["preset"],
        "backend": results["backend"],
        "config_hash": config_hash,
        "seconds": sum(results["seconds"].values()),
        **{name: results.get(name, here) for name, here in provenance().items()},
    }
    held = {}
    if only_new:
        names = ("domain", "method", "seed", "preset")
        for record in read_records(path, **{name: common[name] for name in names}):
            held[record["target"], record["quantity"]] = record["config_hash"], record["value"]
    for target, quantity, value in _figures(results):
        if held.get((target, quantity)) != (config_hash, plain(value)):
            append_record(path, target=target, quantity=quantity, value=value, **common)


def _figures(results: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """Yields target, quantity and value of every figure in a run's results."""
    for one in results["demonstrators"]:
        if one["return_mean"] is not None:
            yield one["name"], "demo_return", one["return_mean"]
    for one, imitation in zip(results["demonstrators"], results.get("airl", ()), strict=False):
        for name, value in imitation.items():
            if name != "ratio":
                yield one["name"], f"airl_{name}", value
    for part in ("rewards", "policies"):
        for target, quantities in results.get(part, {}).items():
            for name, value in quantities.items():
                yield target, name, value
