"""Episodes: time limit, action noise and true resets around an environment."""

import jax
import jax.numpy as jnp
from brax.envs import base

from represent_jax.types import Transition


class Episode(base.Env):
    """Runs an environment in episodes, keeping what a learned reward needs.

    Three things differ from Brax's own wrappers. The observation after the last step of an
    episode is kept (`info["next_obs"]`) although `obs` already belongs to the next episode;
    every reset draws a new initial state; and the noise level eta is part of the state, so that
    noise levels are one vmapped axis.

    The state's `info` holds: `key`; `steps`, environment steps since the reset; `noise_level`;
    and of the last step `executed_action`, `next_obs`, `terminated`, `truncated`.

    Attributes:
      env: the environment inside.
      horizon: steps after which an episode is cut off.
      auto_reset: whether a new episode follows at once; without it the caller masks.
      noise_size: random actions are uniform in [-noise_size, noise_size].
    """

    def __init__(
        self,
        env: base.Env,
        horizon: int | None = None,
        auto_reset: bool = True,
        noise_size: float = 1.0,
    ):
        self.env = env
        self.noise_size = noise_size
        self.horizon = env.horizon if horizon is None else horizon
        self.auto_reset = auto_reset

    @property
    def terminates(self) -> bool:
        """Whether episodes can end before the horizon."""
        return self.env.terminates

    @property
    def observation_size(self) -> int:
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return self.env.backend

    @property
    def unwrapped(self) -> base.Env:
        return self.env.unwrapped

    def reset(self, rng: jax.Array, noise_level: jax.Array | float = 0.0) -> base.State:
        """Starts an episode in which actions are replaced with probability `noise_level`."""
        key_reset, key = jax.random.split(rng)
        state = self.env.reset(key_reset)
        info = {
            "key": key,
            "steps": jnp.zeros((), jnp.int32),
            "noise_level": jnp.asarray(noise_level, jnp.float32),
            "executed_action": jnp.zeros(self.action_size),
            "next_obs": state.obs,
            "terminated": jnp.zeros((), bool),
            "truncated": jnp.zeros((), bool),
        }
        return state.replace(info=state.info | info)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        key, key_replace, key_uniform, key_reset = jax.random.split(state.info["key"], 4)
        noise_level = state.info["noise_level"]
        executed = jnp.where(
            jax.random.uniform(key_replace) < noise_level,
            self.noise_size
            * jax.random.uniform(key_uniform, action.shape, minval=-1.0, maxval=1.0),
            action,
        )
        after = self.env.step(state, executed)
        steps = state.info["steps"] + 1
        terminated = after.done.astype(bool)
        truncated = (steps >= self.horizon) & ~terminated
        done = terminated | truncated
        info = {
            "key": key,
            "steps": steps,
            "noise_level": noise_level,
            "executed_action": executed,
            "next_obs": after.obs,
            "terminated": terminated,
            "truncated": truncated,
        }
        info = after.info | info
        after = after.replace(done=done.astype(jnp.float32), info=info)
        if not self.auto_reset:
            return after
        fresh = self.env.reset(key_reset, done)
        physics, obs = jax.tree.map(
            lambda new, old: jnp.where(done, new, old),
            (fresh.pipeline_state, fresh.obs),
            (after.pipeline_state, after.obs),
        )
        return after.replace(
            pipeline_state=physics,
            obs=obs,
            info=info | {"steps": jnp.where(done, 0, steps)},
        )


def transition_of(before: base.State, after: base.State) -> Transition:
    """Reads the transition between two successive states of an `Episode`."""
    info = after.info
    return Transition(
        obs_t=before.obs,
        action_t=info["executed_action"],
        next_obs_t=info["next_obs"],
        reward_t=after.reward,
        discount_t=1.0 - info["terminated"].astype(jnp.float32),
        noise_level_t=info["noise_level"],
    )
