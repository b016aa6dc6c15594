"""Rewards and terminations of the tasks in closed form, and environments by name."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax.envs import base
from brax.envs.wrappers import training

from represent_jax.envs import Environment, Episode, Task, make_env, names, register, registry
from represent_jax.envs.hopper import Hopper
from represent_jax.envs.inverted_double_pendulum import InvertedDoublePendulum
from represent_jax.errors import UsageError
from represent_jax.physics import PhysicsState

NAMES = ("half_cheetah", "hopper", "inverted_double_pendulum")


def physics_at(qpos, qvel=None, **derived):
    qpos = jnp.asarray(qpos, jnp.float32)
    qvel = jnp.zeros_like(qpos) if qvel is None else jnp.asarray(qvel, jnp.float32)
    return PhysicsState(qpos, qvel, jnp.zeros(0), jnp.zeros_like(qvel), derived)


STANDING = physics_at([0.0, 1.25, 0.0, 0.0, 0.0, 0.0])
UNHEALTHY = {
    "low": physics_at([0.0, 0.7, 0.0, 0.0, 0.0, 0.0]),
    "leaning": physics_at([0.0, 1.25, -0.2, 0.0, 0.0, 0.0]),
    "joint out of range": physics_at([0.0, 1.25, 0.0, 0.0, 100.0, 0.0]),
    "too fast": physics_at([0.0, 1.25, 0.0, 0.0, 0.0, 0.0], [0.0, -100.0, 0.0, 0.0, 0.0, 0.0]),
    "not finite": physics_at([0.0, jnp.nan, 0.0, 0.0, 0.0, 0.0]),
}


def test_hopper_pays_its_bonus_while_healthy():
    before, action_t, dt = physics_at([-0.004, 1.25, 0.0, 0.0, 0.0, 0.0]), jnp.ones(3), 0.008
    moving = 0.5 - 3e-3
    task = Hopper()
    assert not task.terminated(STANDING)
    np.testing.assert_allclose(task.reward(before, action_t, STANDING, dt), 1.0 + moving, rtol=1e-5)
    for after in UNHEALTHY.values():
        assert task.terminated(after)
        np.testing.assert_allclose(task.reward(before, action_t, after, dt), moving, rtol=1e-5)


def test_hopper_that_terminates_is_paid_for_its_last_step():
    task = Hopper(terminates=True)
    reward = task.reward(STANDING, jnp.zeros(3), UNHEALTHY["low"], 0.008)
    np.testing.assert_allclose(reward, 1.0)


def test_half_cheetah_is_paid_for_speed():
    task = make_env("half_cheetah", "mujoco").task
    before, after = physics_at(np.zeros(9)), physics_at([0.1, *np.zeros(8)])
    reward = task.reward(before, jnp.full(6, 0.5), after, 0.05)
    np.testing.assert_allclose(reward, 2.0 - 0.1 * 6 * 0.25, rtol=1e-6)
    assert not task.terminated(after)


def test_double_pendulum_is_paid_for_standing_still():
    task = InvertedDoublePendulum()
    for x, height, fallen in ((0.0, 1.2, False), (0.3, 1.0, True), (0.3, 0.5, True)):
        after = physics_at(np.zeros(3), [5.0, 1.0, 2.0], site_xpos=jnp.array([[x, 0.0, height]]))
        expected = 10.0 - 0.01 * x**2 - (height - 2.0) ** 2 - 1e-3 * 1.0 - 5e-3 * 4.0
        reward = task.reward(after, jnp.zeros(1), after, 0.05)
        np.testing.assert_allclose(reward, expected, rtol=1e-6)
        assert task.terminated(after) == fallen


def test_termination_is_a_switch():
    assert {name: make_env(name, "mujoco").terminates for name in NAMES} == {
        "half_cheetah": False,
        "hopper": False,
        "inverted_double_pendulum": True,
    }
    assert make_env("hopper", "mujoco", terminates=True).terminates
    assert not make_env("inverted_double_pendulum", "mujoco", terminates=False).terminates


@pytest.mark.parametrize("name", ["hopper", "inverted_double_pendulum"])
@pytest.mark.parametrize("terminates", [True, False])
def test_episodes_end_early_only_with_termination(name, terminates):
    """Random actions make both fall within a hundred steps."""
    env = Episode(make_env(name, "mujoco", terminates=terminates), horizon=100, auto_reset=False)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0), 1.0)
    step = lambda state, _: (env.step(state, jnp.zeros(env.action_size)),) * 2  # noqa: E731
    _, states = jax.jit(lambda state: jax.lax.scan(step, state, None, length=100))(state)
    assert bool(np.any(states.info["terminated"])) == terminates
    assert bool(states.info["truncated"][-1]) != terminates


@pytest.mark.parametrize("name", NAMES)
def test_auto_reset_restores_the_whole_state(name):
    """An episode after a reset goes as one that starts from the same state."""
    env = Episode(make_env(name, "mujoco"), horizon=2)
    step = jax.jit(env.step)
    action = 0.3 * jnp.ones(env.action_size)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    state = step(step(state, action), action)
    assert state.done and state.info["steps"] == 0
    physics = state.pipeline_state
    np.testing.assert_array_equal(physics.qacc_warmstart, 0.0)
    fresh = jax.jit(env.env.engine.init)(physics.qpos, physics.qvel)
    jax.tree.map(np.testing.assert_array_equal, physics, fresh)
    np.testing.assert_allclose(state.obs, env.env.task.observe(fresh), rtol=1e-6)
    assert np.any(state.obs != state.info["next_obs"])


@pytest.mark.parametrize("name", NAMES)
def test_brax_wrappers_run_it(name):
    env = make_env(name, "mujoco")
    wrapped = training.wrap(env, episode_length=3, action_repeat=1)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 5))
    assert isinstance(env, base.Env) and isinstance(state, base.State)
    assert state.obs.shape == (5, env.observation_size)
    step = jax.jit(wrapped.step)
    for _ in range(3):
        state = step(state, jnp.zeros((5, env.action_size)))
    np.testing.assert_array_equal(state.done, 1.0)
    assert env.unwrapped is env and env.backend == "mujoco"


def test_names_are_known():
    assert set(NAMES) <= set(names())
    with pytest.raises(UsageError, match=r"unknown environment 'half_cheeta'.*half_cheetah"):
        make_env("half_cheeta")
    with pytest.raises(
        UsageError,
        match=r"unknown environment 'ant'.*known are franka_kitchen, franka_kitchen_hand, "
        "half_cheetah",
    ):
        make_env("ant")
    with pytest.raises(UsageError, match="unknown backend 'mjy'"):
        make_env("hopper", "mjy")
    with pytest.raises(UsageError, match=r"'hopper'.*'terminate'"):
        make_env("hopper", "mujoco", terminate=True)


RAIL = """
<mujoco>
  <option timestep="0.02"/>
  <worldbody>
    <body>
      <joint name="rail" type="slide" axis="1 0 0" damping="1"/>
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
      <site pos="0 0 0.1"/>
    </body>
  </worldbody>
  <actuator><motor joint="rail" ctrllimited="true" ctrlrange="-4 8"/></actuator>
