"""BC-RNN: its losses in closed form, its memory in training and in rollouts, and what it learns."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.errors import UsageError
from represent_jax.stages import bc_rnn
from represent_jax.stages.bc_rnn import BcRnnConfig, BcRnnParams, Sequences

KEY = jax.random.PRNGKey(0)
CONFIG = BcRnnConfig(
    num_updates=400,
    batch_size=32,
    sequence_length=5,
    hidden_size=16,
    num_layers=2,
    mlp_sizes=(8,),
    learning_rate=1e-2,
)
LOSS = jax.jit(bc_rnn.loss, static_argnums=2)
UNROLL = jax.jit(bc_rnn.unroll, static_argnums=(2, 3))
ACT = jax.jit(bc_rnn.act, static_argnums=(4, 5))
SAMPLE = jax.jit(bc_rnn.sample_sequences, static_argnums=2)


def _batch(obs, actions, lengths=None):
    num, horizon, _ = actions.shape
    lengths = np.full(num, horizon) if lengths is None else np.asarray(lengths)
    # Numpy, as demonstrations come from disk.
    return TrajectoryBatch(
        obs=np.asarray(obs, np.float32),
        actions=np.asarray(actions, np.float32),
        rewards=np.zeros((num, horizon), np.float32),
        mask=(np.arange(horizon) < lengths[:, None]).astype(np.float32),
        strategy=np.zeros(num, np.int32),
        noise_level=np.zeros(num, np.float32),
    )


def _random_batch(num=3, horizon=12, obs_dim=2, action_dim=2, lengths=None):
    rng = np.random.default_rng(0)
    obs = rng.normal(3.0, 2.0, (num, horizon + 1, obs_dim))
    return _batch(obs, rng.uniform(-1.0, 1.0, (num, horizon, action_dim)), lengths)


def _init(demonstrations, config):
    return jax.jit(lambda: bc_rnn.init(KEY, demonstrations, config))()


@pytest.fixture(scope="module")
def params():
    return _init(_random_batch(), CONFIG).params


def _with_constant_output(params, output):
    """Makes the network's last layer ignore its input, and as wide as the output."""
    layers = dict(params.network["params"])
    output = jnp.asarray(output, jnp.float32)
    layers["output"] = {"kernel": jnp.zeros((CONFIG.mlp_sizes[-1], output.size)), "bias": output}
    return params._replace(network={"params": layers})


def _masked_sequences():
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.0, 1.0, (2, 3, 2))
    mask = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    actions[mask == 0.0] = 100.0
    obs = rng.normal(size=(2, 3, 2))
    return Sequences(jnp.asarray(obs), jnp.asarray(actions), jnp.asarray(mask))


def test_l2_loss_is_the_mean_squared_error_of_running_steps(params):
    sequences = _masked_sequences()
    output = np.array([0.3, -2.0])
    actions = np.asarray(sequences.actions)
    running = np.concatenate([actions[0], actions[1, :1]])
    expected = np.mean((np.tanh(output) - running) ** 2)
    found = LOSS(_with_constant_output(params, output), sequences, CONFIG)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_gmm_loss_is_the_negative_log_likelihood_of_running_steps(params):
    config = dataclasses.replace(CONFIG, head="gmm", num_modes=2)
    sequences = _masked_sequences()
    logits = np.array([0.2, -0.7])
    means = np.array([[0.3, -2.0], [1.0, 0.1]])
    scales = np.array([[-1.0, 0.5], [0.0, 2.0]])
    output = np.concatenate([logits, means.ravel(), scales.ravel()])
    weights = np.exp(logits) / np.sum(np.exp(logits))
    std = np.log1p(np.exp(scales)) + 1e-4
    actions = np.asarray(sequences.actions, np.float64)
    running = np.concatenate([actions[0], actions[1, :1]])
    z = (running[:, None] - np.tanh(means)) / std
    density = np.prod(np.exp(-0.5 * z**2) / (std * math.sqrt(2 * math.pi)), axis=-1)
    expected = -np.mean(np.log(density @ weights))
    found = LOSS(_with_constant_output(params, output), sequences, config)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_sequences_are_whole_windows_of_one_episode_each_as_likely_as_another():
    lengths, horizon = np.array([3, 7, 12]), 12
    number = np.arange(3 * (horizon + 1)).reshape(3, horizon + 1, 1)
    demonstrations = _batch(number, number[:, :-1] + 0.5, lengths)
    config = dataclasses.replace(CONFIG, batch_size=6_000)
    sequences = jax.tree.map(np.asarray, SAMPLE(KEY, demonstrations, config))
    owner, first = np.divmod(sequences.obs[:, 0, 0].astype(int), horizon + 1)
    steps = first[:, None] + np.arange(5)
    running = sequences.mask == 1.0
    np.testing.assert_array_equal(running, steps < lengths[owner][:, None])
    # Only the episode of three steps is shorter than a window.
    np.testing.assert_array_equal(running.sum(axis=1), np.where(owner == 0, 3, 5))
    expected = owner[:, None] * (horizon + 1) + steps
    np.testing.assert_array_equal(sequences.obs[running][:, 0], expected[running])
    np.testing.assert_array_equal(sequences.actions[running][:, 0], expected[running] + 0.5)
    # Windows: 1 of the first episode, 3 of the second, 8 of the third.
    _, counts = np.unique(sequences.obs[:, 0, 0], return_counts=True)
    assert len(counts) == 12
    np.testing.assert_allclose(counts, 500, atol=100)


