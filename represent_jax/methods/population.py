"""Runs several members of one stage together: strategies or targets.

A stage is written for one member. On an accelerator a population is one vmap. On a CPU host the
small matrices of these networks do not fill two cores, so there the members run side by side,
a thread for each, as instances of one compiled program: the same results member by member, and
about twice the throughput of vmap on two cores.

Where there are several devices, each runs the vmap of its own share of the members and talks to no
other: see `methods.mesh`.
"""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp

from represent_jax.errors import unknown
from represent_jax.methods import mesh as meshes

MODES = ("auto", "threads", "vmap")


class Population:
    """Members of one stage.

    Attributes:
      inputs: what differs between members, one pytree for each, all of one structure.
      mode: "threads" or "vmap".
      mesh: the devices that share the members of a vmap; None where one has them all.
    """

    def __init__(self, inputs: Sequence[Any], mode: str = "auto", axes_of: Callable | None = None):
        """Gathers the members.

        Args:
          inputs: one pytree for each member.
          mode: "threads", "vmap", or "auto": threads on CPU hosts, vmap elsewhere and wherever
            there are several devices.
          axes_of: from a member's state to its vmap axes; 0 for all leaves if None.

        Raises:
          UsageError: no such mode.
        """
        if mode not in MODES:
            raise unknown("population mode", mode, MODES)
        if mode == "auto":
            alone = jax.default_backend() == "cpu" and jax.device_count() == 1
            mode = "threads" if alone else "vmap"
        self.inputs = list(inputs)
        self.mode = mode
        self.mesh = meshes.mesh_for(len(self.inputs)) if mode == "vmap" else None
        self._axes_of = axes_of or functools.partial(jax.tree.map, lambda _: 0)

    def init(self, init: Callable[[jax.Array, Any], Any], key: jax.Array) -> Any:
        """Makes all states with `init(key, inputs)`."""
        keys = jax.random.split(key, len(self.inputs))
        if self.mode == "threads":
            pairs = list(zip(keys, self.inputs, strict=True))
            return _side_by_side(jax.jit(init).lower(*pairs[0]).compile(), pairs)
        state = jax.eval_shape(init, keys[0], self.inputs[0])
        axes = self._axes_of(state)
        init_vmap = jax.vmap(init, out_axes=axes)
        if self.mesh is None:
            return jax.jit(init_vmap)(keys, stack(self.inputs))
        program = meshes.sharded(self.mesh, init_vmap, (0, 0), meshes.axis_of_leaves(axes, state))
        return jax.jit(program)(*meshes.place(self.mesh, (keys, stack(self.inputs)), 0))

    def example(self, init: Callable[[jax.Array, Any], Any]) -> Any:
        """Shapes and types of what `init` of the population returns, without computing it."""
        state = jax.eval_shape(init, jax.random.PRNGKey(0), self.inputs[0])
        if self.mode == "threads":
            return [state] * len(self.inputs)
        init_vmap = jax.vmap(init, out_axes=self._axes_of(state))
        keys = jax.random.split(jax.random.PRNGKey(0), len(self.inputs))
        return jax.eval_shape(init_vmap, keys, stack(self.inputs))

    def stepper(self, step: Callable[[Any, Any], tuple[Any, Any]]) -> Callable:
        """Makes `states -> (states, metrics)` of `step(state, inputs)`; states are donated.

        Metrics come back with a leading member axis, on every device. Compiled at the first call.
        """
        if self.mode == "threads":
            jitted = jax.jit(step, donate_argnums=0)
            compile_once = functools.cache(lambda: jitted.lower(*first).compile())
            first: tuple[Any, Any] = ()

            def step_threads(states):
                nonlocal first
                pairs = list(zip(states, self.inputs, strict=True))
                first = pairs[0]
                results = _side_by_side(compile_once(), pairs)
                metrics = jax.device_get([metrics for _, metrics in results])
                return [state for state, _ in results], stack(metrics)

            return step_threads
        inputs = stack(self.inputs)

        def step_vmap(states, inputs):
            axes = self._axes_of(states)
            return jax.vmap(step, in_axes=(axes, 0), out_axes=(axes, 0))(states, inputs)

        if self.mesh is None:
            # Inputs are an argument of the compiled program, not a constant in it.
            step_jit = jax.jit(step_vmap, donate_argnums=0)
            return lambda states: step_jit(states, inputs)
        inputs = meshes.place(self.mesh, inputs, 0)

        @functools.partial(jax.jit, donate_argnums=0)
        def step_sharded(states, inputs):
            axes = meshes.axis_of_leaves(self._axes_of(states), states)
            states, metrics = meshes.sharded(self.mesh, step_vmap, (axes, 0), (axes, 0))(
                states, inputs
            )
            return states, meshes.replicate(self.mesh, metrics)

        def step_placed(states):
            axes = meshes.axis_of_leaves(self._axes_of(states), states)
            return step_sharded(meshes.place(self.mesh, states, axes), inputs)

        return step_placed

    def members(self, states: Any) -> list[Any]:
        """Takes the states of a population apart."""
        if self.mode == "threads":
            return list(states)

        if self.mesh is not None:
            states = meshes.fetch(self.mesh, states)
        # Axes may be absent, and so may parts of the state: both count as leaves.
        leaves, structure = jax.tree.flatten(states, is_leaf=meshes.absent)
        axes = meshes.axis_of_leaves(self._axes_of(states), states)
        axes = jax.tree.leaves(axes, is_leaf=meshes.absent)

        def member(i):
            return [
                leaf if axis is None or leaf is None else leaf[i]
                for leaf, axis in zip(leaves, axes, strict=True)
            ]

        return [structure.unflatten(member(i)) for i in range(len(self.inputs))]


def stack(members: Sequence[Any]) -> Any:
    """Stacks pytrees of one structure along a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


def member_of(stacked: Any, i: int) -> Any:
    """Takes member i out of a pytree whose leaves are `[num_members, ...]`."""
    return jax.tree.map(lambda leaf: leaf[i], stacked)


def _side_by_side(compiled: Callable, arguments: list[tuple]) -> list[Any]:
    """Calls a compiled program with each of the arguments, on as many threads."""
    with ThreadPoolExecutor(max_workers=len(arguments)) as pool:
        return list(pool.map(lambda args: jax.block_until_ready(compiled(*args)), arguments))
