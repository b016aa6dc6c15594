import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from jax.flatten_util import ravel_pytree

from represent_jax.agents import sac
from represent_jax.errors import UsageError
from represent_jax.methods.population import Population
from represent_jax.runs import checkpoint

KEY = jax.random.PRNGKey(0)
CONFIG = sac.SacConfig(
    num_envs=8,
    updates_per_step=8,
    batch_size=64,
    buffer_capacity=4_096,
    warmup_env_steps=256,
    hidden_sizes=(16, 16),
    learning_rate=3e-3,
    discount=probes.DISCOUNT,
    target_update_rate=0.05,
    # The values are those without an entropy bonus.
    initial_temperature=1e-3,
    learn_temperature=False,
)
SMALL = sac.SacConfig(
    num_envs=4,
    updates_per_step=2,
    batch_size=8,
    buffer_capacity=64,
    warmup_env_steps=12,
    hidden_sizes=(8,),
    normalize_observations=True,
)
ENV = probes.episode()


@functools.cache
def trained():
    return probes.train_all(sac, CONFIG, 150, KEY)


@functools.cache
def fresh():
    return init(KEY)


@jax.jit
def init(key):
    return sac.init(key, ENV, SMALL)


@jax.jit
def step(state):
    return sac.step(state, ENV, SMALL)


def rows(state):
    """The transitions in the buffer, in the order of their insertion."""
    buffer = state.buffer
    return sac.replay._unflatten(buffer.data[: int(buffer.inserted)], 1, 1)


@pytest.mark.parametrize(("name", "x", "expected"), probes.VALUES)
def test_critics_know_the_value(name, x, expected):
    learner, obs_t = trained()[name], jnp.array([x])
    action_t = sac.act(sac.policy_of(learner), obs_t, KEY, CONFIG, 1, deterministic=True)
    critic = sac.make_networks(1, 1, CONFIG).sac.q_network
    values = critic.apply(learner.obs_stats, learner.q_params, obs_t, action_t)
    assert values.shape == (2,)
    np.testing.assert_allclose(values, expected, atol=0.1)


@pytest.mark.parametrize(("name", "x", "expected"), probes.ACTIONS)
def test_policy_takes_the_best_action(name, x, expected):
    policy = sac.policy_of(trained()[name])
    action = sac.act(policy, jnp.array([x]), KEY, CONFIG, 1, deterministic=True)
    assert action[0] == pytest.approx(expected, abs=0.1)


def test_warm_up_stores_true_final_observations_and_no_termination():
    state = fresh()
    assert (state.env_steps, state.updates, state.buffer.inserted) == (12, 0, 12)
    stored = rows(state)
    # Episodes of two steps, 0 -> 1 -> 1, and a third step that begins the next one.
    np.testing.assert_array_equal(stored.obs_t[:, 0], np.repeat([0.0, 1.0, 0.0], 4))
    np.testing.assert_array_equal(stored.next_obs_t, np.ones((12, 1)))
    np.testing.assert_array_equal(stored.discount_t, np.ones(12))
    paid = probes.reward(probes.WORLD, stored.obs_t, stored.action_t, stored.next_obs_t)
    np.testing.assert_allclose(stored.reward_t, paid, rtol=1e-5, atol=1e-6)


def test_termination_is_stored():
    env = probes.episode(probes.PROBES["delayed"])
    state, transitions = jax.jit(lambda state: sac.collect(state, env, SMALL))(fresh())
    # The episodes are one step old; the probe terminates at their second.
    np.testing.assert_array_equal(transitions.discount_t, np.zeros(4))
    np.testing.assert_array_equal(rows(state).discount_t, [1.0] * 12 + [0.0] * 4)


def test_warm_up_follows_a_given_policy():
    learner = sac.init_learner(KEY, 1, 1, SMALL)
    zeros = jax.tree.map(jnp.zeros_like, learner.policy_params)
    # With a mean of 20 before tanh, every action is 1.
    zeros["params"]["hidden_1"]["bias"] = jnp.array([20.0, 0.0])
    policy = sac.PolicyParams(learner.obs_stats, zeros)
    state = jax.jit(lambda: sac.init(KEY, ENV, SMALL, policy_params=policy))()
    probes.assert_equal(state.learner.policy_params, zeros)
    np.testing.assert_allclose(rows(state).action_t, np.ones((12, 1)), rtol=1e-6)


def test_warm_up_stores_a_learned_reward():
    def seven(params, obs_t, action_t, next_obs_t):
        return jnp.full(obs_t.shape[:-1], params)

    state = jax.jit(lambda: sac.init(KEY, ENV, SMALL, reward_fn=seven, reward_params=7.0))()
    np.testing.assert_array_equal(rows(state).reward_t, np.full(12, 7.0))


