"""Which policy is kept while SAC goes on."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
from jax.flatten_util import ravel_pytree

from represent_jax.agents import sac
from represent_jax.stages import policies

KEY = jax.random.PRNGKey(0)
SMALL = sac.SacConfig(
    num_envs=4,
    updates_per_step=2,
    batch_size=8,
    buffer_capacity=64,
    warmup_env_steps=12,
    hidden_sizes=(8,),
)
CONFIG = policies.PoliciesConfig(env_steps=8, eval_env_steps=4, eval_episodes=2, sac=SMALL)
ENV = probes.episode()
OBJECTIVE = policies.Objective(probes.PROBES["action"], jnp.float32(1.0), jnp.float32(0.0))


def begin(config):
    learner = sac.init_learner(KEY, ENV.observation_size, ENV.action_size, SMALL)
    start = sac.policy_of(learner)
    state = policies.init(KEY, ENV, OBJECTIVE, start, config, probes.reward)
    return start, state


def test_the_policy_to_start_from_is_the_first_to_beat():
    start, state = begin(CONFIG)
    found = policies.evaluate(KEY, ENV, OBJECTIVE, start, CONFIG, probes.reward)
    np.testing.assert_allclose(state.best_learned_return, found.learned_return, rtol=1e-5)
    worse = state.replace(best_learned_return=state.best_learned_return + 100.0)
    after, _ = policies.train(worse, ENV, OBJECTIVE, CONFIG, probes.reward)
    probes.assert_equal(policies.finish(after, CONFIG), start)


def test_a_cold_start_is_beaten_by_any():
    cold = dataclasses.replace(CONFIG, start="cold")
    _, state = begin(cold)
    assert state.best_learned_return == -jnp.inf
    after, metrics = policies.train(state, ENV, OBJECTIVE, cold, probes.reward)
    assert after.best_learned_return == metrics["learned_return"]


def test_the_prior_of_a_task_fades_with_its_steps():
    fixed = dataclasses.replace(SMALL, learn_temperature=False)
    whole = dataclasses.replace(fixed, prior_weight=0.8, initial_temperature=0.4)
    quarter = dataclasses.replace(fixed, prior_weight=0.2, initial_temperature=0.1)

    def trained(sac_config, half_life):
        config = dataclasses.replace(CONFIG, sac=sac_config)
        _, state = begin(config)
        # Twelve steps of warm-up are two half-lives of six.
        assert state.agent.env_steps == 12
        objective = OBJECTIVE._replace(prior_half_life=half_life)
        after, _ = policies.train(state, ENV, objective, config, probes.reward)
        return ravel_pytree(after.agent.learner.policy_params)[0]

    expected = trained(quarter, None)
    np.testing.assert_allclose(trained(whole, jnp.float32(6.0)), expected, atol=1e-5)
    assert np.abs(trained(whole, jnp.float32(jnp.inf)) - expected).max() > 1e-4
