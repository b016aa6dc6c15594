"""Demonstrations by name: those that ship with the package, or a file."""

import os
from importlib import resources
from pathlib import Path

from represent_jax.data.npz import load_demonstrations as load_file
from represent_jax.data.trajectories import Demonstrations
from represent_jax.errors import UsageError, unknown


def names() -> tuple[str, ...]:
    """Returns the names of what ships with the package; a "_test" set goes with each domain."""
    folder = resources.files("represent_jax.data.shipped")
    return tuple(sorted(Path(f.name).stem for f in folder.iterdir() if f.name.endswith(".npz")))


# Files of formats that `data.formats` reads.
_OF_OTHERS = (".csv", ".h5", ".hdf5")


def load_demonstrations(name_or_path: str | os.PathLike) -> Demonstrations:
    """Loads demonstrations by name, such as "half_cheetah", or from an npz file.

    Raises:
      UsageError: neither a name nor a file.
      RepresentError: the file is not a whole file of demonstrations.
    """
    if str(name_or_path) in names():
        folder = resources.files("represent_jax.data.shipped")
        with resources.as_file(folder / f"{name_or_path}.npz") as path:
            return load_file(path)
    path = Path(name_or_path)
    if not path.exists():
        if path.suffix or len(path.parts) > 1:
            raise UsageError(f"{name_or_path}: no such file of demonstrations")
        raise unknown("demonstrations", str(name_or_path), names())
    if path.suffix.lower() in _OF_OTHERS:
        raise UsageError(
            f"{name_or_path}: expected an npz file of demonstrations; experiments.convert makes one"
        )
    return load_file(path)


def load_test(env_name: str, name_or_path: str | os.PathLike = "") -> Demonstrations | None:
    """Loads unseen trajectories: those asked for, or the environment's own, None where none ship.

    Raises:
      UsageError: neither a name nor a file.
      RepresentError: the file is not a whole file of demonstrations.
    """
    own = f"{env_name}_test"
    if not name_or_path and own not in names():
        return None
    return load_demonstrations(name_or_path or own)
