"""Episodes on a task without physics, where everything is known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from brax.envs import base

from represent_jax.envs import Episode
from represent_jax.envs.episode import transition_of

HORIZON = 5


class Line(base.Env):
    """Starts anywhere in [0, 1) and walks along the line; ends beyond `goal`, if there is one."""

    horizon = HORIZON
    action_size = 1
    observation_size = 1
    backend = "none"

    def __init__(self, goal=np.inf):
        self.goal = goal

    def reset(self, rng, where=True):
        del where
        obs = jax.random.uniform(rng, (1,))
        return base.State(obs, obs, jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        obs = state.obs + 1.0
        done = (obs[0] >= self.goal).astype(jnp.float32)
        return state.replace(pipeline_state=obs, obs=obs, reward=action[0], done=done)


def roll(env, num_steps, num_envs=4, noise_level=0.0, actions=None, seed=0):
    """Returns the first states and those after each step, `[num_steps, num_envs, ...]`."""
    keys = jax.random.split(jax.random.PRNGKey(seed), num_envs)
    noise_level = jnp.broadcast_to(noise_level, (num_envs,))
    start = jax.vmap(env.reset)(keys, noise_level)
    if actions is None:
        actions = jnp.full((num_steps, num_envs, env.action_size), 2.0)

    def body(state, action):
        after = jax.vmap(env.step)(state, action)
        return after, (after, transition_of(state, after))

    _, (states, transitions) = jax.jit(lambda s: jax.lax.scan(body, s, actions))(start)
    return start, states, transitions


def test_time_limit_truncates():
    _, states, transitions = roll(Episode(Line()), 2 * HORIZON)
    last = np.arange(1, 2 * HORIZON + 1) % HORIZON == 0
    np.testing.assert_array_equal(states.info["truncated"], np.repeat(last[:, None], 4, 1))
    np.testing.assert_array_equal(states.done, np.repeat(last[:, None], 4, 1))
    assert not np.any(states.info["terminated"])
    np.testing.assert_array_equal(transitions.discount_t, 1.0)
    np.testing.assert_array_equal(
        states.info["steps"][:, 0], np.arange(1, 2 * HORIZON + 1) % HORIZON
    )


def test_termination_is_no_truncation():
    _, states, transitions = roll(Episode(Line(goal=3.0)), 6)
    np.testing.assert_array_equal(states.info["terminated"][:, 0], [0, 0, 1, 0, 0, 1])
    assert not np.any(states.info["truncated"])
    np.testing.assert_array_equal(transitions.discount_t, 1.0 - states.info["terminated"])
    np.testing.assert_array_equal(states.done, states.info["terminated"])


def test_termination_at_the_time_limit_is_termination():
    _, states, transitions = roll(Episode(Line(goal=float(HORIZON))), HORIZON)
    np.testing.assert_array_equal(states.info["terminated"][-1], True)
    np.testing.assert_array_equal(states.info["truncated"][-1], False)
    np.testing.assert_array_equal(transitions.discount_t[-1], 0.0)


@pytest.mark.parametrize("goal", [np.inf, 3.0])
def test_transitions_store_the_true_final_observation(goal):
    start, states, transitions = roll(Episode(Line(goal)), 2 * HORIZON)
    np.testing.assert_allclose(transitions.next_obs_t, transitions.obs_t + 1.0)
    np.testing.assert_array_equal(transitions.obs_t[0], start.obs)
    np.testing.assert_array_equal(transitions.obs_t[1:], states.obs[:-1])
    ended = np.asarray(states.done, bool)
    assert np.all(states.obs[ended] < 1.0), "a new episode begins"
    np.testing.assert_array_equal(states.obs[~ended], states.info["next_obs"][~ended])
    np.testing.assert_array_equal(states.pipeline_state, states.obs)


def test_every_reset_draws_a_new_state():
    start, states, _ = roll(Episode(Line(), horizon=1), 50, num_envs=8)
    draws = np.concatenate([start.obs.ravel(), states.obs.ravel()])
    assert len(np.unique(draws)) == draws.size
    assert scipy.stats.kstest(draws, "uniform").pvalue > 1e-3


def test_rollouts_are_reproducible_and_seeds_differ():
    env = Episode(Line(goal=3.0))
    runs = [roll(env, 10, noise_level=0.5, seed=seed)[2] for seed in (0, 0, 1)]
    jax.tree.map(np.testing.assert_array_equal, runs[0], runs[1])
    assert np.any(runs[0].action_t != runs[2].action_t)


def test_noise_levels():
    """One vmapped axis: at 0 nothing is replaced, at 1 everything, at eta a share of eta."""
    num_steps, levels = 2000, np.array([0.0, 0.25, 0.5, 1.0])
    _, states, transitions = roll(Episode(Line()), num_steps, noise_level=jnp.asarray(levels))
    executed = np.asarray(transitions.action_t[..., 0])
    replaced = executed != 2.0  # the policy's action lies outside what noise can draw
    np.testing.assert_array_equal(replaced[:, 0], False)
    np.testing.assert_array_equal(replaced[:, 3], True)
    for i in (1, 2):
        assert scipy.stats.binomtest(replaced[:, i].sum(), num_steps, levels[i]).pvalue > 1e-3
        # Replacement does not depend on whether the step before was replaced.
        pairs = np.corrcoef(replaced[1:, i], replaced[:-1, i])[0, 1]
        assert abs(pairs) < 4.0 / np.sqrt(num_steps)
    uniform = scipy.stats.uniform(-1.0, 2.0)
    for i in (1, 2, 3):
        assert scipy.stats.kstest(executed[replaced[:, i], i], uniform.cdf).pvalue > 1e-3
    # What is executed is what the task saw, and its level is stored beside it, past resets too.
    np.testing.assert_array_equal(states.reward, executed)
    np.testing.assert_allclose(transitions.noise_level_t, np.tile(levels, (num_steps, 1)))


def test_noise_replaces_the_whole_action():
    class Plane(Line):
        action_size = 3

    _, _, transitions = roll(Episode(Plane()), 500, noise_level=0.5)
    replaced = np.asarray(transitions.action_t != 2.0)
    np.testing.assert_array_equal(replaced.any(axis=-1), replaced.all(axis=-1))
    assert 0.4 < replaced.mean() < 0.6


def test_random_actions_are_of_the_size_asked_for():
    _, _, transitions = roll(Episode(Line(), noise_size=0.2), 200, noise_level=1.0)
    assert np.all(np.abs(transitions.action_t) <= 0.2)
    p_value = scipy.stats.kstest(np.ravel(transitions.action_t) / 0.4 + 0.5, "uniform").pvalue
    assert p_value > 1e-3


def test_levels_and_scenes_are_two_nested_axes():
    env = Episode(Line())
    keys = jax.random.split(jax.random.PRNGKey(0), (2, 3))
    levels = jnp.array([0.0, 1.0])
    state = jax.vmap(jax.vmap(env.reset, in_axes=(0, None)), in_axes=(0, 0))(keys, levels)
    after = jax.vmap(jax.vmap(env.step))(state, jnp.full((2, 3, 1), 2.0))
    assert after.obs.shape == (2, 3, 1)
    np.testing.assert_array_equal(after.info["executed_action"][0], 2.0)
    assert np.all(np.abs(after.info["executed_action"][1]) <= 1.0)


def test_without_auto_reset_the_caller_masks():
    """The state goes on past the end; `done` stays set."""
    start, states, _ = roll(Episode(Line(), auto_reset=False), HORIZON + 2)
    np.testing.assert_allclose(
        states.obs[:, :, 0] - start.obs[:, 0], np.tile(np.arange(1, HORIZON + 3)[:, None], 4)
    )
    np.testing.assert_array_equal(states.obs, states.info["next_obs"])
    np.testing.assert_array_equal(states.info["steps"][:, 0], np.arange(1, HORIZON + 3))
    np.testing.assert_array_equal(states.done[:, 0], [0] * (HORIZON - 1) + [1] * 3)


def test_horizon_can_be_shortened():
    _, states, _ = roll(Episode(Line(), horizon=2), 4)
    np.testing.assert_array_equal(states.info["truncated"][:, 0], [False, True, False, True])


def test_jit_agrees_with_no_jit():
    env = Episode(Line(goal=3.0))
    state = env.reset(jax.random.PRNGKey(0), 0.5)
    step, eager = jax.jit(env.step), state
    for _ in range(4):
        state, eager = step(state, jnp.full(1, 2.0)), env.step(eager, jnp.full(1, 2.0))
        jax.tree.map(np.testing.assert_allclose, state, eager)


def test_reset_and_step_have_one_structure():
    env = Episode(Line())
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    after = jax.eval_shape(env.step, state, jnp.zeros(1))
    assert jax.tree.structure(state) == jax.tree.structure(after)
    assert jax.tree.leaves(state) == jax.tree.leaves(after)