def test_learned_reward_that_is_the_environments_own():
    learned = jax.jit(lambda state: sac.step(state, ENV, SMALL, probes.reward, probes.WORLD))
    probes.assert_close(learned(fresh()), step(fresh()))


def test_recomputed_rewards_of_a_fixed_reward_are_those_stored():
    again = jax.jit(lambda state: sac.step(state, ENV, SMALL, probes.reward, probes.WORLD, True))
    probes.assert_close(again(fresh()), step(fresh()))


def test_recomputed_rewards_are_those_of_the_latest_parameters():
    def reward(params, obs_t, action_t, next_obs_t):
        return jnp.full(obs_t.shape[:-1], params)

    again = jax.jit(lambda state: sac.step(state, ENV, SMALL, reward, 7.0, recompute_rewards=True))
    _, metrics = again(fresh())
    assert metrics["batch_reward"] == 7.0
    assert metrics["env_reward"] < 1.0


def test_observation_statistics_are_those_of_the_observations_seen():
    stats = step(fresh())[0].learner.obs_stats
    # Four steps of four episodes: 0, 1, 0, 1.
    assert int(stats.count) == 16
    np.testing.assert_allclose(stats.mean, 0.5, rtol=1e-5)
    np.testing.assert_allclose(stats.std, 0.5, rtol=1e-5)


def test_population_equals_its_members():
    def run(mode):
        population = Population([jnp.float32(0.0)] * 2, mode, sac.population_axes)
        states = population.init(lambda key, _: sac.init(key, ENV, SMALL), KEY)
        step = population.stepper(lambda state, _: sac.train(state, ENV, SMALL, 2))
        states, _ = step(states)
        return states, population.members(states)

    states, together = run("vmap")
    assert (states.env_steps, states.updates, states.buffer.inserted) == (20, 4, 20)
    # Here every member is a call of its own.
    _, alone = run("threads")
    for member, expected in zip(together, alone, strict=True):
        probes.assert_close(member, expected)


def test_environment_is_traced_once_per_program():
    env = probes.episode()
    jax.eval_shape(lambda key: sac.init(key, env, SMALL), KEY)
    assert env.env.num_traces == 1
    state = fresh()
    train = jax.jit(lambda state: sac.train(state, env, SMALL, 2))
    for _ in range(3):
        state, _ = train(state)
    assert env.env.num_traces == 2
    assert state.env_steps == 36


def test_restored_state_goes_on_bit_for_bit(tmp_path):
    halfway, _ = step(fresh())
    checkpoint.save(tmp_path / "state", halfway)
    restored = checkpoint.load(tmp_path / "state", jax.eval_shape(fresh))
    probes.assert_equal(restored, halfway)
    probes.assert_equal(step(restored), step(halfway))


def test_update_is_the_same_without_jit():
    learner, batch = fresh().learner, probes.take(rows(fresh()), slice(8))
    eager = sac.update(learner, batch, KEY, SMALL)
    jitted = jax.jit(lambda *args: sac.update(*args, SMALL))(learner, batch, KEY)
    probes.assert_close(jitted, eager)


def test_density_integrates_to_one():
    policy = sac.policy_of(fresh().learner)
    action_t = jnp.linspace(-1.0, 1.0, 2_001)[:, None]
    obs_t = jnp.full_like(action_t, 0.3)
    density = jnp.exp(sac.log_prob(policy, obs_t, action_t, SMALL))
    assert jnp.trapezoid(density, action_t[:, 0]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    "setting",
    [
        {"num_envs": 0},
        {"updates_per_step": 0},
        {"batch_size": 0},
        {"warmup_env_steps": 0},
        {"buffer_capacity": 100, "num_envs": 64},
        {"buffer_capacity": 0},
        {"discount": 1.0},
        {"learning_rate": 0.0},
    ],
)
def test_config_refuses(setting):
    with pytest.raises(UsageError, match=next(iter(setting))):
        sac.SacConfig(**setting)


