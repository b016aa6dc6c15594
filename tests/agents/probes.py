"""Environments so small that the value of every state is known.

After Andy Jones, "Debugging RL, Without the Agonizing Pain": each probe needs one more part of an
agent to work than the one before it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from brax.envs import base

DISCOUNT = 0.8
HORIZON = 2


class Probe(NamedTuple):
    """What a probe is made of; arrays with one leading axis are a population of probes.

    The observation is a position x. A step pays

      constant + slope * x - (a - target * (x if `target_follows_x` else 1))^2 * penalty

    and moves x up by `drift`, to at most 1.

    Attributes:
      random_start: whether an episode starts at -1 or 1, each as likely; else at 0.
      lifetime: steps after which an episode terminates.
    """

    constant: float = 0.0
    slope: float = 0.0
    penalty: float = 0.0
    target: float = 0.5
    target_follows_x: bool = False
    drift: float = 0.0
    random_start: bool = False
    lifetime: int = 1


NEVER = 1_000
PROBES = {
    "constant": Probe(constant=1.0),
    "observed": Probe(slope=1.0, random_start=True),
    "delayed": Probe(slope=1.0, drift=1.0, lifetime=2),
    "endless": Probe(slope=1.0, drift=1.0, lifetime=NEVER),
    "action": Probe(constant=1.0, penalty=1.0),
    "action_observed": Probe(constant=1.0, penalty=1.0, target_follows_x=True, random_start=True),
}

# Of the best policy: (probe, x, V(x)). Only true final observations give those of "endless": its
# episodes are cut off after the first step at x = 1, and the next one starts at x = 0.
VALUES = [
    ("constant", 0.0, 1.0),
    ("observed", -1.0, -1.0),
    ("observed", 1.0, 1.0),
    ("delayed", 1.0, 1.0),
    ("delayed", 0.0, DISCOUNT),
    ("endless", 1.0, 1.0 / (1.0 - DISCOUNT)),
    ("endless", 0.0, DISCOUNT / (1.0 - DISCOUNT)),
    ("action", 0.0, 1.0),
    ("action_observed", -1.0, 1.0),
    ("action_observed", 1.0, 1.0),
]

# Best actions: (probe, x, a).
ACTIONS = [
    ("action", 0.0, 0.5),
    ("action_observed", -1.0, -0.5),
    ("action_observed", 1.0, 0.5),
]


def stack(probes) -> Probe:
    """Puts probes into one population."""
    return jax.tree.map(lambda *leaves: jnp.asarray(leaves), *probes)


def reward(probe: Probe, obs_t: jax.Array, action_t: jax.Array, next_obs_t: jax.Array):
    """What a step pays, as a RewardFn whose parameters are the probe, `[...]`."""
    del next_obs_t
    x, a = obs_t[..., 0], action_t[..., 0]
    target = probe.target * jnp.where(probe.target_follows_x, x, 1.0)
    return probe.constant + probe.slope * x - probe.penalty * jnp.square(a - target)


class ProbeEnv(base.Env):
    """Plays one probe, without a time limit.

    Attributes:
      probe: the probe; its fields may be traced.
      num_traces: how often `step` was traced (or called).
    """

    observation_size = 1
    action_size = 1
    backend = "probe"
    horizon = HORIZON

    def __init__(self, probe: Probe):
        self.probe = probe
        self.num_traces = 0

    def reset(self, rng: jax.Array, where: jax.Array | bool = True) -> base.State:
        del where
        sign = jax.random.rademacher(rng, (1,), jnp.float32)
        obs = jnp.where(self.probe.random_start, sign, 0.0)
        zero = jnp.zeros(())
        return base.State({"age": jnp.zeros((), jnp.int32)}, obs, zero, zero)

    def step(self, state: base.State, action: jax.Array) -> base.State:
        self.num_traces += 1
        age = state.pipeline_state["age"] + 1
        next_obs = jnp.minimum(state.obs + self.probe.drift, 1.0)
        return state.replace(
            pipeline_state={"age": age},
            obs=next_obs,
            reward=reward(self.probe, state.obs, action, next_obs),
            done=(age >= self.probe.lifetime).astype(jnp.float32),
        )
