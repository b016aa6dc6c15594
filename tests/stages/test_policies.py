"""Policies as they are used: modes, or samples whose noise is a function of the observation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.agents import sac
from represent_jax.agents.sac import SacConfig
from represent_jax.data.trajectories import Trajectory, pad
from represent_jax.errors import RepresentError, UsageError
from represent_jax.stages import policies
from represent_jax.stages.policies import PoliciesConfig, TaskPolicyConfig

CONFIG = PoliciesConfig(sac=SacConfig(hidden_sizes=(8, 8)))
SAMPLED = dataclasses.replace(CONFIG, actions="sampled")
OBS_DIM, ACTION_DIM = 3, 2


@pytest.fixture(scope="module")
def policy():
    learner = sac.init_learner(jax.random.PRNGKey(0), OBS_DIM, ACTION_DIM, CONFIG.sac)
    return sac.policy_of(learner)


def test_modes_are_the_agents(policy):
    obs_t = jax.random.normal(jax.random.PRNGKey(1), (5, 4, OBS_DIM))
    found = policies.act(policy, obs_t, ACTION_DIM, CONFIG)
    key = jax.random.PRNGKey(2)
    mode = sac.act(policy, obs_t, key, CONFIG.sac, ACTION_DIM, deterministic=True)
    np.testing.assert_array_equal(found, mode)


def test_sampled_actions_are_a_pure_function_of_observations(policy):
    obs_t = jax.random.normal(jax.random.PRNGKey(1), (5, 4, OBS_DIM))
    found = policies.act(policy, obs_t, ACTION_DIM, SAMPLED)
    assert found.shape == (5, 4, ACTION_DIM)
    alone = jax.jit(lambda row: policies.act(policy, row, ACTION_DIM, SAMPLED))(obs_t[3, 2])
    np.testing.assert_allclose(found[3, 2], alone, rtol=1e-5)
    assert np.unique(np.asarray(found).reshape(-1, ACTION_DIM), axis=0).shape[0] == 20


def test_sampled_actions_are_distributed_as_the_policy_says(policy):
    # Observations that differ in the last bits only share one distribution.
    rows = np.ones((4_000, OBS_DIM), np.float32)
    rows.view(np.uint32)[:, 1] += np.arange(4_000, dtype=np.uint32)
    found = policies.act(policy, jnp.asarray(rows), ACTION_DIM, SAMPLED)
    keys = jax.random.split(jax.random.PRNGKey(1), 4_000)
    drawn = jax.vmap(lambda key: sac.act(policy, rows[0], key, CONFIG.sac, ACTION_DIM))(keys)
    np.testing.assert_allclose(found.mean(axis=0), drawn.mean(axis=0), atol=0.04)
    np.testing.assert_allclose(found.std(axis=0), drawn.std(axis=0), atol=0.04)
    apart = np.corrcoef(np.asarray(found[1:, 0]), np.asarray(found[:-1, 0]))[0, 1]
    assert abs(apart) < 0.06


def _height(slope, obs_t, action_t, next_obs_t):
    return slope * next_obs_t[..., 0]


def _climbs(*heights):
    """Trajectories of states alone."""
    rows = [np.array(each, np.float32)[:, None] for each in heights]
    return pad([Trajectory(each, None, None, False, 0) for each in rows], 3)


@pytest.mark.parametrize("center", [0.0, 1.0])
def test_demonstrated_states_pay_from_nothing_to_the_span(center):
    # Nothing led to the first states, 3 and 9, so they pay nothing.
    batch = _climbs([3.0, 1.0, 4.0, 2.0], [9.0, 2.0, 3.0, 5.0])
    objective = policies.Objective(0.5, jnp.float32(7.0), jnp.float32(center))
    found = policies.task_objective(objective, batch, TaskPolicyConfig(span=6.0), _height)
    paid = found.scale * 0.5 * np.array([1.0, 2.0, 5.0]) - found.center
    np.testing.assert_allclose(paid, np.array([0.0, 1.5, 6.0]) - center, atol=1e-5)
    unchanged = policies.task_objective(objective, batch, TaskPolicyConfig(), _height)
    assert unchanged is objective


def test_steps_beyond_an_episode_set_no_span():
    batch = _climbs([0.0, 1.0, 3.0], [0.0, 1.0])
    batch.obs[1, 2:] = 99.0
    objective = policies.Objective(1.0, jnp.float32(7.0), jnp.float32(0.0))
    found = policies.task_objective(objective, batch, TaskPolicyConfig(span=2.0), _height)
    np.testing.assert_allclose(found.scale, 1.0, rtol=1e-6)


def test_a_task_without_a_span_is_refused():
    objective = policies.Objective(2.0, jnp.float32(7.0), jnp.float32(0.0))
    with pytest.raises(RepresentError, match="R\\^0 is 2 in every demonstrated state"):
        policies.task_objective(objective, _climbs([1.0] * 3), TaskPolicyConfig(span=1.0), _height)
    for setting in ("span", "prior_half_life"):
        with pytest.raises(UsageError, match=f"{setting}: expected positive, or none, found 0"):
            TaskPolicyConfig(**{setting: 0})


def test_other_actions_are_refused():
    with pytest.raises(UsageError, match="actions: expected 'mode' or 'sampled'"):
        PoliciesConfig(actions="mean")
