"""Formats by name, and several inputs as one set of demonstrations."""

import dataclasses
import os
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

from represent_jax.data import npz
from represent_jax.data.catalogue import load_demonstrations
from represent_jax.data.formats import arrays, d4rl, imitation, minari
from represent_jax.data.trajectories import SOURCES, Demonstrations
from represent_jax.errors import RepresentError, UsageError, unknown

_OPTIONAL = ("actions", "rewards")


class Format(NamedTuple):
    """A format.

    Attributes:
        read: `read(input, env_name)` reads one input; the name may be empty for our own exports.
        write: `write(output, demonstrations)`.
        what: what inputs and outputs are, in words.
    """

    read: Callable[..., Demonstrations]
    write: Callable[..., None]
    what: str


def _read_npz(path: str | os.PathLike, env_name: str = "") -> Demonstrations:
    held = load_demonstrations(path)
    return dataclasses.replace(held, env_name=env_name or held.env_name)


FORMATS: dict[str, Format] = {
    "npz": Format(
        _read_npz,
        npz.save_demonstrations,
        "our own npz file, or the name of shipped demonstrations",
    ),
    "minari": Format(minari.read, minari.write, "name of a Minari dataset"),
    "imitation": Format(imitation.read, imitation.write, "folder of the imitation library"),
    "d4rl": Format(d4rl.read, d4rl.write, "HDF5 file as D4RL has them"),
    "arrays": Format(arrays.read, arrays.write, "npz or CSV file of plain arrays"),
}


def find_format(name: str) -> Format:
    """Finds a format.

    Raises:
        UsageError: no format of that name.
    """
    if name not in FORMATS:
        raise unknown("format", name, FORMATS)
    return FORMATS[name]


def read(
    format_name: str, inputs: Sequence[str], env_name: str = "", leave_out: Collection[str] = ()
) -> Demonstrations:
    """Reads one or several inputs, in order, one for each demonstrator.

    An input of several demonstrators keeps them apart: their strategies follow those of the inputs
    before it.

    Args:
        format_name: of all inputs.
        inputs: files, folders or names of datasets.
        env_name: name of the environment; needed unless the inputs are our own exports.
        leave_out: "actions", "rewards" or both, not to take over.

    Raises:
        UsageError: no such format, no inputs, nothing of that name to leave out, a library is
            missing, or inputs disagree on the environment and none is named.
        RepresentError: an input cannot be read, or inputs disagree in dimensions, or on whether
            actions and rewards are known.
    """
    if not inputs:
        raise UsageError("no inputs")
    for part in leave_out:
        if part not in _OPTIONAL:
            raise unknown("part to leave out", part, _OPTIONAL)
    one = find_format(format_name)
    every = [_without(leave_out, one.read(name, env_name)) for name in inputs]
    if len(every) == 1:
        return every[0]
    _check_alike(inputs, every)
    trajectories, before = [], 0
    for held in every:
        trajectories += [
            dataclasses.replace(t, strategy=t.strategy + before) for t in held.trajectories
        ]
        before += held.num_strategies
    sources = dict.fromkeys(held.metadata.get("source", "unknown") for held in every)
    metadata = {
        "source": SOURCES.join(sources),
        "inputs": [
            {"input": str(name), **held.metadata} for name, held in zip(inputs, every, strict=True)
        ],
    }
    return Demonstrations(every[0].env_name, tuple(trajectories), metadata)


def write(format_name: str, output: str, demonstrations: Demonstrations) -> None:
    """Writes demonstrations.

    Raises:
        UsageError: no such format, a library is missing, or the format cannot hold them.
        RepresentError: the output cannot be written.
    """
    find_format(format_name).write(output, demonstrations)


def _without(parts: Collection[str], held: Demonstrations) -> Demonstrations:
    nothing = dict.fromkeys(parts)
    trajectories = (dataclasses.replace(t, **nothing) for t in held.trajectories)
    return dataclasses.replace(held, trajectories=tuple(trajectories))


def _check_alike(inputs: Sequence[str], every: Sequence[Demonstrations]) -> None:
    first = every[0]
    for name, held in zip(inputs[1:], every[1:], strict=True):
        if held.env_name != first.env_name:
            raise UsageError(
                f"{name} is of {held.env_name}, {inputs[0]} of {first.env_name}: name one"
            )
        for what, has in (("actions", "has_actions"), ("rewards", "has_rewards")):
            if getattr(held, has) != getattr(first, has):
                lacks, other = (inputs[0], name) if getattr(held, has) else (name, inputs[0])
                raise RepresentError(
                    f"{lacks} has no {what}, {other} has them: leave them out of all, or of none"
                )
        for what, dim in (("observations", "obs_dim"), ("actions", "action_dim")):
            if getattr(held, dim) != getattr(first, dim):
                raise RepresentError(
                    f"{name}: {what} have {getattr(held, dim)} dimensions, those of {inputs[0]} "
                    f"have {getattr(first, dim)}"
                )
