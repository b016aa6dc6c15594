"""A graph of stages, each run once and found again by the hash of what it depends on.

A node's folder is named after its hash, so that methods and tables that need the same stage share
it, a graph that was killed goes on where it was, and a changed setting runs anew only what lies
behind it.
"""

import dataclasses
import functools
import hashlib
import json
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from represent_jax.data.atomic import replacing
from represent_jax.errors import RepresentError
from represent_jax.runs.directory import RunDirectory, open_run
from represent_jax.runs.tracking import Tracker

DONE, FAILED, BLOCKED = "done", "failed", "blocked"
MARK = "done.json"


@dataclasses.dataclass(frozen=True)
class Node:
    """One stage and everything its output depends on.

    Attributes:
      kind: what it does; nodes of a kind take about equally long.
      name: what people see.
      settings: what the output depends on beside the inputs; JSON.
      inputs: nodes whose outputs `run` is given, in order.
      run: `run(directory, *outputs)` returns the output; where the directory holds it already, it
        is loaded and not made again.
    """

    kind: str
    name: str
    settings: Mapping[str, Any]
    inputs: tuple["Node", ...]
    run: Callable[..., Any]

    @functools.cached_property
    def hash(self) -> str:
        """Hash of kind, settings and inputs; the name plays no part."""
        told = [self.kind, self.settings, [node.hash for node in self.inputs]]
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


class Engine(Protocol):
    """Where nodes run.

    Attributes:
      slots: how many nodes it takes at once.
    """

    slots: int

    def start(self, graph: "Graph", node: Node) -> None:
        """Takes on a node whose inputs are done."""

    def wait(self, graph: "Graph") -> tuple[Node, str | None]:
        """Returns a node that has ended, done in the graph's folder, or not and why."""


class InTurn:
    """Runs nodes one after the other in this process, which keeps the outputs that it needs."""

    slots = 1

    def start(self, graph: "Graph", node: Node) -> None:
        self._node = node

    def wait(self, graph: "Graph") -> tuple[Node, str | None]:
        return self._node, graph.make(self._node)


