"""The interface that both physics engines fulfil."""

import abc

import jax
import jax.numpy as jnp
import mujoco
from flax import struct


@struct.dataclass
class PhysicsState:
    """Everything the next step depends on, and what a task may look at.

    Attributes:
      qpos: generalised positions, `[..., nq]`.
      qvel: generalised velocities, `[..., nv]`.
      act: actuator activations, `[..., na]`.
      qacc_warmstart: the constraint solver's starting point, `[..., nv]`.
      derived: fields of `mujoco.MjData` the task asked for by name, as the engine left them
        after its last forward pass (one substep behind `qpos`, as in Gymnasium).
    """

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    qacc_warmstart: jax.Array
    derived: dict[str, jax.Array]


class Engine(abc.ABC):
    """Steps one scene; batches are made by `jax.vmap`.

    Attributes:
      model: the compiled scene.
      frame_skip: physics substeps for each environment step.
      derived_fields: names of `mujoco.MjData` fields kept in `PhysicsState.derived`.
    """

    name: str

    def __init__(self, model: mujoco.MjModel, frame_skip: int, derived_fields: tuple[str, ...]):
        self.model = model
        self.frame_skip = frame_skip
        self.derived_fields = derived_fields

    @property
    def dt(self) -> float:
        """Seconds of simulated time in one environment step."""
        return float(self.model.opt.timestep * self.frame_skip)

    def init(
        self, qpos: jax.Array, qvel: jax.Array, where: jax.Array | bool = True
    ) -> PhysicsState:
        """Returns the state at rest in the solver at the given positions and velocities.

        Args:
          qpos: `[nq]`.
          qvel: `[nv]`.
          where: `[]`, whether the result will be used; engines may skip the work otherwise.
        """
        state = PhysicsState(
            qpos=qpos,
            qvel=qvel,
            act=jnp.zeros(self.model.na),
            qacc_warmstart=jnp.zeros(self.model.nv),
            derived={},
        )
        if not self.derived_fields:
            return state
        return self.forward(state, jnp.asarray(where))

    @abc.abstractmethod
    def forward(self, state: PhysicsState, where: jax.Array) -> PhysicsState:
        """Fills `derived` at the state itself, as MuJoCo's `mj_forward` does."""

    @abc.abstractmethod
    def step(self, state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        """Advances by `frame_skip` substeps under the control `ctrl`, `[nu]`."""
