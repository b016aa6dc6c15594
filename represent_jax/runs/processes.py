"""Several processes that run one program, with `jax.distributed`.

All of them compute; populations are spread over the devices of all (`methods.mesh`), and what is no
population every process computes for itself, to the same result. One, the first, writes. Whatever
the run's path depends on (what is done already, when to save) is what the first process found.
"""

from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from represent_jax.errors import RepresentError

T = TypeVar("T", bool, int)


def join(address: str = "", num_processes: int = 0, process: int = -1) -> None:
    """Joins the processes of one program, before anything else asks JAX for devices.

    Args:
      address: host and port at which the first process listens; "" where the cluster (Slurm, Open
        MPI, a TPU pod) tells JAX all three.
      num_processes: number of processes; 0 where the cluster tells.
      process: number of this one, from 0; -1 where the cluster tells.

    Raises:
      RepresentError: the processes do not find each other.
    """
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    # It would catch SIGTERM and go on; a run that is ended so should end, and can be resumed.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            address or None, num_processes or None, process if process >= 0 else None
        )
    except (RuntimeError, ValueError) as error:
        raise RepresentError(f"distributed: {str(error).splitlines()[0]}") from error


def several() -> bool:
    """Returns whether this is one of several processes."""
    return jax.distributed.is_initialized() and jax.process_count() > 1


def is_first() -> bool:
    """Returns whether this process is the one that writes."""
    return not several() or jax.process_index() == 0


def agreed(value: T) -> T:
    """Returns the first process's value; all processes call it."""
    if not several():
        return value
    from jax.experimental import multihost_utils

    return type(value)(multihost_utils.broadcast_one_to_all(np.asarray(value)))


def wait() -> None:
    """Waits until all processes are here."""
    agreed(0)


def whole(tree: Any) -> Any:
    """Brings parts of arrays that are on other processes here; all processes call it."""
    if not several():
        return tree
    return jax.tree.map(_whole, tree)


def _whole(leaf: Any) -> Any:
    if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable:
        return leaf
    mesh = leaf.sharding.mesh if isinstance(leaf.sharding, NamedSharding) else _all_devices()
    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.device_get(jax.jit(lambda x: x, out_shardings=everywhere)(leaf))


def _all_devices() -> Mesh:
    return Mesh(np.array(jax.devices()), ("devices",))
