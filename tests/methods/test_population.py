"""Members side by side or under one vmap: the same results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from represent_jax.errors import UsageError
from represent_jax.methods.population import Population


@struct.dataclass
class _State:
    value: jax.Array
    count: jax.Array


def _axes(state):
    return _State(value=0, count=None)


def _run(mode):
    population = Population([jnp.float32(1.0), jnp.float32(10.0)], mode, _axes)

    def init(key, step_size):
        return _State(jax.random.normal(key, (3,)) * step_size, jnp.zeros((), jnp.int32))

    def step(state, step_size):
        state = _State(state.value + step_size, state.count + 1)
        return state, {"mean": jnp.mean(state.value)}

    states = population.init(init, jax.random.PRNGKey(0))
    shapes = jax.tree.map(lambda x: (x.shape, x.dtype), states)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), population.example(init)) == shapes
    stepper = population.stepper(step)
    for _ in range(3):
        states, metrics = stepper(states)
    return population.members(states), metrics


def test_threads_and_vmap_agree_and_counters_stay_shared():
    threads, metrics_threads = _run("threads")
    vmapped, metrics_vmap = _run("vmap")
    for a, b in zip(threads, vmapped, strict=True):
        np.testing.assert_allclose(a.value, b.value, rtol=1e-6)
        assert int(a.count) == int(b.count) == 3 and b.count.shape == ()
    np.testing.assert_allclose(metrics_threads["mean"], metrics_vmap["mean"], rtol=1e-6)


def test_one_member_runs():
    population = Population([jnp.float32(2.0)], "threads")
    states = population.init(lambda key, x: x, jax.random.PRNGKey(0))
    states, metrics = population.stepper(lambda state, x: (state * x, {"x": x}))(states)
    assert float(states[0]) == 4.0 and metrics["x"].shape == (1,)


def test_unknown_mode_is_refused():
    with pytest.raises(UsageError, match=r"threads"):
        Population([], "thread")
