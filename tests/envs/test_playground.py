"""Environments of Brax's kind: one written here always, one of MuJoCo Playground if installed."""

import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import represent_jax as rj
from represent_jax.agents import rollout, sac
from represent_jax.data import Demonstrations, unpad
from represent_jax.envs import Episode, Task, registry
from represent_jax.envs.playground import Adapted
from represent_jax.errors import UsageError

TINY_SAC = sac.SacConfig(
    num_envs=4,
    updates_per_step=1,
    batch_size=8,
    buffer_capacity=400,
    warmup_env_steps=8,
    hidden_sizes=(8, 8),
)


@struct.dataclass
class State:
    """A state with Playground's names."""

    data: jax.Array
    obs: dict
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


class Drift:
    """A point pushed along a line; its `info` counts steps, and is written in place."""

    action_size = 1

    def reset(self, rng):
        x = jax.random.uniform(rng, ())
        info = {"rng": rng, "steps": jnp.zeros((), jnp.int32)}
        return State(x, self._obs(x), jnp.zeros(()), jnp.zeros(()), {"x": x}, info)

    def step(self, state, action):
        x = state.data + action[0]
        state.info["steps"] = state.info["steps"] + 1
        state.metrics["x"] = x
        done = state.info["steps"] == 3  # A bool, where a reset gives a float.
        return state.replace(data=x, obs=self._obs(x), reward=-jnp.abs(x), done=done)

    def _obs(self, x):
        return {"state": jnp.stack([x, x**2]), "privileged_state": jnp.zeros(5)}


def test_the_whole_state_is_renewed_by_a_reset():
    env = Episode(Adapted(Drift(), "drift", horizon=10))
    assert (env.observation_size, env.action_size, env.terminates) == (2, 1, True)
    assert env.unwrapped.outcomes(jnp.zeros((1, 11, 2))) == {}
    start = jax.jit(env.reset)(jax.random.PRNGKey(0))

    def step(state, _):
        state = env.step(state, jnp.full(1, 0.5))
        return state, state

    _, states = jax.jit(lambda state: jax.lax.scan(step, state, None, length=7))(start)
    np.testing.assert_array_equal(states.info["terminated"], [0, 0, 1, 0, 0, 1, 0])
    np.testing.assert_array_equal(states.pipeline_state.info["steps"], [1, 2, 0, 1, 2, 0, 1])
    ended = float(start.obs[0]) + 1.5
    np.testing.assert_allclose(states.info["next_obs"][2], [ended, ended**2], rtol=1e-6)
    np.testing.assert_allclose(states.reward[2], -ended, rtol=1e-6)
    # Another initial state, and other keys, after each reset.
    assert len(np.unique(states.pipeline_state.info["rng"][:, 0])) == 3
    assert 0.0 <= states.obs[2, 0] <= 1.0


def test_other_observations_and_no_termination():
    env = Adapted(Drift(), "drift", horizon=10, terminates=False, obs_key="privileged_state")
    assert env.observation_size == 5
    state = env.reset(jax.random.PRNGKey(0))
    for _ in range(4):
        state = env.step(state, jnp.zeros(1))
    assert not state.done
    with pytest.raises(UsageError, match="obs_key: expected one of privileged_state, state"):
        Adapted(Drift(), "drift", horizon=10, obs_key="pixels")


def test_sac_learns_in_it():
    env = Episode(Adapted(Drift(), "drift", horizon=10))
    state = sac.init(jax.random.PRNGKey(0), env, TINY_SAC)
    state, metrics = jax.jit(lambda state: sac.train(state, env, TINY_SAC, 5))(state)
    assert state.env_steps > 0 and all(np.isfinite(v) for v in metrics.values())


class Still(Task):
    """Named by its place below."""

    name = "still"


def test_a_task_is_found_by_its_place(monkeypatch):
    module = types.ModuleType("my_robots")
    module.Still, module.number = Still, 3
    monkeypatch.setitem(sys.modules, "my_robots", module)
    with pytest.raises(UsageError, match="abstract"):
        rj.make_env("my_robots:Still")
    with pytest.raises(UsageError, match=r"expected a class of envs\.Task, .*found 3"):
        rj.make_env("my_robots:number")
    with pytest.raises(UsageError, match="has no attribute 'Walker'"):
        rj.make_env("my_robots:Walker")
    with pytest.raises(UsageError, match="No module named 'nobodys_robots'"):
        rj.make_env("nobodys_robots:Walker")


