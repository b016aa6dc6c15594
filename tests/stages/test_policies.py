"""Policies as they are used: modes, or samples whose noise is a function of the observation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.agents import sac
from represent_jax.agents.sac import SacConfig
from represent_jax.errors import UsageError
from represent_jax.stages import policies
from represent_jax.stages.policies import PoliciesConfig

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


def test_other_actions_are_refused():
    with pytest.raises(UsageError, match="actions: expected 'mode' or 'sampled'"):
        PoliciesConfig(actions="mean")
