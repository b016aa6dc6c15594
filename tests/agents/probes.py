"""Environments so small that the value of every state is known.

After Andy Jones, "Debugging RL, Without the Agonizing Pain": each probe needs one more part of an
agent to work than the one before it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import base

from represent_jax.envs.episode import Episode

DISCOUNT = 0.8
HORIZON = 2
NEVER = 1_000


class Probe(NamedTuple):
    """What a probe is made of; arrays with one leading axis are a population of probes.

    The observation is a position x. A step pays

      constant + slope * x - penalty * (a - target)^2

    with the target at x / 2 or at 1 / 2, and moves x up by `drift`, to at most 1.

    Attributes:
      target_follows_x: whether the best action is x / 2.
      random_start: whether an episode starts at -1 or 1, each as likely; else at 0.
      lifetime: steps after which an episode terminates.
    """

    constant: float = 0.0
    slope: float = 0.0
    penalty: float = 0.0
    target_follows_x: bool = False
    drift: float = 0.0
    random_start: bool = False
    lifetime: int = 1


PROBES = {
    "constant": Probe(constant=1.0),
    "observed": Probe(slope=1.0, random_start=True),
    "delayed": Probe(slope=1.0, drift=1.0, lifetime=2),
    "endless": Probe(slope=1.0, drift=1.0, lifetime=NEVER),
    "action": Probe(constant=1.0, penalty=1.0),
    "action_observed": Probe(constant=1.0, penalty=1.0, target_follows_x=True, random_start=True),
}

# Every episode is 0, 1, 1 and cut off there; rewards depend on actions.
WORLD = Probe(slope=1.0, penalty=1.0, drift=1.0, lifetime=NEVER)

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


def reward(probe: Probe, obs_t: jax.Array, action_t: jax.Array, next_obs_t: jax.Array) -> jax.Array:
    """What a step pays, as a RewardFn whose parameters are the probe, `[...]`."""
    del next_obs_t
    x, a = obs_t[..., 0], action_t[..., 0]
    target = 0.5 * jnp.where(probe.target_follows_x, x, 1.0)
    return probe.constant + probe.slope * x - probe.penalty * jnp.square(a - target)


class ProbeEnv(base.Env):
    """Plays one probe, without a time limit.

    Attributes:
      probe: the probe; its fields may be traced.
      num_traces: how often `step` was called, which is how often it was traced under jit.
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


def episode(probe: Probe = WORLD, auto_reset: bool = True) -> Episode:
    """Makes episodes of one probe."""
    return Episode(ProbeEnv(probe), auto_reset=auto_reset)


def train_all(agent, config, num_steps: int, key: jax.Array) -> dict:
    """Trains an agent on every probe, as one population, and returns the learners by name."""

    def member(probe, key):
        env = episode(probe)
        state, _ = agent.train(agent.init(key, env, config), env, config, num_steps)
        return state.learner

    population = jax.tree.map(lambda *leaves: jnp.asarray(leaves), *PROBES.values())
    learners = jax.jit(jax.vmap(member))(population, jax.random.split(key, len(PROBES)))
    return {name: take(learners, i) for i, name in enumerate(PROBES)}


def take(tree, i: int):
    """Reads one member of a population."""
    return jax.tree.map(lambda leaf: leaf[i], tree)


def assert_equal(actual, expected) -> None:
    """Asserts that two pytrees are the same, bit for bit."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


def assert_close(actual, expected, tolerance: float = 1e-5) -> None:
    """Asserts that two pytrees are the same up to rounding."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)
