"""D-REX's reward: sampling and loss in closed form, and a synthetic problem with a known answer."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.errors import RepresentError, UsageError
from represent_jax.stages import preference
from represent_jax.stages.preference import Pairs, PreferenceConfig

CONFIG = PreferenceConfig(
    num_updates=150,
    num_pairs=32,
    snippet_steps=8,
    hidden_sizes=(16, 16),
    learning_rate=1e-2,
    kernel_scale=0.1,
    l2=1e-4,
    ensemble_size=2,
)
LINEAR = dataclasses.replace(CONFIG, hidden_sizes=())

_init = jax.jit(preference.init, static_argnums=(1, 2))
_sample = jax.jit(preference.sample_pairs, static_argnums=(2, 3))
_step = jax.jit(preference.step, static_argnums=2)


def _batch(obs, noise_level, lengths=None):
    num, steps_plus_one, _ = obs.shape
    horizon = steps_plus_one - 1
    lengths = np.full(num, horizon) if lengths is None else np.asarray(lengths)
    return TrajectoryBatch(
        obs=np.asarray(obs, np.float32),
        actions=np.zeros((num, horizon, 1), np.float32),
        rewards=np.zeros((num, horizon), np.float32),
        mask=(np.arange(horizon) < lengths[:, None]).astype(np.float32),
        strategy=np.zeros(num, np.int32),
        noise_level=np.asarray(noise_level, np.float32),
    )


def _labelled(noise_level, horizon, lengths=None):
    """Observations that say which trajectory and which step they are."""
    num = len(noise_level)
    trajectory, step = np.meshgrid(np.arange(num), np.arange(horizon + 1), indexing="ij")
    return _batch(np.stack([trajectory, step], axis=-1), noise_level, lengths)


def _linear(kernel, bias, ensemble_size=None):
    params = {
        "params": {"Dense_0": {"kernel": np.array(kernel)[:, None], "bias": np.array([bias])}}
    }
    params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
    if ensemble_size is None:
        return params
    return jax.tree.map(lambda x: jnp.stack([x] * ensemble_size), params)


def _synthetic(seed, num=40, horizon=30):
    """Less noise means more of x; y says nothing and has the larger spread."""
    levels = np.linspace(0.0, 1.0, num)
    noise = np.random.default_rng(seed).normal(size=(num, horizon + 1, 2)) * [0.5, 1.0]
    centre = np.stack([1.0 - 2.0 * levels, np.zeros(num)], axis=-1)
    return _batch(centre[:, None] + noise, levels)


def test_loss_of_a_known_reward_on_known_snippets():
    inputs = np.array([[[[1.0], [2.0]], [[0.5], [9.0]]], [[[-1.0], [0.0]], [[3.0], [1.0]]]])
    mask = np.array([[[1.0, 1.0], [1.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]]])
    config = dataclasses.replace(LINEAR, l2=0.01)
    total, metrics = preference.loss(
        _linear([0.5], 0.1), Pairs(jnp.asarray(inputs), jnp.asarray(mask)), config
    )
    # Sums: 0.5 * 3 + 0.2 against 0.5 * 0.5 + 0.1, and -0.5 + 0.2 against 2 + 0.2.
    cross_entropy = np.mean(np.log1p(np.exp([-(1.7 - 0.35), -(-0.3 - 2.2)])))
    np.testing.assert_allclose(total, cross_entropy + 0.01 * 0.25, rtol=1e-6)
    np.testing.assert_allclose(metrics["loss"], total)
    np.testing.assert_allclose(metrics["l2_loss"], 0.01 * 0.25, rtol=1e-6)
    np.testing.assert_allclose(metrics["accuracy"], 0.5)


def test_sampled_pairs_respect_the_gap_and_are_equally_likely():
    # Of these decimals several lie less than 0.3 apart in float32.
    levels = np.array([0.35, 0.05, 0.65, 0.3, 0.95, 0.0, 0.0], np.float32)
    num_pairs = 20_000
    pairs = _sample(jax.random.PRNGKey(0), _labelled(levels, 10), num_pairs, CONFIG)
    better, worse = np.asarray(pairs.inputs[:, :, 0, 0], int).T
    found = {(i, j): n for i, j, n in zip(*_counts(better, worse), strict=True)}
    exact = np.round(levels.astype(np.float64), 2)
    admissible = {
        (i, j)
        for i in range(len(levels))
        for j in range(len(levels))
        if round(exact[j] - exact[i], 2) >= 0.3
    }
    assert set(found) == admissible
    expected = num_pairs / len(admissible)
    assert all(abs(n - expected) < 5.0 * np.sqrt(expected) for n in found.values())


def _counts(first, second):
    pairs, counts = np.unique(np.stack([first, second]), axis=1, return_counts=True)
    return (*pairs.tolist(), counts.tolist())


def test_snippets_are_consecutive_running_steps_with_independent_uniform_starts():
    lengths = np.array([3, 8, 10, 20])
    batch = _labelled([0.0, 0.5, 0.1, 0.6], 20, lengths)
    pairs = _sample(jax.random.PRNGKey(0), batch, 5000, CONFIG)
    owner, step = np.asarray(pairs.inputs[..., 0, 0], int), np.asarray(pairs.inputs[..., 1])
    mask = np.asarray(pairs.mask)
    # The input is the state after the step: 1 to length.
    length = np.minimum(lengths, CONFIG.snippet_steps)[owner]
    np.testing.assert_array_equal(mask, np.arange(8) < length[..., None])
    first = step[..., 0]
    expected = first[..., None] + np.arange(8)
    np.testing.assert_array_equal(step[mask == 1.0], expected[mask == 1.0])
    last = first + length - 1
    assert first.min() >= 1 and np.all(last <= lengths[owner])
    for trajectory, num_starts in enumerate(lengths - np.minimum(lengths, 8) + 1):
        starts, counts = np.unique(first[owner == trajectory], return_counts=True)
        assert starts.tolist() == list(range(1, num_starts + 1))
        assert counts.min() > 0.6 * counts.mean()
    together = np.all(owner == [2, 3], axis=1)
    assert abs(np.corrcoef(first[together].T)[0, 1]) < 0.1


def test_a_snippet_longer_than_the_horizon_is_the_whole_episode():
    config = dataclasses.replace(CONFIG, snippet_steps=50)
    pairs = _sample(jax.random.PRNGKey(0), _labelled([0.0, 1.0], 6, [6, 4]), 3, config)
    np.testing.assert_array_equal(pairs.inputs[:, 0, :, 1], np.tile(np.arange(1, 7), (3, 1)))
    np.testing.assert_array_equal(jnp.sum(pairs.mask, axis=-1), [[6, 4]] * 3)


def test_levels_without_a_pair_are_refused():
    preference.check_levels(np.array([0.35, 0.65], np.float32), CONFIG)
    with pytest.raises(RepresentError, match=r"min_level_gap \(0.3\).*0.1 to 0.35"):
        preference.check_levels(np.array([0.1, 0.2, 0.35]), CONFIG)
    with pytest.raises(RepresentError, match="no trajectories"):
        preference.check_levels(np.zeros(0), CONFIG)


def test_reward_is_the_mean_of_the_ensemble_on_the_next_state():
    members = [_linear([1.0, 0.0], 0.5), _linear([0.0, -3.0], 0.0)]
    params = jax.tree.map(lambda *x: jnp.stack(x), *members)
    next_obs = jnp.array([[[1.0, 2.0], [3.0, 4.0]]])
    found = preference.reward(params, None, None, next_obs, LINEAR)
    np.testing.assert_allclose(found, [[(1.5 - 6.0) / 2, (3.5 - 12.0) / 2]], rtol=1e-6)


def test_known_reward_is_recovered():
    batch = _synthetic(0)
    state = _init(jax.random.PRNGKey(1), 2, CONFIG)
    train = jax.jit(lambda state: preference.train(state, batch, CONFIG, CONFIG.num_updates))
    state, metrics = train(state)
    # Without having learned anything it would be log 2.
    assert float(metrics["loss"]) < 0.3
    unseen = np.random.default_rng(2).uniform(-1.0, 1.0, (200, 2)).astype(np.float32)
    learned = preference.reward(state.params, None, None, unseen, CONFIG)
    assert np.corrcoef(unseen[:, 0], learned)[0, 1] > 0.9
    accuracy = jax.jit(preference.pair_accuracy, static_argnums=(2, 4))(
        state.params, _synthetic(3), CONFIG, jax.random.PRNGKey(4), 500
    )
    assert float(accuracy) > 0.9


def test_every_member_has_pairs_of_its_own():
    state = _init(jax.random.PRNGKey(0), 2, LINEAR)
    equal = state.replace(params=_linear([0.1, 0.2], 0.0, LINEAR.ensemble_size))
    after, _ = _step(equal, _synthetic(0, num=6, horizon=12), LINEAR)
    first, second = after.opt[0].mu["params"]["Dense_0"]["kernel"]
    assert not np.allclose(first, second)


def test_ranking_accuracy_counts_admissible_pairs():
    levels = jnp.array([0.0, 0.2, 0.5, 0.9])
    accuracy = jax.jit(lambda returns: preference.ranking_accuracy(levels, returns, 0.3))
    assert float(accuracy(jnp.array([4.0, 3.0, 2.0, 1.0]))) == 1.0
    assert float(accuracy(jnp.array([1.0, 2.0, 3.0, 4.0]))) == 0.0
    # The first two are too close to be compared.
    assert float(accuracy(jnp.array([3.0, 4.0, 2.0, 1.0]))) == 1.0
    # Of the five pairs (0, 2) disagrees and (1, 2) is a tie.
    np.testing.assert_allclose(accuracy(jnp.array([2.0, 3.0, 3.0, 1.0])), 3.5 / 5.0)
    key = jax.random.PRNGKey(0)
    unrelated = preference.ranking_accuracy(
        jnp.linspace(0.0, 1.0, 300), jax.random.normal(key, (300,)), 0.3
    )
    assert 0.4 < float(unrelated) < 0.6
    assert np.isnan(preference.ranking_accuracy(levels, levels, 1.0))


def test_pair_accuracy_of_a_known_reward():
    levels = np.linspace(0.0, 1.0, 6)
    batch = _batch(np.tile(-levels[:, None, None], (1, 21, 1)), levels)
    accuracy = jax.jit(
        lambda params: preference.pair_accuracy(params, batch, LINEAR, jax.random.PRNGKey(0), 45)
    )
    for kernel, expected in ((1.0, 1.0), (-1.0, 0.0), (0.0, 0.5)):
        assert float(accuracy(_linear([kernel], 0.0, LINEAR.ensemble_size))) == expected


def test_step_is_the_same_without_jit():
    batch = _synthetic(0, num=6, horizon=12)
    # Were all snippets as long, the bias would cancel and Adam would step by what rounding leaves.
    batch = batch._replace(mask=batch.mask * (np.arange(12) < 2 * np.arange(6, 0, -1)[:, None]))
    state = _init(jax.random.PRNGKey(1), 2, LINEAR)
    compiled, _ = _step(state, batch, LINEAR)
    with jax.disable_jit():
        plain, _ = preference.step(state, batch, LINEAR)
    for a, b in zip(jax.tree.leaves(compiled), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("num_updates", 0),
        ("num_pairs", 0),
        ("min_level_gap", 0.0),
        ("min_level_gap", 1.1),
        ("snippet_steps", 0),
        ("hidden_sizes", (16, 0)),
        ("learning_rate", 0.0),
        ("kernel_scale", 0.0),
        ("l2", -0.1),
        ("ensemble_size", 0),
    ],
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(UsageError, match=field):
        PreferenceConfig(**{field: value})