class Graph:
    """Nodes and the folder their outputs live in."""

    def __init__(
        self,
        nodes: Iterable[Node],
        folder: Path,
        track: Callable[[Node, Path], Tracker] | None = None,
    ):
        """Orders the nodes, with all they need, so that inputs come first.

        Args:
          nodes: the nodes that are wanted.
          folder: where their folders are.
          track: makes what takes a node's logs beside its own files, from node and folder.
        """
        self.folder = Path(folder)
        self._track = track
        self.nodes: list[Node] = []
        self.states: dict[str, str] = {}
        self.errors: dict[str, str] = {}
        self._outputs: dict[str, Any] = {}
        seen: set[str] = set()
        for node in nodes:
            self._add(node, seen)
        for node in self.nodes:
            if self._mark(node).is_file():
                self.states[node.hash] = DONE

    def _add(self, node: Node, seen: set[str]) -> None:
        if node.hash in seen:
            return
        seen.add(node.hash)
        for before in node.inputs:
            self._add(before, seen)
        self.nodes.append(node)

    @property
    def left(self) -> list[Node]:
        """Nodes still to run, in order."""
        return [node for node in self.nodes if node.hash not in self.states]

    def seconds_left(self) -> float | None:
        """What the nodes left will take, from those of their kind; None where none has run."""
        taken = self.seconds_by_kind()
        if any(node.kind not in taken for node in self.left):
            return None
        return sum(sum(taken[node.kind]) / len(taken[node.kind]) for node in self.left)

    def seconds_by_kind(self) -> dict[str, list[float]]:
        """What each node that is done took, under its kind."""
        taken: dict[str, list[float]] = {}
        for node in self.nodes:
            if self.is_done(node):
                taken.setdefault(node.kind, []).append(self.seconds(node))
        return taken

    def seconds(self, node: Node) -> float:
        """What a node that is done took; where it was resumed, in the process that ended it."""
        return json.loads(self._mark(node).read_text())["seconds"]

    def seconds_in_all(self, node: Node) -> float:
        """What a node that is done took together with all that it depends on."""
        return round(sum(self.seconds(one) for one in with_inputs(node)), 1)

    def is_done(self, node: Node) -> bool:
        """Returns whether the node has its output."""
        return self.states.get(node.hash) == DONE

    def run(
        self, report: Callable[["Graph", Node, str], None], engine: Engine | None = None
    ) -> None:
        """Runs what is left; a node that fails blocks those behind it and stops no other.

        Args:
          report: called with the node and "running", and again with how it ended.
          engine: where nodes run; in this process, one after the other, if None.
        """
        engine = engine or InTurn()
        running: set[str] = set()
        while self.left:
            for node in self.left:
                before = [self.states.get(one.hash) for one in node.inputs]
                if FAILED in before or BLOCKED in before:
                    self._end(node, BLOCKED, report)
                elif (
                    node.hash not in running
                    and len(running) < engine.slots
                    and all(state == DONE for state in before)
                ):
                    report(self, node, "running")
                    running.add(node.hash)
                    engine.start(self, node)
            if running:
                node, error = engine.wait(self)
                running.remove(node.hash)
                if error is not None:
                    self.errors[node.hash] = error
                self._end(node, DONE if error is None else FAILED, report)
                self._forget()

    def make(self, node: Node) -> str | None:
        """Runs one node here and marks it as done; returns what went wrong, or None."""
        start = time.monotonic()
        try:
            tracker = self._track(node, self.folder / node.hash) if self._track else None
            with self.directory(node, tracker) as directory:
                self._outputs[node.hash] = node.run(directory, *self._inputs(node))
        except Exception as error:
            return self._explain(node, error)
        self._traceback(node).unlink(missing_ok=True)
        seconds = round(time.monotonic() - start, 1)
        with replacing(self._mark(node)) as temporary:
            temporary.write_text(json.dumps({"name": node.name, "seconds": seconds}) + "\n")
        return None

    def output(self, node: Node) -> Any:
        """Returns the output of a node that is done, from memory or from its folder.

        Raises:
          RepresentError: the node is not done.
        """
        if node.hash not in self._outputs:
            if self.states.get(node.hash) != DONE:
                raise RepresentError(f"{node.name}: has no output, it is not done")
            self._outputs[node.hash] = node.run(self.directory(node), *self._inputs(node))
        return self._outputs[node.hash]

    def directory(self, node: Node, tracker: Tracker | None = None) -> RunDirectory:
        """Returns the folder of a node, made where there is none."""
        config = {"kind": node.kind, "settings": dict(node.settings)}
        config["inputs"] = [before.hash for before in node.inputs]
        return open_run(self.folder / node.hash, config, resume=True, tracker=tracker)

    def _inputs(self, node: Node) -> Sequence[Any]:
        return [self.output(before) for before in node.inputs]

    def _explain(self, node: Node, error: Exception) -> str:
        """What went wrong and, where that is a fault of the program, where its traceback is."""
        said = f"{type(error).__name__}: {error}"
        if isinstance(error, RepresentError):
            return said
        try:
            self._traceback(node).write_text("".join(traceback.format_exception(error)))
        except OSError:
            return said
        return f"{said} (see {self._traceback(node).relative_to(self.folder)})"

    def _traceback(self, node: Node) -> Path:
        return self.folder / node.hash / "traceback.txt"

    def _mark(self, node: Node) -> Path:
        return self.folder / node.hash / MARK

    def _end(self, node: Node, state: str, report: Callable) -> None:
        self.states[node.hash] = state
        report(self, node, state)

    def _forget(self) -> None:
        """Drops outputs that no node left needs at once."""
        needed = {before.hash for node in self.left for before in node.inputs}
        self._outputs = {key: value for key, value in self._outputs.items() if key in needed}


def with_inputs(node: Node) -> list[Node]:
    """A node and all that it depends on, each once."""
    found: dict[str, Node] = {}

    def gather(one: Node) -> None:
        found[one.hash] = one
        for before in one.inputs:
            gather(before)

    gather(node)
    return list(found.values())
