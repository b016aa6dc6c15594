"""Pytrees on disk, bit for bit: Orbax holds the arrays, a file written last says they are whole.

A checkpoint is a folder with `arrays/` (Orbax) and `leaves.json`: the name, shape, type and CRC-32
of every leaf. Without `leaves.json` a folder is no checkpoint, so a save may die at any instant.
"""

import contextlib
import json
import os
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from absl import logging

from represent_jax.data.atomic import disk_errors, replacing
from represent_jax.errors import RepresentError

FORMAT_VERSION = 1

_LEAVES = "leaves.json"

Tree = TypeVar("Tree")


class BrokenCheckpoint(RepresentError):
    """A checkpoint was saved whole, and is no longer."""


def save(path: str | os.PathLike, tree: Any) -> None:
    """Saves a pytree of arrays and numbers to a folder, replacing what the folder held.

    Args:
        path: the folder.
        tree: JAX or numpy arrays and Python numbers; a random key as its uint32 data.

    Raises:
        RepresentError: no space is left, or the folder cannot be written; the folder is then none.
    """
    path = Path(path).absolute()
    arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(jax.device_get(tree))}
    leaves = {
        name: {"shape": list(array.shape), "dtype": array.dtype.name, "crc32": _crc32(array)}
        for name, array in arrays.items()
    }
    with disk_errors(path):
        (path / _LEAVES).unlink(missing_ok=True)
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True)
        try:
            # Orbax refuses arrays without elements; their shape is all there is to them.
            stored = {name: array for name, array in arrays.items() if array.size}
            if stored:
                with _orbax() as (ocp, checkpointer):
                    checkpointer.save(path / "arrays", args=ocp.args.StandardSave(stored))
            marker = {"format_version": FORMAT_VERSION, "leaves": leaves}
            with replacing(path / _LEAVES) as temporary:
                temporary.write_text(json.dumps(marker))
        except BaseException as error:
            shutil.rmtree(path, ignore_errors=True)
            if "No space left on device" in str(error):
                raise RepresentError(f"{path}: no space left on the device") from error
            raise


def load(path: str | os.PathLike, example: Tree) -> Tree:
    """Loads a pytree that `save` wrote.

    Args:
        path: the folder.
        example: a pytree of the same structure, shapes and types; `jax.ShapeDtypeStruct` leaves do.
            Leaves come back as what they are here: numpy arrays, Python numbers, else JAX arrays.

    Raises:
        BrokenCheckpoint: the folder holds no whole checkpoint.
        RepresentError: what it holds has another structure, shape or type than the example.
    """
    path = Path(path).absolute()
    expected = {name: _shape_and_dtype(leaf) for name, leaf in _named_leaves(example)}
    try:
        written = json.loads((path / _LEAVES).read_text())
        version, leaves = written["format_version"], written["leaves"]
        found = {name: (tuple(leaf["shape"]), leaf["dtype"]) for name, leaf in leaves.items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BrokenCheckpoint(f"{path}: not a whole checkpoint") from error
    if version != FORMAT_VERSION:
        raise RepresentError(f"{path}: format version {version}, known is {FORMAT_VERSION}")
    _check_same(path, found, expected)

    arrays = {name: np.empty(shape, dtype) for name, (shape, dtype) in expected.items()}
    target = {name: array for name, array in arrays.items() if array.size}
    if target:
        try:
            with _orbax() as (ocp, checkpointer):
                arguments = ocp.args.StandardRestore(target)
                arrays |= checkpointer.restore(path / "arrays", args=arguments)
        # Orbax and TensorStore raise many kinds of errors for files that are missing or damaged.
        except Exception as error:
            raise BrokenCheckpoint(f"{path}: the arrays cannot be read") from error
    values = []
    for name, like in _named_leaves(example):
        array = np.asarray(arrays[name])
        if _crc32(array) != leaves[name]["crc32"]:
            raise BrokenCheckpoint(f"{path}: {name} is not what was saved")
        values.append(_as_kind_of(like, array))
    return jax.tree.unflatten(jax.tree.structure(example), values)


def is_whole(path: str | os.PathLike) -> bool:
    """Returns whether a save to the folder went through to its end."""
    return (Path(path) / _LEAVES).is_file()


@contextlib.contextmanager
def _orbax() -> Iterator[tuple[Any, Any]]:
    """Yields Orbax and a synchronous checkpointer that raises its errors without printing them."""
    # Orbax takes a second to import, which those who only read plain files need not wait for.
    import orbax.checkpoint as ocp

    verbosity = logging.get_verbosity()
    logging.set_verbosity(logging.FATAL)
    try:
        # Of several processes only one saves, and each loads when it likes: none waits for others.
        alone = jax.process_index()
        options = ocp.options.MultiprocessingOptions(
            primary_host=alone, active_processes={alone}, barrier_sync_key_prefix=f"only_{alone}"
        )
        handler = ocp.StandardCheckpointHandler(multiprocessing_options=options)
        with ocp.Checkpointer(handler, multiprocessing_options=options) as checkpointer:
            yield ocp, checkpointer
    finally:
        logging.set_verbosity(verbosity)


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    paths = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [(f"state{jax.tree_util.keystr(path)}", leaf) for path, leaf in paths]


def _shape_and_dtype(leaf: Any) -> tuple[tuple[int, ...], str]:
    described = leaf if hasattr(leaf, "dtype") else np.asarray(leaf)
    return tuple(described.shape), described.dtype.name


def _check_same(path: Path, found: dict[str, Any], expected: dict[str, Any]) -> None:
    for name in dict.fromkeys([*found, *expected]):
        there, here = (_describe(leaves.get(name)) for leaves in (found, expected))
        if there != here:
            raise RepresentError(f"{path}: {name} is {there} in the file, expected {here}")


def _describe(shape_and_dtype: tuple[tuple[int, ...], str] | None) -> str:
    if shape_and_dtype is None:
        return "absent"
    shape, dtype = shape_and_dtype
    return f"{dtype}[{', '.join(map(str, shape))}]"


def _crc32(array: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8))


def _as_kind_of(like: Any, array: np.ndarray) -> Any:
    if isinstance(like, np.ndarray):
        return array
    if isinstance(like, np.generic):
        return array[()]
    if isinstance(like, (bool, int, float)):
        return array.item()
    return jnp.array(array)
