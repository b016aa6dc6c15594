"""Runs a campaign's stages on Ray: many machines, lost workers replaced.

The process that plans the campaign keeps the graph, the folder and the records. A stage is one Ray
task. Where workers see the campaign's folder, a stage that lost its worker goes on from its last
checkpoint; where they do not, folders travel through Ray's object store, and it begins anew.
"""

import dataclasses
import socket
import sys
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from represent_jax.campaign.entries import Entry, Recipe
from represent_jax.campaign.worker import Order, Outcome, work
from represent_jax.config import require
from represent_jax.errors import RepresentError, UsageError
from represent_jax.runs import provenance
from represent_jax.runs.graph import Graph, Node, with_inputs
from represent_jax.runs.parcel import pack, unpack


@dataclasses.dataclass(frozen=True)
class RayConfig:
    """Settings of the engine.

    Attributes:
      address: "local" starts a cluster on this machine, "auto" joins the one of this machine,
        anything else is a cluster's address.
      shared_folder: whether workers see the campaign's folder, under the same path.
      retries: how often a stage that lost its worker is run again.
      cpus, gpus: what Ray sets aside for a stage.
    """

    address: str = "local"
    shared_folder: bool = True
    retries: int = 3
    cpus: float = 1.0
    gpus: float = 0.0

    def __post_init__(self) -> None:
        require(bool(self.address), "address", "'local', 'auto' or an address", self.address)
        require(self.retries >= 0, "retries", "at least 0", self.retries)
        require(self.cpus > 0, "cpus", "more than 0", self.cpus)
        require(self.gpus >= 0, "gpus", "at least 0", self.gpus)


class RayEngine:
    """An engine of `runs.graph`; a context manager that leaves the cluster, or ends its own."""

    slots = sys.maxsize

    def __init__(self, every: Iterable[Entry], config: RayConfig):
        """Joins, or starts, the cluster.

        Args:
          every: the runs whose stages will be asked for.
          config: settings.

        Raises:
          UsageError: Ray is not installed.
          RepresentError: there is no cluster at the address.
        """
        self._ray = _import_ray()
        self._config = config
        self._recipes: dict[str, Recipe] = {}
        for entry in every:
            for report in entry.reports.values():
                for node in with_inputs(report):
                    self._recipes.setdefault(node.hash, entry.recipe)
        self._nodes: dict[Any, Node] = {}
        self._parcels: dict[str, Any] = {}
        self._connect()
        ray = self._ray

        def task(order: Order, parcels: Mapping[str, Any]) -> Outcome:
            return work(order, dict(zip(parcels, ray.get(list(parcels.values())), strict=True)))

        # Ray itself runs a task again that lost its worker; errors of a stage are no such loss.
        self._task = ray.remote(
            max_retries=config.retries,
            retry_exceptions=False,
            num_cpus=config.cpus,
            num_gpus=config.gpus,
        )(task)

    def _connect(self) -> None:
        _check_reachable(self._config.address)
        own = {"include_dashboard": False} if self._config.address == "local" else {}
        try:
            with warnings.catch_warnings():
                # Ray starts programs of its own, which have none of JAX's threads.
                warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
                self._ray.init(
                    self._config.address, log_to_driver=False, logging_level="ERROR", **own
                )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise RepresentError(
                f"address {self._config.address}: no Ray there: {error}"
            ) from error

    def __enter__(self) -> "RayEngine":
        return self

    def __exit__(self, *exception: object) -> None:
        self._ray.shutdown()

    def start(self, graph: Graph, node: Node) -> None:
        graph.directory(node)
        parcels = {}
        if not self._config.shared_folder:
            before = [one for one in with_inputs(node) if one is not node]
            parcels = {one.hash: self._parcel(graph, one) for one in before}
        order = Order(
            self._recipes[node.hash],
            node.hash,
            str(graph.folder.absolute()) if self._config.shared_folder else None,
            provenance()["commit"],
        )
        self._nodes[self._task.options(name=node.name).remote(order, parcels)] = node

    def wait(self, graph: Graph) -> tuple[Node, str | None]:
        (ended, *_), _ = self._ray.wait(list(self._nodes), num_returns=1)
        node = self._nodes.pop(ended)
        try:
            outcome = self._ray.get(ended)
        except self._ray.exceptions.RayTaskError:
            raise  # A stage fails with an outcome; this is a fault of the program.
        except self._ray.exceptions.RayError as error:
            lost = str(error).splitlines()[0] if str(error) else ""
            return node, f"{type(error).__name__} after {self._config.retries} retries: {lost}"
        if outcome.parcel is not None:
            unpack(outcome.parcel, graph.folder / node.hash)
        self._forget(graph, node)
        return node, outcome.error

    def _forget(self, graph: Graph, ended: Node) -> None:
        """Lets Ray drop the parcels that no node still needs."""
        waiting = [node for node in graph.left if node is not ended]
        needed = {one.hash for node in waiting for one in with_inputs(node)}
        self._parcels = {of: parcel for of, parcel in self._parcels.items() if of in needed}

    def _parcel(self, graph: Graph, node: Node) -> Any:
        """Reference to a node's folder in Ray's object store."""
        if node.hash not in self._parcels:
            self._parcels[node.hash] = self._ray.put(pack(Path(graph.folder) / node.hash))
        return self._parcels[node.hash]


def _check_reachable(address: str) -> None:
    """Refuses an address at which nothing listens, which Ray would try for minutes."""
    host, _, port = address.rpartition("/")[2].rpartition(":")
    if not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), timeout=10.0).close()
    except OSError as error:
        raise RepresentError(
            f"address {address}: no Ray there: {error.strerror or error}"
        ) from error


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise UsageError("engine ray: not installed; pip install 'represent_jax[ray]'") from error
    return ray
