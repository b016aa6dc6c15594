import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from represent_jax.agents import ppo, sac
from represent_jax.errors import UsageError
from represent_jax.runs import checkpoint

KEY = jax.random.PRNGKey(0)
CONFIG = ppo.PpoConfig(
    num_envs=16,
    unroll_length=8,
    num_epochs=4,
    num_minibatches=2,
    hidden_sizes=(16, 16),
    learning_rate=1e-3,
    discount=probes.DISCOUNT,
    entropy_weight=0.0,
    # The probes' rewards have no noise: normalised, the last small advantages would become it.
    normalize_advantages=False,
)
SMALL = ppo.PpoConfig(
    num_envs=4,
    unroll_length=3,
    num_epochs=2,
    num_minibatches=2,
    hidden_sizes=(8,),
    normalize_observations=True,
)
ENV = probes.episode()


@functools.cache
def trained():
    return probes.train_all(ppo, CONFIG, 300, KEY)


@functools.cache
def fresh():
    return init(KEY)


@functools.cache
def first_rollout():
    return collect(fresh())


@jax.jit
def init(key):
    return ppo.init(key, ENV, SMALL)


@jax.jit
def collect(state):
    return ppo.collect(state, ENV, SMALL)


@jax.jit
def step(state):
    return ppo.step(state, ENV, SMALL)


@pytest.mark.parametrize(("name", "x", "expected"), probes.VALUES)
def test_critic_knows_the_value(name, x, expected):
    value = ppo.value(trained()[name], jnp.array([x]), 1, CONFIG)
    assert value == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(("name", "x", "expected"), probes.ACTIONS)
def test_policy_takes_the_best_action(name, x, expected):
    policy = ppo.policy_of(trained()[name])
    action = ppo.act(policy, jnp.array([x]), KEY, CONFIG, 1, deterministic=True)
    assert action[0] == pytest.approx(expected, abs=0.1)


def test_rollout_stores_true_final_observations_and_time_limits():
    state, rollout = first_rollout()
    x = rollout.transitions.obs_t[..., 0]
    # Episodes of two steps, 0 -> 1 -> 1, and a third step that begins the next one.
    np.testing.assert_array_equal(x, np.tile([[0.0], [1.0], [0.0]], 4))
    np.testing.assert_array_equal(rollout.transitions.next_obs_t[..., 0], np.ones((3, 4)))
    np.testing.assert_array_equal(rollout.truncated_t, x)
    np.testing.assert_array_equal(rollout.transitions.discount_t, np.ones((3, 4)))
    assert state.env_steps == 12


def test_bootstrap_adds_the_final_value_at_time_limits_alone():
    learner, rollout = fresh().learner, first_rollout()[1]
    config = dataclasses.replace(SMALL, reward_scale=3.0)
    after = ppo.bootstrap(learner, rollout, config).transitions
    expected = 3.0 * np.asarray(rollout.transitions.reward_t)
    expected[1] += config.discount * ppo.value(learner, jnp.ones(1), 1, config)
    np.testing.assert_allclose(after.reward_t, expected, rtol=1e-5)
    np.testing.assert_array_equal(after.discount_t, np.tile([[1.0], [0.0], [1.0]], 4))


def test_noise_reaches_what_is_stored_but_not_what_the_policy_drew():
    start = jax.vmap(ENV.reset)(jax.random.split(KEY, 4), jnp.array([0.0, 0.0, 1.0, 1.0]))
    state = jax.jit(lambda: ppo.init(KEY, ENV, SMALL, start))()
    _, rollout = collect(state)
    transitions, drawn = rollout.transitions, jnp.tanh(rollout.raw_action_t)
    as_drawn = np.isclose(transitions.action_t, drawn, atol=1e-5)[..., 0]
    np.testing.assert_array_equal(as_drawn, [[True, True, False, False]] * 3)
    paid = probes.reward(probes.WORLD, transitions.obs_t, transitions.action_t, None)
    np.testing.assert_allclose(transitions.reward_t, paid, rtol=1e-5, atol=1e-6)
    log_prob_t = ppo.log_prob(ppo.policy_of(state.learner), transitions.obs_t, drawn, SMALL)
    np.testing.assert_allclose(rollout.log_prob_t, log_prob_t, atol=1e-3)


