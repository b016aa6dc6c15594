"""Files that are there whole or not at all, whenever the process dies."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from represent_jax.errors import RepresentError


@contextlib.contextmanager
def disk_errors(path: str | os.PathLike) -> Iterator[None]:
    """Turns an operating-system error in the block into one line that names the path.

    Raises:
        RepresentError: no space is left, or the path cannot be written.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise RepresentError(f"{path}: no space left on the device") from error
        raise RepresentError(f"{path}: cannot be written ({error.strerror or error})") from error


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path beside `path`; when the block ends well, it takes the name `path`.

    Missing folders are made. When the block raises, `path` is as it was before.

    Raises:
        RepresentError: no space is left, or the path cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".tmp-{path.name}")
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            with open(temporary, "rb") as written:
                os.fsync(written.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
