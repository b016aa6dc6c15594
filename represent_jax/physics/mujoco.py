"""C MuJoCo's thread pool behind `jax.pure_callback`: the engine for CPU hosts."""

import collections
import contextlib
import os
import threading
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch as mujoco_batch

from represent_jax.physics.engine import Engine, PhysicsState


class MujocoEngine(Engine):
    """Steps scenes on the host with `mujoco.batch.Batch`.

    The callback flattens whatever leading axes vmap has made into one batch. A `Batch` must not
    be used by two threads at once, so they are lent from a pool: two compiled programs, or two
    callbacks of one, each get their own.
    """

    name = "mujoco"

    def __init__(
        self,
        model: mujoco.MjModel,
        frame_skip: int,
        derived_fields: tuple[str, ...] = (),
        num_threads: int | None = None,
    ):
        super().__init__(model, frame_skip, derived_fields)
        self._num_threads = num_threads or len(os.sched_getaffinity(0))
        self._idle: dict[int, list[mujoco_batch.Batch]] = collections.defaultdict(list)
        self._lock = threading.Lock()
        template = mujoco.MjData(model)
        self._derived_shapes = {
            name: jax.ShapeDtypeStruct(np.shape(getattr(template, name)), jnp.float32)
            for name in derived_fields
        }

    def step(self, state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        return self._call(self._host_step, state, ctrl)

    def forward(self, state: PhysicsState, where: jax.Array) -> PhysicsState:
        return self._call(self._host_forward, state, where)

    def _call(self, host_function, state: PhysicsState, argument: jax.Array) -> PhysicsState:
        state = state.replace(derived={})
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
        shapes = shapes.replace(derived=self._derived_shapes)
        return jax.pure_callback(
            host_function, shapes, state, argument, vmap_method="broadcast_all"
        )

    def _host_step(self, state: PhysicsState, ctrl: np.ndarray) -> PhysicsState:
        leading = state.qpos.shape[:-1]
        with self._lent_batch(int(np.prod(leading))) as batch:
            _load(batch, state)
            batch.bind("ctrl")[:] = _rows(ctrl, batch.nsim)
            batch.step(nstep=self.frame_skip)
            return self._read(batch, leading)

    def _host_forward(self, state: PhysicsState, where: np.ndarray) -> PhysicsState:
        leading = state.qpos.shape[:-1]
        with self._lent_batch(int(np.prod(leading))) as batch:
            _load(batch, state)
            batch.bind("ctrl")[:] = 0.0
            ids = np.flatnonzero(np.asarray(where))
            if ids.size:
                batch.forward(ids=ids)
            result = self._read(batch, leading)
        # mj_forward leaves its solution as the next warm start; a fresh episode starts without.
        return result.replace(qacc_warmstart=np.asarray(state.qacc_warmstart))

    @contextlib.contextmanager
    def _lent_batch(self, nsim: int) -> Iterator[mujoco_batch.Batch]:
        with self._lock:
            idle = self._idle[nsim]
            batch = idle.pop() if idle else None
        if batch is None:
            batch = mujoco_batch.Batch(self.model, nsim, min(self._num_threads, nsim))
            for name in self.derived_fields:
                batch.bind(name)
        try:
            yield batch
        finally:
            with self._lock:
                self._idle[nsim].append(batch)

    def _read(self, batch: mujoco_batch.Batch, leading: tuple[int, ...]) -> PhysicsState:
        def field(name: str) -> np.ndarray:
            rows = batch.bind(name)
            return rows.reshape(leading + rows.shape[1:]).astype(np.float32)

        return PhysicsState(
            qpos=field("qpos"),
            qvel=field("qvel"),
            act=field("act"),
            qacc_warmstart=field("qacc_warmstart"),
            derived={name: field(name) for name in self.derived_fields},
        )


def _rows(array: np.ndarray, nsim: int) -> np.ndarray:
    array = np.asarray(array)
    return array.reshape(nsim, array.shape[-1])


def _load(batch: mujoco_batch.Batch, state: PhysicsState) -> None:
    for name in ("qpos", "qvel", "act", "qacc_warmstart"):
        batch.bind(name)[:] = _rows(getattr(state, name), batch.nsim)
