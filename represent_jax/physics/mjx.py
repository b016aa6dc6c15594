"""MuJoCo XLA: the engine for accelerators, pure JAX and differentiable."""

import copy
import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
from jax.flatten_util import ravel_pytree
from mujoco import mjx

from represent_jax.physics.engine import Engine, PhysicsState


@dataclasses.dataclass(frozen=True)
class MjxSolver:
    """Constraint solver settings, traded between speed and the error against C MuJoCo.

    Attributes:
      iterations: Newton iterations for each substep.
      ls_iterations: line search iterations for each Newton iteration.
    """

    iterations: int = 4
    ls_iterations: int = 8


class MjxEngine(Engine):
    """Steps scenes with `mjx.step`, inside XLA.

    A step can be differentiated in both modes, any number of solver iterations notwithstanding.
    """

    name = "mjx"

    def __init__(
        self,
        model: mujoco.MjModel,
        frame_skip: int,
        derived_fields: tuple[str, ...] = (),
        solver: MjxSolver | None = None,
    ):
        super().__init__(model, frame_skip, derived_fields)
        solver = solver or MjxSolver()
        model = copy.copy(model)
        model.opt.iterations = solver.iterations
        model.opt.ls_iterations = solver.ls_iterations
        with jax.ensure_compile_time_eval():
            self._mjx_model = mjx.put_model(model, impl="jax")
            self._template = mjx.make_data(model, impl="jax")

    def step(self, state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        return _with_forward_jacobian(self._step)(state, ctrl)

    def forward(self, state: PhysicsState, where: jax.Array) -> PhysicsState:
        del where  # a masked lane costs the same under vmap
        return _with_forward_jacobian(self._forward)(state)

    def _step(self, state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        data = self._load(state).replace(ctrl=ctrl)
        data, _ = jax.lax.scan(
            lambda data, _: (mjx.step(self._mjx_model, data), None),
            data,
            None,
            length=self.frame_skip,
        )
        return self._read(data)

    def _forward(self, state: PhysicsState) -> PhysicsState:
        result = self._read(mjx.forward(self._mjx_model, self._load(state)))
        return result.replace(qacc_warmstart=state.qacc_warmstart)

    def _load(self, state: PhysicsState) -> mjx.Data:
        return self._template.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            act=state.act,
            qacc_warmstart=state.qacc_warmstart,
        )

    def _read(self, data: mjx.Data) -> PhysicsState:
        return PhysicsState(
            qpos=data.qpos,
            qvel=data.qvel,
            act=data.act,
            qacc_warmstart=data.qacc_warmstart,
            derived={name: jnp.asarray(getattr(data, name)) for name in self.derived_fields},
        )


def _with_forward_jacobian(function: Callable) -> Callable:
    """Makes a function differentiable in reverse that JAX can differentiate forward only.

    The solver loops until it has converged, and such a loop has no transpose. The state is small,
    so the whole Jacobian is computed forward; a product with it can then be transposed.
    """
    differentiable = jax.custom_jvp(function)

    @differentiable.defjvp
    def product(primals, tangents):
        point, unravel = ravel_pytree(primals)
        direction, _ = ravel_pytree(tangents)
        along = functools.partial(jax.jvp, lambda x: function(*unravel(x)), (point,))
        basis = jnp.eye(point.size, dtype=point.dtype)
        value, jacobian = jax.vmap(lambda e: along((e,)), out_axes=(None, -1))(basis)
        return value, jax.tree.map(lambda j: j @ direction, jacobian)

    return differentiable
