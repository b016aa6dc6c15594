"""A task on an engine, as a Brax environment."""

import jax
import jax.numpy as jnp
from brax.envs import base

from represent_jax.envs.task import Task
from represent_jax.physics.engine import Engine


class Environment(base.Env):
    """Steps one task with one engine; no time limit, no auto-reset, no noise (see `Episode`).

    Actions are in [-1, 1] and are mapped linearly onto the actuators' control ranges, which for
    Gym's tasks is the identity, unless the task has a control law of its own.

    Where the task has observation noise, the state's `info` holds `noise_key`.

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
        return self.task.action_dim or self.engine.model.nu

    @property
    def backend(self) -> str:
        return self.engine.name

    def outcomes(self, obs: jax.Array) -> dict[str, jax.Array]:
        """What episodes came to beside their reward, see `Task.outcomes`."""
        return self.task.outcomes(obs)

    def reset(self, rng: jax.Array, where: jax.Array | bool = True) -> base.State:
        """Draws an initial state; `where` says whether the result will be used."""
        qpos, qvel = self.task.reset(rng, self._init_qpos)
        physics = self.engine.init(qpos, qvel, where)
        zero = jnp.zeros(())
        info = {}
        if self.task.observation_noise is not None:
            # Drawn aside, so that with and without noise episodes begin alike.
            info["noise_key"] = jax.random.fold_in(rng, 1)
        return self._observe(base.State(physics, zero, zero, zero, info=info))

    def step(self, state: base.State, action: jax.Array) -> base.State:
        before = state.pipeline_state
        ctrl = self.task.control(state.obs, action, self._ctrl_center, self._ctrl_scale)
        after = self.engine.step(before, ctrl)
        reward = self.task.reward(before, action, after, self.engine.dt)
        done = self.task.terminated(after) if self.terminates else jnp.zeros((), bool)
        state = state.replace(
            pipeline_state=after,
            reward=reward,
            done=done.astype(jnp.float32),
        )
        return self._observe(state)

    def _observe(self, state: base.State) -> base.State:
        obs = self.task.observe(state.pipeline_state)
        if self.task.observation_noise is None:
            return state.replace(obs=obs)
        key, key_noise = jax.random.split(state.info["noise_key"])
        noise = jax.random.uniform(key_noise, obs.shape, minval=-1.0, maxval=1.0)
        obs = obs + jnp.asarray(self.task.observation_noise, jnp.float32) * noise
        return state.replace(obs=obs, info=state.info | {"noise_key": key})
