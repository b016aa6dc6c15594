"""C MuJoCo's thread pool behind `jax.pure_callback`: the engine for CPU hosts."""

import collections
import contextlib
import math
import threading
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch as mujoco_batch

from represent_jax.host import num_cpus
from represent_jax.physics.engine import Engine, PhysicsState

_STATE_FIELDS = ("qpos", "qvel", "act", "qacc_warmstart")


class MujocoEngine(Engine):
    """Steps scenes on the host with `mujoco.batch.Batch`.

    The callback flattens whatever leading axes vmap has made into one batch. A `Batch` must not
    be used by two threads at once, so they are lent from a pool: two compiled programs, or two
    callbacks of one, each get their own.

    Only one array goes in and one comes out, a row for each scene: what a callback costs grows
    with the number of arrays, and at 64 scenes five of them are a tenth of the step.
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
        self.num_threads = num_threads or num_cpus()
        self._idle: dict[int, list[_Lane]] = collections.defaultdict(list)
        self._lock = threading.Lock()
        template = mujoco.MjData(model)
        self._shapes = {
            name: np.shape(getattr(template, name)) for name in (*_STATE_FIELDS, *derived_fields)
        }

    def step(self, state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        return self._unpack(self._call(self._host_step, state, ctrl))

    def forward(self, state: PhysicsState, where: jax.Array) -> PhysicsState:
        result = self._unpack(self._call(self._host_forward, state, where[None]))
        # mj_forward leaves its solution as the next warm start; a fresh episode starts without.
        return result.replace(qacc_warmstart=state.qacc_warmstart)

    def _call(
        self,
        host_function: Callable[[np.ndarray], np.ndarray],
        state: PhysicsState,
        argument: jax.Array,
    ) -> jax.Array:
        row = jnp.concatenate([*(getattr(state, name) for name in _STATE_FIELDS), argument])
        width = sum(math.prod(shape) for shape in self._shapes.values())
        result = jax.ShapeDtypeStruct((width,), row.dtype)
        return jax.pure_callback(host_function, result, row, vmap_method="broadcast_all")

    def _unpack(self, row: jax.Array) -> PhysicsState:
        fields, start = {}, 0
        for name, shape in self._shapes.items():
            stop = start + math.prod(shape)
            fields[name] = row[start:stop].reshape(shape)
            start = stop
        state = {name: fields.pop(name) for name in _STATE_FIELDS}
        return PhysicsState(**state, derived=fields)

    def _host_step(self, rows: np.ndarray) -> np.ndarray:
        rows = np.asarray(rows)
        with self._lent_lane(math.prod(rows.shape[:-1])) as lane:
            lane.ctrl[:] = lane.load(rows)
            lane.batch.step(nstep=self.frame_skip)
            return lane.read(rows)

    def _host_forward(self, rows: np.ndarray) -> np.ndarray:
        rows = np.asarray(rows)
        with self._lent_lane(math.prod(rows.shape[:-1])) as lane:
            where = lane.load(rows)
            lane.ctrl[:] = 0.0
            ids = np.flatnonzero(where)
            if ids.size:
                lane.batch.forward(ids=ids)
            return lane.read(rows)

    @contextlib.contextmanager
    def _lent_lane(self, num_scenes: int) -> Iterator["_Lane"]:
        with self._lock:
            idle = self._idle[num_scenes]
            lane = idle.pop() if idle else None
        if lane is None:
            num_threads = min(self.num_threads, num_scenes)
            batch = mujoco_batch.Batch(self.model, num_scenes, num_threads)
            lane = _Lane(batch, tuple(self._shapes))
        try:
            yield lane
        finally:
            with self._lock:
                self._idle[num_scenes].append(lane)


class _Lane:
    """A batch with its arrays bound once, since binding costs more than copying."""

    def __init__(self, batch: mujoco_batch.Batch, names: tuple[str, ...]):
        self.batch = batch
        self.ctrl = batch.bind("ctrl")
        bound = {name: batch.bind(name) for name in names}
        self._inputs = _columns({name: bound[name] for name in _STATE_FIELDS})
        self._outputs = _columns(bound)

    def load(self, rows: np.ndarray) -> np.ndarray:
        """Writes the state; returns the columns behind it."""
        rows = rows.reshape(self.batch.nsim, -1)
        for array, columns in self._inputs:
            array[:] = rows[:, columns]
        return rows[:, self._inputs[-1][1].stop :]

    def read(self, like: np.ndarray) -> np.ndarray:
        """Copies state and derived fields into new rows with the leading axes of `like`."""
        width = self._outputs[-1][1].stop
        rows = np.empty((self.batch.nsim, width), like.dtype)
        for array, columns in self._outputs:
            rows[:, columns] = array.reshape(self.batch.nsim, -1)
        return rows.reshape(*like.shape[:-1], width)


def _columns(arrays: dict[str, np.ndarray]) -> list[tuple[np.ndarray, slice]]:
    stops = np.cumsum([math.prod(array.shape[1:]) for array in arrays.values()])
    starts = np.concatenate([[0], stops[:-1]])
    return [(a, slice(i, j)) for a, i, j in zip(arrays.values(), starts, stops, strict=True)]
