"""One stage of a campaign, run by another process than the one that plans the campaign.

Nodes cannot travel: they are closures over a plan. What travels is the recipe of a run that has
the node; the worker makes the same graph from it, finds the node by its hash, and so refuses to
run anything but what was asked for.
"""

import dataclasses
import functools
import json
import os
import socket
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from represent_jax.campaign.entries import Entry, Recipe, make_entry
from represent_jax.data.atomic import disk_errors
from represent_jax.errors import RepresentError
from represent_jax.runs import provenance
from represent_jax.runs.graph import Graph, Node
from represent_jax.runs.parcel import pack, unpack

ATTEMPTS = "attempts.jsonl"


@dataclasses.dataclass(frozen=True)
class Order:
    """A stage to run.

    Attributes:
      recipe: of a run that has the stage.
      node: hash of its node.
      folder: the campaign's folder; None where the worker does not see it.
      commit: of the code that planned the campaign.
    """

    recipe: Recipe
    node: str
    folder: str | None
    commit: str


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a stage ended.

    Attributes:
      error: what went wrong, None if nothing did.
      parcel: the node's folder, where the worker does not see the campaign's.
    """

    error: str | None
    parcel: bytes | None = None


def work(order: Order, parcels: Mapping[str, bytes]) -> Outcome:
    """Runs a stage.

    Args:
      order: the stage.
      parcels: folders of all nodes that it depends on, by hash, where the order names no folder.
    """
    try:
        if order.folder is not None:
            return Outcome(_run(order, Path(order.folder)))
        with tempfile.TemporaryDirectory(prefix="represent_jax-") as folder:
            for name, parcel in parcels.items():
                unpack(parcel, Path(folder) / name)
            error = _run(order, Path(folder))
            return Outcome(error, pack(Path(folder) / order.node))
    except RepresentError as error:
        return Outcome(f"on {socket.gethostname()}: {error}")


def attempts(folder: Path) -> list[dict]:
    """Who worked in a node's folder: host, process and time of each attempt, oldest first."""
    path = folder / ATTEMPTS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _run(order: Order, folder: Path) -> str | None:
    here = provenance()["commit"]
    if "unknown" not in (here, order.commit) and here != order.commit:
        raise RepresentError(f"the code is of commit {here}, the campaign's of {order.commit}")
    if order.folder is not None and not (folder / order.node).is_dir():
        raise RepresentError(f"{folder}: not the campaign's folder; is it on a shared file system?")
    graph = Graph(_entry(order.recipe).reports.values(), folder)
    node = _find(graph, order)
    missing = [before.name for before in node.inputs if not graph.is_done(before)]
    if missing:
        raise RepresentError(f"{folder}: {', '.join(missing)} is not done there")
    with graph.directory(node) as directory:
        path = directory.path / ATTEMPTS
        told = {"host": socket.gethostname(), "pid": os.getpid(), "time": round(time.time(), 3)}
        with disk_errors(path), open(path, "a") as file:
            file.write(json.dumps(told) + "\n")
    return graph.make(node)


def _find(graph: Graph, order: Order) -> Node:
    for node in graph.nodes:
        if node.hash == order.node:
            return node
    raise RepresentError(
        f"{order.recipe.domain} {order.recipe.variant} has no stage {order.node} here: another "
        "version, other demonstrations, or another physics engine (backend=auto picks by platform)"
    )


@functools.lru_cache(maxsize=64)
def _entry(recipe: Recipe) -> Entry:
    return make_entry(recipe)
