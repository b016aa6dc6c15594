"""Behavioural cloning: loss and division in closed form, and a linear policy to recover."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.errors import RepresentError, UsageError
from represent_jax.stages import bc
from represent_jax.stages.bc import BcConfig
from represent_jax.types import Transition

CONFIG = BcConfig(
    num_updates=1000,
    batch_size=32,
    hidden_sizes=(32, 32),
    learning_rate=3e-3,
    kernel_scale=0.2,
    l2=1e-5,
)
LINEAR = dataclasses.replace(CONFIG, hidden_sizes=())
POLICY = np.array([[0.3, -0.2], [0.1, 0.4], [-0.4, 0.0]], np.float32)


def _rows(obs, actions):
    zeros = np.zeros(len(obs), np.float32)
    return Transition(np.float32(obs), np.float32(actions), np.float32(obs), zeros, zeros, zeros)


def _demonstrations(num, seed=0):
    obs = np.random.default_rng(seed).uniform(-1.0, 1.0, (num, 3))
    return _rows(obs, obs @ POLICY)


def _linear(kernel, bias):
    return {"params": {"Dense_0": {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}}}


def test_loss_sums_over_dimensions_averages_over_rows_and_does_not_clip():
    rows = _rows([[1.0], [2.0]], [[0.5, 0.0], [1.0, -1.0]])
    params = _linear([[1.0, -2.0]], [0.0, 1.0])
    # Outputs (1, -1) and (2, -3).
    error = np.mean([0.5**2 + 1.0, 1.0 + 2.0**2])
    total, metrics = bc.loss(params, rows, dataclasses.replace(LINEAR, l2=0.1))
    np.testing.assert_allclose(metrics["train_loss"], error, rtol=1e-6)
    np.testing.assert_allclose(metrics["l2_loss"], 0.1 * 5.0, rtol=1e-6)
    np.testing.assert_allclose(total, error + 0.5, rtol=1e-6)


def test_actions_are_clipped_when_acting():
    params = _linear([[1.0, -2.0]], [0.0, 1.0])
    action = bc.act(params, jnp.array([[0.5], [2.0]]), jax.random.PRNGKey(0), LINEAR, 2)
    np.testing.assert_allclose(action, [[0.5, 0.0], [1.0, -1.0]])


def test_split_divides_whole_rows_and_follows_its_key():
    demonstrations = _demonstrations(50)
    data = bc.split(jax.random.PRNGKey(0), demonstrations, CONFIG)
    again = bc.split(jax.random.PRNGKey(0), demonstrations, CONFIG)
    other = bc.split(jax.random.PRNGKey(1), demonstrations, CONFIG)
    assert data.train.obs_t.shape == (40, 3) and data.validation.obs_t.shape == (10, 3)
    together = np.concatenate([data.train.obs_t, data.validation.obs_t])
    np.testing.assert_array_equal(np.sort(together, axis=0), np.sort(demonstrations.obs_t, axis=0))
    for rows in data:
        np.testing.assert_allclose(rows.action_t, rows.obs_t @ POLICY, atol=1e-6)
    np.testing.assert_array_equal(data.validation.obs_t, again.validation.obs_t)
    assert not np.array_equal(data.validation.obs_t, other.validation.obs_t)


def test_either_side_of_a_split_has_a_row():
    for share in (0.01, 0.99):
        config = dataclasses.replace(CONFIG, validation_share=share)
        data = bc.split(jax.random.PRNGKey(0), _demonstrations(2), config)
        assert len(data.train.obs_t) == len(data.validation.obs_t) == 1
    with pytest.raises(RepresentError, match="at least 2 transitions"):
        bc.split(jax.random.PRNGKey(0), _demonstrations(1), CONFIG)


def test_a_linear_policy_is_recovered():
    demonstrations = _demonstrations(400)
    data = bc.split(jax.random.PRNGKey(0), demonstrations, CONFIG)
    state = bc.init(jax.random.PRNGKey(1), demonstrations, CONFIG)
    before = bc.squared_error(state.params, data.validation, CONFIG)
    train = jax.jit(lambda state: bc.train(state, data, CONFIG, CONFIG.num_updates))
    state, metrics = train(state)
    assert float(metrics["validation_loss"]) < 0.01 * float(before)
    unseen = _demonstrations(100, seed=1)
    action = bc.act(bc.finish(state), unseen.obs_t, jax.random.PRNGKey(2), CONFIG, 2)
    np.testing.assert_allclose(action, unseen.action_t, atol=0.1)


def test_validation_rows_are_measured_and_not_learned_from():
    demonstrations = _demonstrations(20)
    data = bc.split(jax.random.PRNGKey(0), demonstrations, CONFIG)
    shifted = data.validation._replace(action_t=data.validation.action_t + 10.0)
    state = bc.init(jax.random.PRNGKey(1), demonstrations, CONFIG)
    train = jax.jit(lambda data: bc.train(state, data, CONFIG, 3))
    after, metrics = train(data)
    after_shift, shift_metrics = train(data._replace(validation=shifted))
    jax.tree.map(np.testing.assert_array_equal, after.params, after_shift.params)
    output = bc.act(after.params, shifted.obs_t, None, CONFIG, 2)
    assert np.abs(output).max() < 1.0
    for rows, found in ((data.validation, metrics), (shifted, shift_metrics)):
        expected = np.mean(np.sum((output - rows.action_t) ** 2, axis=-1))
        np.testing.assert_allclose(found["validation_loss"], expected, rtol=1e-5)


def test_step_is_the_same_without_jit():
    demonstrations = _demonstrations(20)
    data = bc.split(jax.random.PRNGKey(0), demonstrations, CONFIG)
    state = bc.init(jax.random.PRNGKey(1), demonstrations, LINEAR)
    compiled, _ = jax.jit(lambda state: bc.step(state, data, LINEAR))(state)
    with jax.disable_jit():
        plain, _ = bc.step(state, data, LINEAR)
    for a, b in zip(jax.tree.leaves(compiled), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("num_updates", 0),
        ("batch_size", 0),
        ("hidden_sizes", (16, 0)),
        ("learning_rate", 0.0),
        ("kernel_scale", 0.0),
        ("l2", -0.1),
        ("validation_share", 0.0),
        ("validation_share", 1.0),
    ],
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(UsageError, match=field):
        BcConfig(**{field: value})
