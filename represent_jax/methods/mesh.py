"""Members of a population spread over devices, of one process or of several.

Every device runs the same program on its own members (`jax.shard_map`), so nothing is exchanged
while they train, loops end on each device by themselves, and host callbacks, which the partitioner
would gather on one device, stay with the members they belong to.

Members are never padded: as many devices are used as divide their number, so that states and
checkpoints are the same on any number of devices.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "members"


def mesh_for(num_members: int) -> Mesh | None:
    """The devices that a population is spread over; None if that is one.

    Of several processes each takes an equal part. Where that cannot be, each runs all members on
    its own devices.
    """
    processes = jax.process_count()
    for per_process in range(jax.local_device_count(), 0, -1):
        if num_members % (per_process * processes) == 0:
            devices = [
                device
                for process in range(processes)
                for device in jax.local_devices(process)[:per_process]
            ]
            return _mesh(devices)
    counts = range(min(num_members, jax.local_device_count()), 0, -1)
    count = next((count for count in counts if num_members % count == 0), 1)
    return _mesh(jax.local_devices()[:count])


def _mesh(devices: list[jax.Device]) -> Mesh | None:
    return Mesh(np.array(devices), (AXIS,)) if len(devices) > 1 else None


def axis_of_leaves(axes: Any, tree: Any) -> Any:
    """Spreads vmap axes, given for whole parts of a tree, to its leaves; None where there are none.

    Args:
      axes: 0 or None for a leaf or a part of the tree.
      tree: the tree, parts of which may be absent.
    """
    return jax.tree.broadcast(axes, tree, is_leaf=absent)


def sharded(mesh: Mesh, program: Callable, axes_in: tuple, axes_out: Any) -> Callable:
    """Runs a program on each device's members.

    Args:
      mesh: the devices.
      program: takes and returns trees with the member axis in front where their axes are 0.
      axes_in: axes of each argument, one for all of it or one for each leaf.
      axes_out: axes of what it returns.
    """
    return jax.shard_map(
        program,
        mesh=mesh,
        in_specs=_specs(axes_in),
        out_specs=_specs(axes_out),
        # Counters start as constants and stay the same everywhere; the check cannot see that
        # through loops that mix them with what differs.
        check_vma=False,
    )


def place(mesh: Mesh, tree: Any, axes: Any) -> Any:
    """Puts a tree where `sharded` reads it, unless it is there already."""
    axes = axis_of_leaves(axes, tree)

    def put(leaf, axis):
        sharding = NamedSharding(mesh, _spec(axis))
        if leaf is None or _is_there(leaf, sharding):
            return leaf
        values = np.asarray(leaf)
        return jax.make_array_from_callback(values.shape, sharding, lambda part: values[part])

    return jax.tree.map(put, tree, axes, is_leaf=absent)


def _is_there(leaf: Any, sharding: NamedSharding) -> bool:
    return isinstance(leaf, jax.Array) and leaf.sharding.is_equivalent_to(sharding, leaf.ndim)


def replicate(mesh: Mesh, tree: Any) -> Any:
    """Gives every device all of a tree, inside a compiled program."""
    return jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, PartitionSpec()))


def fetch(mesh: Mesh, tree: Any) -> Any:
    """Brings all of a tree from its devices to this process's first; all processes call it."""
    whole = NamedSharding(mesh, PartitionSpec())
    gathered = jax.jit(lambda x: x, out_shardings=whole)(tree)
    return jax.tree.map(jnp.asarray, jax.device_get(gathered))


def absent(leaf: Any) -> bool:
    """Returns whether an axis, or a part of a state, is absent."""
    return leaf is None


def _specs(axes: Any) -> Any:
    return jax.tree.map(_spec, axes, is_leaf=absent)


def _spec(axis: int | None) -> PartitionSpec:
    return PartitionSpec() if axis is None else PartitionSpec(AXIS)
