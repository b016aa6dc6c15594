"""Learned rewards in Brax's interface, under jit, vmap and the wrappers of training loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import base
from brax.envs.wrappers import training
from flax import struct

import represent_jax as rj
from represent_jax.envs import Episode
from represent_jax.errors import UsageError

OBS_DIM, ACTION_DIM = 17, 6


class Counter(base.Env):
    """Observations count up; ends after three steps. Its metrics are written in place."""

    observation_size, action_size, backend = OBS_DIM, ACTION_DIM, "none"

    def reset(self, rng):
        steps = jnp.zeros((), jnp.int32)
        zero = jnp.zeros(())
        return base.State(steps, self._obs(steps), zero, zero, {"effort": zero})

    def step(self, state, action):
        steps = state.pipeline_state + 1
        state.metrics["effort"] = jnp.sum(jnp.square(action))
        done = (steps == 3).astype(jnp.float32)
        reward = steps.astype(jnp.float32)
        return state.replace(pipeline_state=steps, obs=self._obs(steps), reward=reward, done=done)

    def _obs(self, steps):
        return jnp.full(OBS_DIM, 0.1 * steps)


@struct.dataclass
class ManyState:
    """A state as MuJoCo Playground has it."""

    data: jax.Array
    obs: dict
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


class Many:
    """The same with two observations and Playground's names."""

    observation_size, action_size = {"state": (OBS_DIM,), "privileged": (3,)}, ACTION_DIM

    def reset(self, rng):
        state = Counter().reset(rng)
        return ManyState(
            state.pipeline_state, self._obs(state), state.reward, state.done, {}, {"rng": rng}
        )

    def step(self, state, action):
        zero = jnp.zeros(())
        inner = base.State(state.data, None, zero, zero, {"effort": zero})
        after = Counter().step(inner, action)
        return state.replace(
            data=after.pipeline_state, obs=self._obs(after), reward=after.reward, done=after.done
        )

    def _obs(self, state):
        return {"state": state.obs, "privileged": jnp.zeros(3)}


@pytest.fixture(scope="module")
def expected(half_cheetah_run):
    """The run's reward of the step that begins after `steps` others."""
    loaded = rj.load_reward(half_cheetah_run)

    def at(steps, action, target="task"):
        obs, next_obs = (jnp.full(OBS_DIM, 0.1 * s) for s in (steps, steps + 1))
        return np.asarray(loaded(obs, action, next_obs, target=target))

    return at


@pytest.mark.parametrize("make", [Counter, Many])
def test_it_pays_the_learned_reward(half_cheetah_run, expected, make):
    env = rj.brax.LearnedReward(make(), half_cheetah_run, "strategy_1", scale=2.0)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    shape = jax.tree.structure(state)
    action = jnp.full(ACTION_DIM, 1.5)
    for steps in range(3):
        state = jax.jit(env.step)(state, action)
        paid = 2.0 * expected(steps, jnp.ones(ACTION_DIM), "strategy_1")
        np.testing.assert_allclose(state.reward, paid, rtol=1e-5)
        assert state.metrics["true_reward"] == steps + 1
        assert jax.tree.structure(state) == shape
    assert state.done


def test_wrappers_of_training_go_around_it(half_cheetah_run, expected):
    """Seven steps of episodes of three, in a scan: a reset's observation is never paid for."""
    learned = rj.brax.LearnedReward(Counter(), half_cheetah_run)
    env = training.wrap(learned, episode_length=10, action_repeat=1)
    actions = jnp.linspace(-1.0, 1.0, 4)[:, None] * jnp.ones(ACTION_DIM)

    def step(state, _):
        state = env.step(state, actions)
        return state, (state.reward, state.metrics["true_reward"], state.metrics["effort"])

    start = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 4))
    _, (rewards, true_rewards, effort) = jax.jit(
        lambda state: jax.lax.scan(step, state, None, length=7)
    )(start)
    for i in range(7):
        paid = [expected(i % 3, action) for action in actions]
        np.testing.assert_allclose(rewards[i], paid, rtol=1e-5)
        np.testing.assert_array_equal(true_rewards[i], i % 3 + 1)
    np.testing.assert_allclose(effort[0], jnp.sum(actions**2, axis=-1), rtol=1e-6)


def test_our_own_environment_and_episodes(half_cheetah_run):
    plain = rj.make_env("half_cheetah", "mujoco")
    env = Episode(rj.brax.LearnedReward(plain, half_cheetah_run), horizon=5)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    step = jax.jit(env.step)
    for _ in range(6):
        before, state = state, step(state, jnp.full(ACTION_DIM, 0.5))
        reward = rj.load_reward(half_cheetah_run)(
            before.obs, state.info["executed_action"], state.info["next_obs"]
        )
        np.testing.assert_allclose(state.reward, reward, rtol=1e-5)


def test_what_does_not_fit_is_refused(half_cheetah_run):
    wrap = rj.brax.LearnedReward
    with pytest.raises(UsageError, match=r"observation size: expected 17.*found 11"):
        wrap(rj.make_env("hopper", "mujoco"), half_cheetah_run)
    with pytest.raises(UsageError, match=r"does not reset itself.*AutoResetWrapper"):
        wrap(training.AutoResetWrapper(training.VmapWrapper(Counter())), half_cheetah_run)
    with pytest.raises(UsageError, match=r"does not reset itself.*Episode"):
        wrap(Episode(rj.make_env("half_cheetah", "mujoco")), half_cheetah_run)
    with pytest.raises(UsageError, match="obs_key: expected one of privileged, state"):
        wrap(Many(), half_cheetah_run, obs_key="pixels")
    with pytest.raises(UsageError, match="unknown target 'strategy_3'"):
        wrap(Counter(), half_cheetah_run, "strategy_3")
