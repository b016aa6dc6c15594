"""The two engines on a small scene: transformations, threads, structure, gradients."""

import functools
import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from represent_jax.errors import UsageError
from represent_jax.physics import BACKENDS, PhysicsState, make_engine, resolve_backend
from represent_jax.physics.mjx import MjxEngine, MjxSolver
from represent_jax.physics.mujoco import MujocoEngine

# A cart between two stops with a pole on it: the stops are constraints, so the solver has work.
CART = """
<mujoco>
  <option timestep="0.01"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body>
      <joint name="slide" type="slide" axis="1 0 0" limited="true" range="-0.2 0.2" margin="0.02"/>
      <geom type="sphere" size="0.1" mass="1"/>
      <body>
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.2"/>
        <site name="tip" pos="0 0 0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slide" gear="20" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
MODEL = mujoco.MjModel.from_xml_string(CART)
FRAME_SKIP = 3
FIELDS = ("site_xpos", "qfrc_constraint")


@pytest.fixture(scope="module", params=["mujoco", "mjx"])
def engine(request):
    return make_engine(request.param, MODEL, FRAME_SKIP, FIELDS, MjxSolver(4, 8))


@functools.cache
def compiled(engine):
    """MJX compiles for seconds, so tests share two programs: start and step of many scenes."""
    return jax.jit(jax.vmap(engine.init)), jax.jit(jax.vmap(engine.step))


def scenes(engine, num=6):
    """Random states and controls; some of the carts are at a stop."""
    rng = np.random.default_rng(0)
    qpos = jnp.asarray(rng.uniform(-0.3, 0.3, (num, 2)), jnp.float32)
    qvel = jnp.asarray(rng.normal(size=(num, 2)), jnp.float32)
    ctrl = jnp.asarray(rng.uniform(-1, 1, (num, 1)), jnp.float32)
    init, _ = compiled(engine)
    return init(qpos, qvel), ctrl


def row(tree, i):
    return jax.tree.map(lambda x: x[i], tree)


def assert_trees_close(actual, expected, **tolerance):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **tolerance), actual, expected)


def test_init_fills_derived_fields_at_the_state(engine):
    state, _ = scenes(engine)
    for i in range(6):
        data = mujoco.MjData(MODEL)
        data.qpos[:], data.qvel[:] = state.qpos[i], state.qvel[i]
        mujoco.mj_forward(MODEL, data)
        expected = {"site_xpos": data.site_xpos, "qfrc_constraint": data.qfrc_constraint}
        assert_trees_close(row(state, i).derived, expected, rtol=1e-4, atol=1e-4)
    assert np.any(np.abs(state.derived["qfrc_constraint"]) > 1.0)
    assert not np.any(state.qacc_warmstart)


def test_step_is_mj_step(engine):
    state, ctrl = scenes(engine)
    _, step = compiled(engine)
    after = step(state, ctrl)
    for i in range(6):
        data = mujoco.MjData(MODEL)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state.qpos[i], state.qvel[i], ctrl[i]
        mujoco.mj_step(MODEL, data, nstep=FRAME_SKIP)
        actual = row(after, i)
        expected = (data.qpos, data.qvel, {n: getattr(data, n) for n in FIELDS})
        actual = (actual.qpos, actual.qvel, actual.derived)
        assert_trees_close(actual, expected, rtol=1e-4, atol=1e-3)
    assert engine.dt == pytest.approx(0.03)


def test_jit_agrees_with_no_jit(engine):
    state, ctrl = scenes(engine)
    _, step = compiled(engine)
    eager = engine.step(row(state, 0), ctrl[0])
    assert_trees_close(row(step(state, ctrl), 0), eager, rtol=1e-4, atol=1e-4)


def test_scan_and_nested_vmap_agree_with_a_loop(engine):
    state, ctrl = scenes(engine)
    _, step = compiled(engine)
    looped = state
    for _ in range(4):
        looped = step(looped, ctrl)
    nested_step = jax.vmap(jax.vmap(engine.step))
    state, ctrl = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), (state, ctrl))
    nested, _ = jax.jit(
        lambda state: jax.lax.scan(lambda s, _: (nested_step(s, ctrl), None), state, length=4)
    )(state)
    assert nested.derived["site_xpos"].shape == (2, 3, 1, 3)
    nested = jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), nested)
    assert_trees_close(nested, looped, rtol=1e-4, atol=1e-3)


@pytest.fixture
def host_engine():
    return MujocoEngine(MODEL, FRAME_SKIP, FIELDS)


def test_vmap_over_one_argument(host_engine):
    """Controls that all scenes share, and scenes that share a state."""
    engine = host_engine
    state, ctrl = scenes(engine)
    shared_control = jax.jit(jax.vmap(engine.step, in_axes=(0, None)))(state, ctrl[1])
    shared_state = jax.jit(jax.vmap(engine.step, in_axes=(None, 0)))(row(state, 1), ctrl)
    expected = jax.jit(engine.step)(row(state, 1), ctrl[1])
    assert_trees_close(row(shared_control, 1), expected, rtol=0)
    assert_trees_close(row(shared_state, 1), expected, rtol=0)


def test_masked_forward_serves_the_rows_asked_for(host_engine):
    state, _ = scenes(host_engine)
    moved = state.replace(qpos=state.qpos + 0.01, qacc_warmstart=state.qvel)
    where = jnp.arange(6) % 2 == 0
    forward = jax.jit(jax.vmap(host_engine.forward))
    masked, whole = forward(moved, where), forward(moved, jnp.ones(6, bool))
    assert_trees_close(row(masked, where), row(whole, where), rtol=0)
    for name in ("qpos", "qvel", "qacc_warmstart"):
        np.testing.assert_array_equal(getattr(masked, name), getattr(moved, name))


def test_masked_forward_skips_the_rest(host_engine):
    state, _ = scenes(host_engine)
    asked = []

    class Counting:
        def __init__(self, batch):
            self.batch, self.nsim = batch, batch.nsim

        def forward(self, ids):
            asked.append(ids.tolist())
            self.batch.forward(ids=ids)

    (lane,) = host_engine._idle[6]
    lane.batch = Counting(lane.batch)
    for where in ([False, True, True, False, False, False], [False] * 6):
        jax.block_until_ready(jax.vmap(host_engine.forward)(state, jnp.array(where)))
    assert asked == [[1, 2]]


def test_states_of_both_engines_have_one_structure():
    states = []
    for engine in (MujocoEngine(MODEL, 1, FIELDS), MjxEngine(MODEL, 1, FIELDS)):
        state = jax.eval_shape(engine.init, jnp.zeros(2), jnp.zeros(2))
        states += [state, jax.eval_shape(engine.step, state, jnp.zeros(1))]
    for state in states:
        assert jax.tree.structure(state) == jax.tree.structure(states[0])
        assert jax.tree.leaves(state) == jax.tree.leaves(states[0])


@pytest.mark.parametrize("num_scenes", [(8, 8), (8, 3), (4096, 4096)])
def test_two_programs_at_once(host_engine, num_scenes):
    """The same engine in two compiled programs; large batches cross over by another route."""
    engine = host_engine
    num_steps = 10
    programs, expected = [], []
    for i, n in enumerate(num_scenes):
        state, ctrl = scenes(engine, n)

        @jax.jit
        def program(state, ctrl, sign=1.0 - 2.0 * i):
            body = lambda s, _: (jax.vmap(engine.step)(s, sign * ctrl), None)  # noqa: E731
            return jax.lax.scan(body, state, None, length=num_steps)[0]

        programs.append((program, state, ctrl))
        expected.append(jax.block_until_ready(program(state, ctrl)))

    results = [[], []]

    def work(i):
        program, state, ctrl = programs[i]
        for _ in range(3):
            results[i].append(jax.block_until_ready(program(state, ctrl)))

    threads = [threading.Thread(target=work, args=(i,), daemon=True) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
        assert not thread.is_alive(), "two programs wait for each other"
    for i in range(2):
        for result in results[i]:
            assert_trees_close(result, expected[i], rtol=0)


def test_thread_count_changes_nothing():
    state, ctrl = scenes(MujocoEngine(MODEL, FRAME_SKIP, FIELDS), 16)
    one, four = (
        jax.jit(jax.vmap(MujocoEngine(MODEL, FRAME_SKIP, FIELDS, num_threads=n).step))(state, ctrl)
        for n in (1, 4)
    )
    assert_trees_close(one, four, rtol=0)


def test_gradients_through_mjx():
    """Against central differences, across a stop, with more than one solver iteration."""
    engine = MjxEngine(MODEL, FRAME_SKIP, FIELDS, MjxSolver(4, 8))
    zero = jnp.zeros(2)
    derived = {"site_xpos": jnp.zeros((1, 3)), "qfrc_constraint": zero}

    def tip(ctrl, shift):
        qpos = jnp.array([0.21, 0.3]) + shift
        start = PhysicsState(qpos, zero, jnp.zeros(0), zero, derived)
        after, _ = jax.lax.scan(lambda s, c: (engine.step(s, c), None), start, ctrl)
        return after.derived["site_xpos"][0, 0] + after.qvel[0]

    ctrl, shift = 0.3 * jnp.ones((2, 1)), jnp.zeros(2)
    value_and_grad = jax.jit(jax.value_and_grad(tip, argnums=(0, 1)))
    _, gradients = value_and_grad(ctrl, shift)
    value = lambda *arguments: value_and_grad(*arguments)[0]  # noqa: E731
    eps = 1e-3
    for i in range(2):
        up, down = ctrl.at[i, 0].add(eps), ctrl.at[i, 0].add(-eps)
        expected = (value(up, shift) - value(down, shift)) / (2 * eps)
        np.testing.assert_allclose(gradients[0][i, 0], expected, rtol=2e-2, atol=2e-3)
        up, down = shift.at[i].add(eps), shift.at[i].add(-eps)
        expected = (value(ctrl, up) - value(ctrl, down)) / (2 * eps)
        np.testing.assert_allclose(gradients[1][i], expected, rtol=2e-2, atol=2e-3)
    assert all(np.all(np.isfinite(g)) and np.any(g != 0.0) for g in gradients)


def test_unknown_backend_names_the_nearest():
    with pytest.raises(UsageError, match=r"unknown backend 'mojoco'.*mujoco"):
        make_engine("mojoco", MODEL, 1)
    assert resolve_backend("mjx") == "mjx"


def test_auto_goes_by_platform(monkeypatch):
    assert "auto" in BACKENDS
    for platform, backend in (("cpu", "mujoco"), ("gpu", "mjx"), ("tpu", "mjx")):
        monkeypatch.setattr(jax, "default_backend", lambda platform=platform: platform)
        assert resolve_backend("auto") == backend