def test_a_window_may_be_longer_than_every_episode():
    demonstrations = _random_batch(horizon=4, lengths=[4, 2, 3])
    sequences = SAMPLE(KEY, demonstrations, CONFIG)
    assert sequences.obs.shape == (32, 5, 2)
    assert set(np.asarray(sequences.mask).sum(axis=1)) == {2.0, 3.0, 4.0}


def test_observations_are_standardised_by_the_steps_that_were_acted_on(params):
    lengths = [12, 4, 7]
    demonstrations = _random_batch(lengths=lengths)
    mean, std = jax.jit(lambda: bc_rnn.init(KEY, demonstrations, CONFIG).params[:2])()
    acted = np.concatenate([o[:n] for o, n in zip(demonstrations.obs, lengths, strict=True)])
    np.testing.assert_allclose(mean, acted.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(std, acted.std(axis=0) + 1e-3, rtol=1e-5)
    obs = demonstrations.obs
    np.testing.assert_allclose(
        UNROLL(BcRnnParams(mean, std, params.network), obs, CONFIG, 2),
        UNROLL(BcRnnParams(0.0 * mean, std / std, params.network), (obs - mean) / std, CONFIG, 2),
        rtol=1e-5,
        atol=1e-6,
    )


def test_defaults_have_the_sizes_of_robomimic():
    config = BcRnnConfig()
    state = jax.eval_shape(lambda: bc_rnn.init(KEY, _random_batch(obs_dim=7), config))
    found = sum(leaf.size for leaf in jax.tree.leaves(state.params.network))
    lstm = 4 * 400 * (7 + 400 + 1) + 4 * 400 * (400 + 400 + 1)
    assert found == lstm + 400 * 2 + 2
    assert (config.batch_size, config.sequence_length, config.learning_rate) == (100, 10, 1e-4)


def test_sequences_and_their_loss_are_the_same_without_jit(params):
    demonstrations = _random_batch(lengths=[12, 4, 7])
    compiled = SAMPLE(KEY, demonstrations, CONFIG)
    compiled_loss = LOSS(params, compiled, CONFIG)
    with jax.disable_jit():
        plain = bc_rnn.sample_sequences(KEY, demonstrations, CONFIG)
        plain_loss = bc_rnn.loss(params, plain, CONFIG)
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(compiled_loss, plain_loss, rtol=1e-5)


def _act_through(params, obs, config, action_dim):
    """Iterates `act` from a fresh carry; actions, `[num_episodes, num_steps, action_dim]`."""

    def body(carry, row):
        obs_t, key = row
        return bc_rnn.act(params, carry, obs_t, key, config, action_dim)

    obs = jnp.swapaxes(jnp.asarray(obs), 0, 1)
    start = bc_rnn.initial_carry(obs.shape[1], config)
    keys = jax.random.split(KEY, obs.shape[0])
    carry, actions = jax.jit(lambda: jax.lax.scan(body, start, (obs, keys)))()
    return carry, np.swapaxes(np.asarray(actions), 0, 1)


def test_acting_step_by_step_is_the_unroll_of_training(params):
    config = dataclasses.replace(CONFIG, reset_every=0)
    batch = _random_batch()
    carry, actions = _act_through(params, batch.obs, config, 2)
    expected = jnp.tanh(UNROLL(params, batch.obs, config, 2))
    np.testing.assert_allclose(actions, expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(carry.steps, [13, 13, 13])


@pytest.mark.parametrize(("reset_every", "period"), [(None, 5), (4, 4)])
def test_a_reset_forgets_all_that_came_before(params, reset_every, period):
    config = dataclasses.replace(CONFIG, reset_every=reset_every)
    obs = _random_batch().obs[:, : 2 * period]
    _, actions = _act_through(params, obs, config, 2)
    _, remembered = _act_through(params, obs, dataclasses.replace(config, reset_every=0), 2)
    expected = jnp.tanh(UNROLL(params, obs.reshape(6, period, 2), config, 2))
    expected = expected.reshape(actions.shape)
    np.testing.assert_allclose(actions, expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(actions[:, :period], remembered[:, :period], rtol=1e-4, atol=1e-6)
    assert np.all(np.abs(actions - remembered)[:, period:].max(axis=(0, 2)) > 1e-4)


def test_each_episode_resets_by_its_own_step(params):
    lstm = jax.tree.map(jnp.ones_like, bc_rnn.initial_carry(2, CONFIG).lstm)
    obs_t = jnp.tile(_random_batch().obs[:1, 0], (2, 1))
    carry = bc_rnn.BcRnnCarry(lstm, jnp.array([5, 6]))
    after, action_t = ACT(params, carry, obs_t, KEY, CONFIG, 2)
    np.testing.assert_array_equal(after.steps, [6, 7])
    fresh = jnp.tanh(UNROLL(params, obs_t[:, None], CONFIG, 2))[:, 0]
    np.testing.assert_allclose(action_t[0], fresh[0], rtol=1e-4, atol=1e-6)
    assert float(jnp.max(jnp.abs(action_t[1] - fresh[1]))) > 1e-3


def _learn(state, demonstrations, config):
    train = jax.jit(bc_rnn.train, static_argnums=(2, 3))
    return bc_rnn.finish(train(state, demonstrations, config, config.num_updates)[0])


def test_memory_is_learned_that_a_memoryless_policy_lacks():
    """The action is the observation before, of which the current one says nothing."""
    rng = np.random.default_rng(2)
    obs = rng.uniform(-0.9, 0.9, (60, 13, 1))
    before = np.concatenate([np.zeros((60, 1, 1)), obs[:, :-2]], axis=1)
    train, unseen = _batch(obs[:40], before[:40]), _batch(obs[40:], before[40:])
    config = dataclasses.replace(CONFIG, num_layers=1, mlp_sizes=())
    params = _learn(_init(train, config), train, config)

    def error(reset_every):
        acting = dataclasses.replace(config, reset_every=reset_every)
        _, actions = _act_through(params, unseen.obs[:, :-1], acting, 1)
        return np.mean((actions - unseen.actions) ** 2)

    variance = np.mean(unseen.actions**2)
    assert error(reset_every=0) < 0.05 * variance
    # Without memory, nothing does better than the mean.
    assert error(reset_every=1) > 0.8 * variance


def test_gmm_acts_by_its_modes_not_by_their_mean():
    sign = np.random.default_rng(3).choice([-1.0, 1.0], (40, 1, 1))
    # Both dimensions have the sign of the episode, which no observation tells.
    demonstrations = _batch(np.zeros((40, 11, 1)), np.tile(0.8 * sign, (1, 10, 2)))
    config = dataclasses.replace(
        CONFIG, head="gmm", num_modes=2, sequence_length=1, num_layers=1, mlp_sizes=()
    )
    params = _learn(_init(demonstrations, config), demonstrations, config)
    carry = bc_rnn.initial_carry(400, config)
    _, action_t = ACT(params, carry, jnp.zeros((400, 1)), KEY, config, 2)
    action_t = np.asarray(action_t)
    np.testing.assert_allclose(np.abs(action_t), 0.8, atol=0.05)
    np.testing.assert_array_equal(action_t[:, 0] > 0.0, action_t[:, 1] > 0.0)
    assert abs(np.mean(action_t[:, 0] > 0.0) - np.mean(sign == 1.0)) < 0.1


def test_actions_stay_in_bounds_where_a_mode_lies_on_one(params):
    config = dataclasses.replace(CONFIG, head="gmm", num_modes=1)
    params = _with_constant_output(params, [0.0, 50.0, -50.0, 0.0, 0.0])
    obs_t = jnp.zeros((50, 2))
    _, action_t = ACT(params, bc_rnn.initial_carry(50, config), obs_t, KEY, config, 2)
    assert float(jnp.max(jnp.abs(action_t))) == 1.0
    np.testing.assert_allclose(action_t, np.tile([1.0, -1.0], (50, 1)), atol=1e-3)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("num_updates", 0),
        ("batch_size", 0),
        ("sequence_length", 0),
        ("hidden_size", 0),
        ("num_layers", 0),
        ("num_modes", 0),
        ("mlp_sizes", (8, 0)),
        ("learning_rate", 0.0),
        ("head", "vae"),
        ("reset_every", -1),
    ],
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(UsageError, match=field):
        BcRnnConfig(**{field: value})