def test_an_environment_of_ones_own_is_made_by_name(monkeypatch):
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    registry.register(lambda horizon=7: Adapted(Drift(), "drift", horizon), "drift")
    env = rj.make_env("drift", horizon=9)
    assert isinstance(env, Adapted) and env.horizon == 9
    module = types.ModuleType("my_robots")
    module.drift = lambda: Adapted(Drift(), "drift", 7)
    module.plain = Drift
    monkeypatch.setitem(sys.modules, "my_robots", module)
    assert rj.make_env("my_robots:drift", "mjx").horizon == 7
    with pytest.raises(UsageError, match="backend: expected 'mjx' or 'auto', found 'mujoco'"):
        rj.make_env("drift", "mujoco")
    with pytest.raises(UsageError, match=r"my_robots:plain.*expected an envs.Task, or an envs.Ada"):
        rj.make_env("my_robots:plain")


def test_playground_that_is_not_installed_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    with pytest.raises(UsageError, match=r"represent_jax\[playground\]"):
        rj.make_env("playground:CartpoleBalance")


@pytest.fixture(scope="module")
def cartpole():
    pytest.importorskip("mujoco_playground")
    return rj.make_env("playground:CartpoleBalance", horizon=10)


def test_playgrounds_cartpole_runs_as_it_is(cartpole):
    """The same observations and rewards, step by step, as Playground's own."""
    from mujoco_playground import registry

    own = registry.load("CartpoleBalance", config_overrides={"impl": "jax"})
    key, action = jax.random.PRNGKey(0), jnp.full(1, 0.3)
    assert (cartpole.observation_size, cartpole.action_size) == (5, 1)
    assert not cartpole.terminates and rj.make_env("playground:CartpoleBalance").horizon == 1000
    theirs, ours = jax.jit(own.reset)(key), jax.jit(cartpole.reset)(key)
    their_step, our_step = jax.jit(own.step), jax.jit(cartpole.step)
    for _ in range(3):
        theirs, ours = their_step(theirs, action), our_step(ours, action)
        np.testing.assert_allclose(ours.obs, theirs.obs, rtol=1e-6)
        np.testing.assert_allclose(ours.reward, theirs.reward, rtol=1e-6)


def test_sac_learns_in_playground(cartpole):
    env = Episode(cartpole)
    state = jax.jit(lambda key: sac.init(key, env, TINY_SAC))(jax.random.PRNGKey(0))
    state, metrics = jax.jit(lambda state: sac.train(state, env, TINY_SAC, 5))(state)
    assert all(np.isfinite(v) for v in metrics.values())
    assert 0.0 < metrics["env_reward"] <= 1.0


def test_a_reward_is_learned_in_playground_and_paid_there(cartpole, tmp_path):
    """D-REX on noisy demonstrations; then its reward, in Playground's own environment."""
    from mujoco_playground import registry

    episodes = Episode(cartpole, auto_reset=False)
    push = lambda _, obs_t, key: -obs_t[..., 2:3]  # noqa: E731
    batch = rollout.rollout(episodes, push, None, jax.random.PRNGKey(0), jnp.zeros(4))
    batch = batch._replace(strategy=np.array([0, 0, 1, 1], np.int32))
    name = "playground:CartpoleBalance"
    demonstrations = Demonstrations(name, unpad(jax.device_get(batch)))
    config = rj.make_config("smoke", name, method="drex")
    rj.learn(tmp_path / "run", config, demonstrations, until="preference")
    own = registry.load("CartpoleBalance", config_overrides={"impl": "jax"})
    learned = rj.brax.LearnedReward(own, tmp_path / "run")
    before = jax.jit(learned.reset)(jax.random.PRNGKey(1))
    obs = np.asarray(before.obs)
    after = jax.jit(learned.step)(before, jnp.full(1, 0.3))
    expected = rj.load_reward(tmp_path / "run")(obs, jnp.full(1, 0.3), after.obs)
    np.testing.assert_allclose(after.reward, expected, rtol=1e-5)
    assert 0.0 < after.metrics["true_reward"] <= 1.0


def test_what_playground_cannot_do_is_refused(cartpole):
    with pytest.raises(UsageError, match="unknown environment of MuJoCo Playground 'Cartpole'"):
        rj.make_env("playground:Cartpole")
    with pytest.raises(UsageError, match="backend: expected 'mjx' or 'auto'"):
        rj.make_env("playground:CartpoleBalance", "mujoco")
    with pytest.raises(UsageError, match=r"playground:CartpoleBalance.*gravitation"):
        rj.make_env("playground:CartpoleBalance", gravitation=2.0)
