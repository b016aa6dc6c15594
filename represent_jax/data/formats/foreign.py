"""From what a file of another library holds to demonstrations.

Our own exports keep the environment's name and the metadata beside the arrays, as one JSON string,
so that a round trip loses nothing. Files of others have neither: the caller names the environment,
and the metadata say where the file came from and what of it was not kept.
"""

import importlib
import json
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np

from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError, UsageError

# Where our exports keep what the format itself has no place for.
OWN_KEY = "represent_jax"


def library(name: str, extra: str) -> ModuleType:
    """Imports an optional library.

    Raises:
        UsageError: it is not installed; says which extra to install.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UsageError(
            f"{name} is not installed: pip install 'represent_jax[{extra}]' ({error})"
        ) from error


def describe(demonstrations: Demonstrations) -> str:
    """Returns what our own exports keep beside the arrays, as JSON."""
    return json.dumps(
        {"env_name": demonstrations.env_name, "metadata": dict(demonstrations.metadata)},
        sort_keys=True,
    )


def assemble(
    source: str,
    trajectories: Sequence[Trajectory],
    env_name: str,
    described: str | None,
    notes: Sequence[str] = (),
    **provenance: Any,
) -> Demonstrations:
    """Makes demonstrations of what one file holds.

    Args:
        source: the file, as the caller called it.
        trajectories: what it holds.
        env_name: name of the environment; that in our own exports if empty.
        described: what `describe` gave where the file is our own export, None otherwise.
        notes: what was not kept, in words.
        **provenance: what else is known of a file of others.

    Raises:
        UsageError: nobody names the environment.
        RepresentError: the trajectories are no demonstrations, or the description is damaged.
    """
    held: Mapping[str, Any] = {}
    if described is not None:
        try:
            held = json.loads(described)
            metadata = dict(held["metadata"])
        except (ValueError, KeyError, TypeError) as error:
            raise RepresentError(f"{source}: damaged description: {error}") from error
    else:
        metadata = {"source": source} | provenance
    env_name = env_name or held.get("env_name", "")
    if not env_name:
        raise UsageError(f"{source}: does not say which environment it is of; name it")
    if notes:
        metadata["notes"] = [*metadata.get("notes", ()), *notes]
    try:
        return Demonstrations(env_name, tuple(trajectories), metadata)
    except RepresentError as error:
        raise RepresentError(f"{source}: {error}") from error


def rounded(**arrays: np.ndarray | None) -> list[str]:
    """Returns a note where float32 does not hold an array's values exactly."""
    with np.errstate(over="ignore", invalid="ignore"):
        changed = [
            name
            for name, values in arrays.items()
            if values is not None
            and values.dtype.kind in "fiu"
            and np.any(values.astype(np.float32, copy=False) != values)
        ]
    return [f"rounded to float32: {', '.join(changed)}"] if changed else []