</mujoco>
"""


class Reach(Task):
    """A user's own task: push a block on a rail to the origin; leaving the rail ends it."""

    name = "reach"
    frame_skip = 2
    horizon = 20
    terminates = True
    derived_fields = ("site_xpos",)

    def load_model(self):
        return mujoco.MjModel.from_xml_string(RAIL)

    def reset(self, key, init_qpos):
        return init_qpos + jax.random.uniform(key, (1,), minval=0.5, maxval=1.0), jnp.zeros(1)

    def observe(self, physics):
        return jnp.concatenate([physics.qpos, physics.qvel])

    def reward(self, before, action_t, after, dt):
        return -jnp.abs(after.derived["site_xpos"][0, 0])

    def terminated(self, physics):
        return jnp.abs(physics.qpos[0]) > 1.5


@pytest.fixture
def reach(monkeypatch):
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    register(Reach, "reach")


@pytest.mark.parametrize("backend", ["mujoco", "mjx"])
def test_own_task_runs_on_both_engines(reach, backend):
    env = make_env("reach", backend)
    assert isinstance(env, Environment) and env.backend == backend
    assert (env.observation_size, env.action_size, env.horizon) == (2, 1, 20)
    episode = Episode(env)
    state = jax.jit(jax.vmap(episode.reset))(jax.random.split(jax.random.PRNGKey(0), 3))
    start = np.asarray(state.obs)
    assert np.all((start[:, 0] >= 0.5) & (start[:, 0] <= 1.0))
    # Actions of 1, 0 and -1 are forces of 8, 2 and -4 N; the damped block solves
    # v' = f - v exactly as MuJoCo's implicit Euler does, v <- (v + h f) / (1 + h).
    step = jax.jit(jax.vmap(episode.step))
    for _ in range(3):
        state = step(state, jnp.array([[1.0], [0.0], [-1.0]]))
    x, v, h = start[:, 0], np.zeros(3), 0.02
    for _ in range(6):
        x_site = x
        v = (v + h * np.array([8.0, 2.0, -4.0])) / (1.0 + h)
        x = x + h * v
    np.testing.assert_allclose(state.obs, np.stack([x, v], axis=-1), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(state.reward, -np.abs(x_site), rtol=1e-4)
    ended = jax.lax.fori_loop(0, 25, lambda _, s: step(s, jnp.ones((3, 1))), state)
    assert np.all(ended.info["steps"] < 20)


class LightReach(Reach):
    """The same with a scene for MJX that is another."""

    def load_light_model(self):
        return mujoco.MjModel.from_xml_string(RAIL.replace('mass="1"', 'mass="2"'))


@pytest.mark.parametrize("platform", ["cpu", "gpu", "tpu"])
def test_auto_never_picks_another_scene(reach, monkeypatch, platform):
    register(LightReach, "light_reach")
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    env = make_env("light_reach")
    assert env.backend == "mujoco" and env.engine.model.body_mass[1] == 1.0
    asked = make_env("light_reach", "mjx")
    assert asked.backend == "mjx" and asked.engine.model.body_mass[1] == 2.0
    assert make_env("reach").backend == ("mujoco" if platform == "cpu" else "mjx")


def test_taken_name_is_refused(reach):
    with pytest.raises(UsageError, match="'reach' is already registered"):
        register(Reach, "reach")
    assert "reach" in names()


@pytest.mark.parametrize("name", ["hopper", "half_cheetah", "inverted_double_pendulum"])
def test_observations_tell_positions(name):
    env = make_env(name, "mujoco")

    @jax.jit
    def play(key):
        def body(state, action):
            state = env.step(state, action)
            return state, (state.obs, state.pipeline_state.qpos)

        actions = jax.random.uniform(key, (40, env.action_size), minval=-1.0, maxval=1.0)
        return jax.lax.scan(body, env.reset(key), actions)[1]

    obs, qpos = (np.asarray(x) for x in play(jax.random.PRNGKey(0)))
    found = env.task.qpos_of(env.engine.model, obs, env.engine.dt)
    assert found.shape == qpos.shape
    if name == "inverted_double_pendulum":
        np.testing.assert_allclose(np.sin(found), np.sin(qpos), atol=1e-5)
    else:
        np.testing.assert_allclose(found[:, 1:], qpos[:, 1:], atol=1e-5)
        # The place along the track is integrated from its velocity.
        travelled = np.abs(np.diff(qpos[:, 0])).sum()
        assert np.abs(found[:, 0] - (qpos[:, 0] - qpos[0, 0])).max() < 0.15 * travelled
