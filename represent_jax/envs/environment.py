"""A task on an engine, as a Brax environment."""

import jax
import jax.numpy as jnp
from brax.envs import base

from represent_jax.envs.task import Task
from represent_jax.physics.engine import Engine


class Environment(base.Env):
    """Steps one task with one engine; no time limit, no auto-reset, no noise (see `Episode`).

    Actions are in [-1, 1] and are mapped linearly onto the actuators' control ranges, which for
    Gym's tasks is the identity.

    Attributes:
      task: the task.
      engine: the physics engine.
      terminates: whether the task's own termination ends an episode.
    """

    def __init__(self, task: Task, engine: Engine):
        self.task = task
        self.engine = engine
        model = engine.model
        self._init_qpos = jnp.asarray(model.qpos0, jnp.float32)
        low, high = model.actuator_ctrlrange.T
        limited = model.actuator_ctrllimited.astype(bool)
        self._ctrl_center = jnp.where(limited, 0.5 * (high + low), 0.0).astype(jnp.float32)
        self._ctrl_scale = jnp.where(limited, 0.5 * (high - low), 1.0).astype(jnp.float32)
        state = jax.eval_shape(self.reset, jax.ShapeDtypeStruct((2,), jnp.uint32))
        self._observation_size = state.obs.shape[-1]

    @property
    def name(self) -> str:
        """The task's name."""
        return self.task.name

    @property
    def terminates(self) -> bool:
        """Whether episodes can end before the horizon."""
        return self.task.terminates

    @property
    def horizon(self) -> int:
        """Environment steps after which an episode is cut off."""
        return self.task.horizon

    @property
    def observation_size(self) -> int:
        return self._observation_size

    @property
    def action_size(self) -> int:
        return self.engine.model.nu

    @property
    def backend(self) -> str:
        return self.engine.name

    def reset(self, rng: jax.Array, where: jax.Array | bool = True) -> base.State:
        """Draws an initial state; `where` says whether the result will be used."""
        qpos, qvel = self.task.reset(rng, self._init_qpos)
        physics = self.engine.init(qpos, qvel, where)
        zero = jnp.zeros(())
        return base.State(physics, self.task.observe(physics), zero, zero)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        before = state.pipeline_state
        after = self.engine.step(before, self._ctrl_center + self._ctrl_scale * action)
        reward = self.task.reward(before, action, after, self.engine.dt)
        done = self.task.terminated(after) if self.terminates else jnp.zeros((), bool)
        return state.replace(
            pipeline_state=after,
            obs=self.task.observe(after),
            reward=reward,
            done=done.astype(jnp.float32),
        )