def test_learned_reward_that_is_the_environments_own():
    learned = jax.jit(lambda state: ppo.step(state, ENV, SMALL, probes.reward, probes.WORLD))
    probes.assert_close(learned(fresh()), step(fresh()))


def test_reward_function_replaces_the_environments_reward():
    def seven(params, obs_t, action_t, next_obs_t):
        return jnp.full(obs_t.shape[:-1], params)

    _, metrics = jax.jit(lambda state: ppo.step(state, ENV, SMALL, seven, 7.0))(fresh())
    assert metrics["batch_reward"] == 7.0
    assert metrics["env_reward"] < 1.0


def test_observation_statistics_are_those_of_the_observations_seen():
    stats = step(fresh())[0].learner.obs_stats
    assert int(stats.count) == 12
    np.testing.assert_allclose(stats.mean, 1 / 3, rtol=1e-5)
    np.testing.assert_allclose(stats.std, np.sqrt(2) / 3, rtol=1e-5)


def test_population_equals_its_members():
    keys = jax.random.split(KEY, 2)
    axes = ppo.population_axes(fresh())

    @jax.jit
    def population(keys):
        start = jax.vmap(lambda key: ppo.init(key, ENV, SMALL), out_axes=axes)(keys)
        return jax.vmap(
            lambda state: ppo.train(state, ENV, SMALL, 2), in_axes=(axes,), out_axes=(axes, 0)
        )(start)

    together, _ = population(keys)
    assert (together.env_steps, together.updates) == (24, 8)
    for i, key in enumerate(keys):
        alone, _ = step(step(init(key))[0])
        probes.assert_close(probes.take(together.learner, i), alone.learner)


def test_environment_is_traced_once_per_program():
    env = probes.episode()
    state = fresh()
    train = jax.jit(lambda state: ppo.train(state, env, SMALL, 2))
    for _ in range(3):
        state, _ = train(state)
    assert env.env.num_traces == 1
    assert state.env_steps == 72


def test_networks_made_under_one_trace_serve_the_next():
    config = dataclasses.replace(SMALL, hidden_sizes=(4,))
    first, second = (jax.jit(lambda key: ppo.init_learner(key, 1, 1, config))(KEY) for _ in "ab")
    probes.assert_equal(first, second)


def test_restored_state_goes_on_bit_for_bit(tmp_path):
    halfway, _ = step(fresh())
    checkpoint.save(tmp_path / "state", halfway)
    restored = checkpoint.load(tmp_path / "state", jax.eval_shape(fresh))
    probes.assert_equal(restored, halfway)
    probes.assert_equal(step(restored), step(halfway))


def test_update_is_the_same_without_jit():
    learner = fresh().learner
    batch = ppo.bootstrap(learner, first_rollout()[1], SMALL)
    eager = ppo.update(learner, batch, KEY, SMALL)
    jitted = jax.jit(lambda *args: ppo.update(*args, SMALL))(learner, batch, KEY)
    probes.assert_close(jitted, eager)


def test_policies_of_sac_and_ppo_are_interchangeable():
    sac_config = sac.SacConfig(hidden_sizes=SMALL.hidden_sizes, normalize_observations=True)
    policy = sac.policy_of(sac.init_learner(KEY, 1, 1, sac_config))
    state = jax.jit(lambda: ppo.init(KEY, ENV, SMALL, policy_params=policy))()
    probes.assert_equal(ppo.policy_of(state.learner), policy)
    obs_t, action_t = jnp.array([[0.3], [-2.0]]), jnp.array([[0.5], [1.0]])
    np.testing.assert_array_equal(
        ppo.act(policy, obs_t, KEY, SMALL, 1), sac.act(policy, obs_t, KEY, sac_config, 1)
    )
    np.testing.assert_array_equal(
        ppo.log_prob(policy, obs_t, action_t, SMALL),
        sac.log_prob(policy, obs_t, action_t, sac_config),
    )


@pytest.mark.parametrize(
    "setting",
    [
        {"num_envs": 0},
        {"num_envs": 9, "num_minibatches": 2},
        {"unroll_length": 0},
        {"num_epochs": 0},
        {"learning_rate": 0.0},
        {"discount": 1.0},
        {"gae_lambda": 1.1},
        {"clip_epsilon": 0.0},
        {"entropy_weight": -1.0},
    ],
)
def test_config_refuses(setting):
    with pytest.raises(UsageError, match=next(iter(setting))):
        ppo.PpoConfig(**setting)
