"""The two engines on a small scene: transformations, threads, structure, gradients."""

import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from represent_jax.errors import UsageError
from represent_jax.physics import BACKENDS, make_engine, resolve_backend
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


def scenes(engine, *leading):
    """Random states and controls; a third of the carts are at a stop."""
    rng = np.random.default_rng(0)
    qpos = rng.uniform(-0.3, 0.3, (*leading, 2)).astype(np.float32)
    qvel = rng.normal(size=(*leading, 2)).astype(np.float32)
    init = engine.init
    for _ in leading:
        init = jax.vmap(init)
    return init(qpos, qvel), rng.uniform(-1, 1, (*leading, 1)).astype(np.float32)


def assert_trees_close(actual, expected, **tolerance):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **tolerance), actual, expected)


def test_step_is_mj_step(engine):
    state, ctrl = scenes(engine, 6)
    after = jax.jit(jax.vmap(engine.step))(state, ctrl)
    for i in range(6):
        data = mujoco.MjData(MODEL)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state.qpos[i], state.qvel[i], ctrl[i]
        mujoco.mj_step(MODEL, data, nstep=FRAME_SKIP)
        row = jax.tree.map(lambda x, i=i: x[i], after)
        expected = (data.qpos, data.qvel, data.site_xpos, data.qfrc_constraint)
        actual = (row.qpos, row.qvel, row.derived["site_xpos"], row.derived["qfrc_constraint"])
        assert_trees_close(actual, expected, rtol=1e-4, atol=1e-4)
    assert np.any(np.abs(after.derived["qfrc_constraint"]) > 1.0)
    assert engine.dt == pytest.approx(0.03)


def test_jit_agrees_with_no_jit(engine):
    state, ctrl = scenes(engine)
    assert_trees_close(jax.jit(engine.step)(state, ctrl), engine.step(state, ctrl), rtol=1e-5)


def test_scan_agrees_with_a_loop(engine):
    state, ctrl = scenes(engine, 4)
    step = jax.jit(jax.vmap(engine.step))
    looped = state
    for _ in range(5):
        looped = step(looped, ctrl)
    body = lambda s, _: (jax.vmap(engine.step)(s, ctrl), None)  # noqa: E731
    scanned, _ = jax.jit(lambda s: jax.lax.scan(body, s, None, length=5))(state)
    assert_trees_close(scanned, looped, rtol=1e-4, atol=1e-4)


def test_nested_vmap_agrees_with_flat(engine):
    state, ctrl = scenes(engine, 2, 3)
    nested = jax.jit(jax.vmap(jax.vmap(engine.step)))(state, ctrl)
    flat = jax.jit(jax.vmap(engine.step))(
        *jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), (state, ctrl))
    )
    assert_trees_close(
        jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), nested), flat, rtol=1e-5, atol=1e-5
    )
    assert nested.derived["site_xpos"].shape == (2, 3, 1, 3)


def test_vmap_over_states_alone(engine):
    """Controls that all scenes share, and scenes that share a state."""
    state, ctrl = scenes(engine, 3)
    step = jax.jit(jax.vmap(engine.step, in_axes=(0, None)))(state, ctrl[1])
    one = jax.tree.map(lambda x: x[1], state)
    shared = jax.jit(jax.vmap(engine.step, in_axes=(None, 0)))(one, ctrl)
    expected = jax.jit(engine.step)(one, ctrl[1])
    for batch in (step, shared):
        actual = jax.tree.map(lambda x: x[1], batch)
        assert_trees_close(actual, expected, rtol=1e-4, atol=1e-5)


def test_forward_fills_derived_fields_at_the_state(engine):
    state, _ = scenes(engine, 4)
    for i in range(4):
        data = mujoco.MjData(MODEL)
        data.qpos[:], data.qvel[:] = state.qpos[i], state.qvel[i]
        mujoco.mj_forward(MODEL, data)
        row = jax.tree.map(lambda x, i=i: x[i], state)
        actual = (row.derived["site_xpos"], row.derived["qfrc_constraint"])
        assert_trees_close(actual, (data.site_xpos, data.qfrc_constraint), rtol=1e-4, atol=1e-4)
    assert not np.any(state.qacc_warmstart)


def test_masked_forward_serves_the_rows_asked_for(engine):
    state, _ = scenes(engine, 4)
    moved = state.replace(qpos=state.qpos + 0.01)
    where = jnp.array([True, False, True, False])
    forward = jax.jit(jax.vmap(engine.forward))
    masked, whole = forward(moved, where), forward(moved, jnp.ones(4, bool))
    assert_trees_close(
        jax.tree.map(lambda x: x[where], masked),
        jax.tree.map(lambda x: x[where], whole),
        rtol=1e-6,
    )
    np.testing.assert_array_equal(masked.qpos, moved.qpos)


def test_masked_forward_skips_the_rest():
    engine = make_engine("mujoco", MODEL, FRAME_SKIP, FIELDS)
    state, _ = scenes(engine, 4)
    asked = []

    class Counting:
        def __init__(self, batch):
            self.batch, self.nsim = batch, batch.nsim

        def forward(self, ids):
            asked.append(ids.tolist())
            self.batch.forward(ids=ids)

    (lane,) = engine._idle[4]
    lane.batch = Counting(lane.batch)
    for where in ([False, True, True, False], [False] * 4):
        jax.block_until_ready(jax.vmap(engine.forward)(state, jnp.array(where)))
    assert asked == [[1, 2]]


def test_states_of_both_engines_have_one_structure():
    states = [
        jax.eval_shape(lambda e=e: e.step(e.init(jnp.zeros(2), jnp.zeros(2)), jnp.zeros(1)))
        for e in (MujocoEngine(MODEL, 1, FIELDS), MjxEngine(MODEL, 1, FIELDS))
    ]
    assert jax.tree.structure(states[0]) == jax.tree.structure(states[1])
    shapes = [[(x.shape, x.dtype) for x in jax.tree.leaves(state)] for state in states]
    assert shapes[0] == shapes[1]


def test_step_keeps_the_structure_of_init(engine):
    state, ctrl = scenes(engine)
    after = jax.eval_shape(engine.step, state, ctrl)
    assert jax.tree.structure(after) == jax.tree.structure(state)


@pytest.mark.parametrize("num_scenes", [(8, 8), (8, 3), (4096, 4096)])
def test_two_programs_at_once(num_scenes):
    """The same engine in two compiled programs; large batches cross over by another route."""
    engine = make_engine("mujoco", MODEL, FRAME_SKIP, FIELDS)
    num_steps = 20
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
    state, _ = scenes(engine)

    @jax.jit
    def tip(ctrl, shift):
        start = state.replace(qpos=jnp.array([0.21, 0.3]) + shift, qvel=jnp.zeros(2))
        after, _ = jax.lax.scan(lambda s, c: (engine.step(s, c), None), start, ctrl)
        return after.derived["site_xpos"][0, 0] + after.qvel[0]

    ctrl, shift = 0.3 * jnp.ones((2, 1)), jnp.zeros(2)
    gradients = jax.jit(jax.grad(tip, argnums=(0, 1)))(ctrl, shift)
    eps = 1e-3
    for i in range(2):
        up, down = ctrl.at[i, 0].add(eps), ctrl.at[i, 0].add(-eps)
        expected = (tip(up, shift) - tip(down, shift)) / (2 * eps)
        np.testing.assert_allclose(gradients[0][i, 0], expected, rtol=2e-2, atol=2e-3)
        up, down = shift.at[i].add(eps), shift.at[i].add(-eps)
        expected = (tip(ctrl, up) - tip(ctrl, down)) / (2 * eps)
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