def test_without_rewards_the_actor_returns_to_the_policy_it_started_from():
    """On critics that say nothing, only -log pi_1 is left to minimise."""
    config = dataclasses.replace(SMALL, prior_weight=1.0, initial_temperature=1e-4)
    config = dataclasses.replace(config, normalize_observations=False, learn_temperature=False)
    first = sac.init_learner(jax.random.PRNGKey(3), ENV.observation_size, ENV.action_size, config)
    # pi_1 prefers an action far from where the actor begins.
    bias = jnp.zeros(2 * ENV.action_size).at[: ENV.action_size].set(1.0)
    shifted = jax.tree_util.tree_map_with_path(
        lambda path, x: x + bias if x.shape == bias.shape else x, first.policy_params
    )
    prior = sac.policy_of(first)._replace(policy=shifted)
    state = sac.init(KEY, ENV, config, policy_params=prior)
    assert state.learner.prior is not None
    learner = state.learner.replace(
        policy_params=first.policy_params, q_params=jax.tree.map(jnp.zeros_like, first.q_params)
    )
    state = state.replace(learner=learner.replace(target_q_params=learner.q_params))
    _, batches = sac.draw(state, ENV, config)
    batch = jax.tree.map(lambda x: x[0], batches)
    batch = batch._replace(reward_t=jnp.zeros_like(batch.reward_t))
    frozen = state.learner.q_params

    @jax.jit
    def update(learner, key):
        learner, _ = sac.update(learner, batch, key, config)
        return learner.replace(q_params=frozen, target_q_params=frozen), None

    def distance(learner):
        act = functools.partial(sac.act, key=KEY, config=config, action_dim=ENV.action_size)
        own = act(sac.policy_of(learner), batch.obs_t, deterministic=True)
        return float(jnp.abs(own - act(prior, batch.obs_t, deterministic=True)).mean())

    before = distance(state.learner)
    after, _ = jax.lax.scan(update, state.learner, jax.random.split(KEY, 1_500))
    assert before > 0.3 and distance(after) < 0.3 * before


def test_a_share_of_the_prior_is_a_smaller_weight_and_temperature():
    small = {"normalize_observations": False, "learn_temperature": False}
    whole = dataclasses.replace(SMALL, prior_weight=0.4, initial_temperature=0.8, **small)
    half = dataclasses.replace(whole, prior_weight=0.2, initial_temperature=0.4)
    first = sac.policy_of(sac.init_learner(KEY, ENV.observation_size, ENV.action_size, whole))

    def trained(config, prior_share):
        state = sac.init(KEY, ENV, config, policy_params=first)
        learner = sac.train(state, ENV, config, 2, prior_share=prior_share)[0].learner
        return ravel_pytree((learner.policy_params, learner.q_params))[0]

    expected = trained(half, 1.0)
    np.testing.assert_allclose(trained(whole, jnp.float32(0.5)), expected, atol=1e-5)
    assert np.abs(trained(whole, 1.0) - expected).max() > 1e-4


def test_without_a_weight_no_prior_is_kept():
    first = sac.policy_of(sac.init_learner(KEY, ENV.observation_size, ENV.action_size, SMALL))
    assert sac.init(KEY, ENV, SMALL, policy_params=first).learner.prior is None


def test_normalised_critics_are_bounded_however_far_the_action():
    """A hidden layer of unit spread caps the value at sqrt(units) times the last layer's norm."""
    far = jnp.full((1, 1), 1e6)

    def values(config):
        learner = sac.init_learner(KEY, 1, 1, config)
        critic = sac.make_networks(1, 1, config).sac.q_network
        said = critic.apply(learner.obs_stats, learner.q_params, jnp.zeros((1, 1)), far)
        heads = jax.tree.leaves(
            jax.tree.map(
                lambda x: jnp.linalg.norm(x) if x.shape == (config.hidden_sizes[-1], 1) else None,
                learner.q_params,
            )
        )
        return np.abs(np.asarray(said)[0]), np.sqrt(config.hidden_sizes[-1]) * np.asarray(heads)

    said, bound = values(dataclasses.replace(CONFIG, critic_layer_norm=True))
    assert said.shape == bound.shape == (2,) and np.all(said <= bound * (1 + 1e-5))
    said, bound = values(CONFIG)
    assert np.all(said > bound)


@pytest.mark.parametrize("counts", [True, False])
def test_critics_count_the_entropy_only_where_they_should(counts):
    config = dataclasses.replace(SMALL, critic_entropy=counts)
    state = sac.init(KEY, ENV, config)
    _, batches = sac.draw(state, ENV, config)
    batch = jax.tree.map(lambda x: x[0], batches)

    def critics(log_temperature):
        learner = state.learner.replace(log_temperature=jnp.float32(log_temperature))
        return jax.tree.leaves(sac.update(learner, batch, KEY, config)[0].q_params)

    same = [np.array_equal(a, b) for a, b in zip(critics(-5.0), critics(0.0), strict=True)]
    assert all(same) != counts


def test_staggered_episodes_end_at_different_times():
    config = dataclasses.replace(SMALL, num_envs=64, buffer_capacity=640, warmup_env_steps=64)
    together, apart = (
        sac.init(KEY, ENV, dataclasses.replace(config, staggered=staggered)).env_state.info["steps"]
        for staggered in (False, True)
    )
    assert np.all(np.asarray(together) == 1)
    assert set(np.unique(apart)) == set(range(ENV.horizon))
