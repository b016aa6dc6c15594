"""A node's folder as bytes, for machines that share no file system."""

import io
import os
import tarfile
from pathlib import Path

from represent_jax.data.atomic import disk_errors
from represent_jax.runs.graph import MARK


def pack(folder: str | os.PathLike) -> bytes:
    """Returns everything in a folder; the mark that it is done comes last."""
    folder = Path(folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != MARK)
    mark = folder / MARK
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        for path in [*files, *([mark] if mark.is_file() else [])]:
            archive.add(path, arcname=str(path.relative_to(folder)))
    return stream.getvalue()


def unpack(parcel: bytes, folder: str | os.PathLike) -> None:
    """Writes what `pack` returned to a folder; cut off on the way, the folder is not done.

    Raises:
        RepresentError: no space is left, or the folder cannot be written.
    """
    folder = Path(folder)
    with disk_errors(folder), tarfile.open(fileobj=io.BytesIO(parcel)) as archive:
        folder.mkdir(parents=True, exist_ok=True)
        archive.extractall(folder, filter="data")
