"""What policies are paid: the centre of a learned reward."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.envs import Episode, make_env
from represent_jax.methods.presets import make_config
from represent_jax.stages import policies

CONFIG = make_config("smoke", "half_cheetah").policies
HORIZON = 20


def _forward(params, obs_t, action_t, next_obs_t):
    return params * next_obs_t[..., 8]


@pytest.mark.parametrize("name", ["half_cheetah", "inverted_double_pendulum"])
def test_centred_on_its_start_a_policy_earns_nothing_where_episodes_do_not_end_early(name):
    env = Episode(make_env(name, "mujoco"), HORIZON)
    agent, settings = policies.agent_of(CONFIG)
    key = jax.random.PRNGKey(0)
    learner = agent.init_learner(key, env.observation_size, env.action_size, settings)
    policy = agent.policy_of(learner)
    objective = policies.make_objective(jnp.float32(0.5), 3.0, env, CONFIG)
    asked = (key, env, objective, policy, CONFIG, _forward)
    centred = jax.jit(lambda: policies.center_on(*asked))()
    if env.terminates:
        assert float(centred.center) == float(objective.center) == 0.0
        return
    earned = jax.jit(lambda: policies.evaluate(*asked))().learned_return
    assert abs(float(earned)) > 1e-3
    np.testing.assert_allclose(HORIZON * centred.center, 3.0 * earned, rtol=1e-4)
