"""D4RL's HDF5 files: flat arrays, a row a step (https://arxiv.org/abs/2004.07219).

Read are `observations`, `actions`, `rewards`, `terminals`, `timeouts` and `next_observations`; see
`formats.flat` for what is done where some are missing. Written are all six and `strategy`, with the
environment's name and the metadata in an attribute of the file.
"""

import os

import numpy as np

from represent_jax.data.atomic import replacing
from represent_jax.data.formats import flat
from represent_jax.data.formats.foreign import OWN_KEY, assemble, describe, library
from represent_jax.data.trajectories import Demonstrations
from represent_jax.errors import RepresentError


def read(path: str | os.PathLike, env_name: str = "") -> Demonstrations:
    """Reads one HDF5 file.

    Args:
        path: the file.
        env_name: name of the environment; that in our own exports if empty.

    Raises:
        UsageError: h5py is not installed, or nobody names the environment.
        RepresentError: no HDF5 file, or what it holds are no demonstrations.
    """
    h5py = library("h5py", "hdf5")
    try:
        with h5py.File(path, "r") as file:
            described = file.attrs.get(OWN_KEY)
            names: list[str] = []
            file.visititems(
                lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
            )
            known = {key for keys in flat.NAMES.values() for key in keys} | {"dones"}
            arrays = {name: file[name][()] for name in names if name in known}
            # Not read, but named among what is left out.
            arrays |= {name: np.empty(0) for name in names if name not in known}
    except FileNotFoundError as error:
        raise RepresentError(f"{path}: no such file") from error
    except OSError as error:
        raise RepresentError(f"{path}: not a whole HDF5 file: {error}") from error
    try:
        trajectories, notes = flat.from_arrays(arrays)
    except RepresentError as error:
        raise RepresentError(f"{path}: {error}") from error
    return assemble(str(path), trajectories, env_name, described, notes, format="d4rl")


def write(path: str | os.PathLike, demonstrations: Demonstrations) -> None:
    """Writes one HDF5 file, which is there whole or not at all.

    D4RL's own reader asks for actions and rewards; where they are missing, so are their arrays.

    Raises:
        UsageError: h5py is not installed.
        RepresentError: no space is left, or the file cannot be written.
    """
    h5py = library("h5py", "hdf5")
    with replacing(path) as temporary, h5py.File(temporary, "w") as file:
        for name, rows in flat.to_rows(demonstrations).items():
            file.create_dataset(name, data=rows, compression="gzip")
        file.attrs[OWN_KEY] = describe(demonstrations)
