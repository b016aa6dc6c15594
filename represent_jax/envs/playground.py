"""Environments of MuJoCo Playground as they are, and any other of Brax's kind."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs import base

from represent_jax.config import require
from represent_jax.errors import UsageError, unknown
from represent_jax.physics import resolve_backend


class Adapted(base.Env):
    """An environment of another library as the methods here take it.

    The other environment's whole state (its physics, its `info`, its metrics) is the state's
    `pipeline_state`, so that a reset renews all of it, and nothing here can touch it.

    Attributes:
      env: the other environment: `reset(key)` and `step(state, action)` on states with `obs`,
        `reward` and `done`, and `action_size`. Actions are in [-1, 1] and handed on as they are.
      name: what it is called.
      horizon: environment steps after which an episode is cut off.
      terminates: whether its `done` ends episodes; if not it is ignored.
      backend: the physics engine that it runs on.
    """

    def __init__(
        self,
        env: Any,
        name: str,
        horizon: int,
        terminates: bool = True,
        backend: str = "mjx",
        obs_key: str = "state",
    ):
        """Looks at the shapes of a reset; `obs_key` names the observation where there are many.

        Raises:
          UsageError: it has several observations and none of that name, or one that is no vector.
        """
        self.env = env
        self.name = name
        self.horizon = horizon
        self.terminates = terminates
        self._backend = backend
        self._obs_key = obs_key
        self._example = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), jnp.uint32))
        obs = self._example.obs
        if isinstance(obs, Mapping):
            require(obs_key in obs, "obs_key", f"one of {', '.join(sorted(obs))}", obs_key)
        shape = self._seen(self._example).shape
        require(len(shape) == 1, "observation", "a vector", shape)
        self._observation_size = shape[0]

    @property
    def observation_size(self) -> int:
        return self._observation_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return self._backend

    def reset(self, rng: jax.Array, where: jax.Array | bool = True) -> base.State:
        """Draws an initial state; `where` is not used, since there is no way to skip a reset."""
        del where
        inner = self._typed(self.env.reset(rng))
        zero = jnp.zeros(())
        return base.State(inner, self._seen(inner), zero, zero)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        # Copied, since such environments write into the dictionaries of the state they are given.
        before = jax.tree.map(lambda x: x, state.pipeline_state)
        after = self._typed(self.env.step(before, action))
        done = after.done if self.terminates else jnp.zeros_like(after.done)
        return state.replace(
            pipeline_state=after,
            obs=self._seen(after),
            reward=after.reward.astype(jnp.float32),
            done=done.astype(jnp.float32),
        )

    def _seen(self, inner: Any) -> jax.Array:
        return inner.obs[self._obs_key] if isinstance(inner.obs, Mapping) else inner.obs

    def _typed(self, inner: Any) -> Any:
        """Gives every leaf the type it has after a reset, as a scan over steps needs it."""
        return jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), inner, self._example)


def make(name: str, backend: str = "auto", **options: Any) -> Adapted:
    """Makes an environment of MuJoCo Playground.

    Args:
      name: Playground's, such as "CartpoleBalance".
      backend: "mjx" or "auto": Playground has no other engine.
      **options: `horizon`, `terminates` and `obs_key` of `Adapted`; all else overrides Playground's
        own configuration, such as `sim_dt=0.005`.

    Raises:
      UsageError: Playground is not installed, knows no such environment, or refuses an option; or
        a backend that it does not have.
    """
    try:
        from mujoco_playground import dm_control_suite, registry
    except ImportError as error:
        raise UsageError(
            "environments of MuJoCo Playground need it installed: "
            "pip install 'represent_jax[playground]'"
        ) from error
    resolve_backend(backend)
    require(backend != "mujoco", "backend", "'mjx' or 'auto' for Playground", backend)
    if name not in registry.ALL_ENVS:
        raise unknown("environment of MuJoCo Playground", name, registry.ALL_ENVS)
    config = registry.get_default_config(name)
    adapted = {
        "horizon": int(config.episode_length),
        # Those of the control suite end early only where the physics has diverged.
        "terminates": name not in dm_control_suite.ALL_ENVS,
    }
    for key in ("horizon", "terminates", "obs_key"):
        if key in options:
            adapted[key] = options.pop(key)
    # Its own choice, Warp, needs an NVIDIA GPU to be quick; MJX's JAX runs everywhere.
    overrides = ({"impl": "jax"} if "impl" in config else {}) | options
    try:
        env = registry.load(name, config_overrides=overrides)
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"environment 'playground:{name}': {error}") from error
    return Adapted(env, f"playground:{name}", **adapted)
