"""What a robot task is, without a word about how its physics is stepped."""

import abc
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from represent_jax.envs.keyboard import Keyboard
from represent_jax.physics.engine import PhysicsState
from represent_jax.physics.mjx import MjxSolver


class Task(abc.ABC):
    """One robot and what it is rewarded for: subclass this to add your own.

    All methods see a single scene; batches are made by `jax.vmap`.

    Attributes:
      name: the name by which the task is registered.
      frame_skip: physics substeps for each environment step.
      horizon: environment steps after which an episode is cut off.
      terminates: whether `terminated` ends episodes unless the user says otherwise.
      derived_fields: `mujoco.MjData` fields that observation, reward or termination look at.
      mjx_solver: solver settings of the `mjx` engine.
      action_dim: entries of an action; None where there is one for each actuator.
      observation_noise: half-width of the uniform noise on what is observed, `[obs_dim]`; None
        where there is none.
    """

    name: str
    frame_skip: int
    horizon: int = 1000
    terminates: bool = False
    derived_fields: tuple[str, ...] = ()
    mjx_solver: MjxSolver = MjxSolver()
    action_dim: int | None = None
    observation_noise: np.ndarray | None = None

    @abc.abstractmethod
    def load_model(self) -> mujoco.MjModel:
        """Compiles the scene."""

    def load_light_model(self) -> mujoco.MjModel:
        """Compiles the scene for engines that few and simple geoms suit; often the same.

        Where it is another, `backend="auto"` never picks such an engine.
        """
        return self.load_model()

    @property
    def has_light_model(self) -> bool:
        """Whether the light scene is another than the full one."""
        return type(self).load_light_model is not Task.load_light_model

    @abc.abstractmethod
    def reset(self, key: jax.Array, init_qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draws an initial state.

        Args:
          key: PRNG key.
          init_qpos: the model's reference positions, `[nq]`.

        Returns:
          Positions `[nq]` and velocities `[nv]`.
        """

    def control(
        self, obs_t: jax.Array, action_t: jax.Array, center: jax.Array, scale: jax.Array
    ) -> jax.Array:
        """Returns the actuators' control, `[nu]`; by default what the action says, linearly.

        Args:
          obs_t: what was observed before the step, noise included, `[obs_dim]`.
          action_t: in [-1, 1], `[action_dim]`.
          center, scale: the middle and half the width of the actuators' ranges, `[nu]`; 0 and 1
            where an actuator has none.
        """
        del obs_t
        return center + scale * action_t

    @abc.abstractmethod
    def observe(self, physics: PhysicsState) -> jax.Array:
        """Returns the observation, `[obs_dim]`."""

    @abc.abstractmethod
    def reward(
        self, before: PhysicsState, action_t: jax.Array, after: PhysicsState, dt: float
    ) -> jax.Array:
        """Returns the reward of one environment step of `dt` seconds, `[]`."""

    def terminated(self, physics: PhysicsState) -> jax.Array:
        """Returns whether the episode has failed or succeeded for good, `[]` bool."""
        del physics
        return jnp.zeros((), bool)

    def readings(self, physics: PhysicsState) -> dict[str, jax.Array]:
        """Returns figures that help a driver, each `[]`, by a name with its unit; often none."""
        del physics
        return {}

    def outcomes(self, obs: jax.Array) -> dict[str, jax.Array]:
        """Returns what an episode came to beside its reward, each `[...]`; often nothing.

        Args:
          obs: all observations of the episode, `[..., T + 1, obs_dim]`; past its end the last one
            is repeated.
        """
        del obs
        return {}

    def qpos_of(self, model: mujoco.MjModel, obs: np.ndarray, dt: float) -> np.ndarray | None:
        """Returns the positions behind an episode's observations; None where they do not tell.

        Demonstrations hold observations alone; this is what lets a video show them.

        Args:
          model: the scene they are to be shown in.
          obs: observations of successive steps, `[T, obs_dim]`.
          dt: seconds between two of them.

        Returns:
          Positions `[T, nq]`; a place that observations leave out begins at 0.
        """
        del model, obs, dt
        return None

    def keyboard(self, model: mujoco.MjModel) -> Keyboard | None:
        """Returns the keys that drive the robot; None where it can only be watched."""
        del model
        return None


def qpos_along_track(obs: np.ndarray, dt: float) -> np.ndarray:
    """Positions of a planar robot that observes qpos without its place x, then qvel.

    x, which neither observation nor policy knows of, is integrated from its velocity.

    Args:
      obs: observations of successive steps, `[T, 2 nq - 1]`.
      dt: seconds between two of them.
    """
    others = (obs.shape[1] - 1) // 2
    velocity = obs[:, others]
    moved = 0.5 * dt * (velocity[1:] + velocity[:-1])
    return np.column_stack([np.concatenate([[0.0], np.cumsum(moved)]), obs[:, :others]])


def load_gymnasium_model(file_name: str) -> mujoco.MjModel:
    """Compiles one of the MJCF files that the installed gymnasium ships."""
    folder = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    spec = mujoco.MjSpec.from_file(str(folder / file_name))
    # The attribute is deprecated and warns on every compilation; this is what it does.
    total_mass, spec.compiler.settotalmass = spec.compiler.settotalmass, -1
    model = spec.compile()
    if total_mass > 0:
        mujoco.mj_setTotalmass(model, total_mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
