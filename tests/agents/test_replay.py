import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.agents import replay
from represent_jax.types import Transition

OBS_DIM, ACTION_DIM, BATCH = 3, 2, 2


def transitions(first, size=BATCH):
    """Rows numbered from `first`, every field of which tells the row's number."""
    number = first + jnp.arange(size, dtype=jnp.float32)
    return Transition(
        obs_t=number[:, None] + jnp.array([0.0, 0.1, 0.2]),
        action_t=number[:, None] + jnp.array([0.3, 0.4]),
        next_obs_t=number[:, None] + jnp.array([0.5, 0.6, 0.7]),
        reward_t=number + 0.8,
        discount_t=number + 0.9,
        noise_level_t=number + 0.95,
    )


def filled(num_batches, capacity=6):
    buffer = replay.init(capacity, OBS_DIM, ACTION_DIM)
    for i in range(num_batches):
        buffer = replay.insert(buffer, transitions(1 + BATCH * i))
    return buffer


def test_empty():
    buffer = replay.init(6, OBS_DIM, ACTION_DIM)
    assert buffer.data.shape == (6, 2 * OBS_DIM + ACTION_DIM + 3)
    assert buffer.inserted == 0


@pytest.mark.parametrize(
    ("num_batches", "numbers"),
    [
        (1, [1, 2, 0, 0, 0, 0]),
        (3, [1, 2, 3, 4, 5, 6]),
        (4, [7, 8, 3, 4, 5, 6]),
        (7, [13, 14, 9, 10, 11, 12]),
    ],
)
def test_oldest_rows_are_overwritten(num_batches, numbers):
    buffer = filled(num_batches)
    np.testing.assert_array_equal(buffer.data[:, 0], numbers)
    assert buffer.inserted == num_batches * BATCH


def test_rows_come_back_as_they_were_inserted():
    buffer = replay.insert(replay.init(1, OBS_DIM, ACTION_DIM), transitions(4, size=1))
    sampled = replay.sample(buffer, jax.random.PRNGKey(0), (5,), OBS_DIM, ACTION_DIM)
    for name, expected in transitions(4, size=1)._asdict().items():
        found = getattr(sampled, name)
        assert found.shape == (5, *expected.shape[1:])
        np.testing.assert_array_equal(found, np.repeat(expected, 5, axis=0))


@pytest.mark.parametrize(("num_batches", "numbers"), [(1, {1, 2}), (4, {3, 4, 5, 6, 7, 8})])
def test_sampling_draws_every_inserted_row_and_no_other(num_batches, numbers):
    key = jax.random.PRNGKey(1)
    sampled = replay.sample(filled(num_batches), key, (20, 10), OBS_DIM, ACTION_DIM)
    assert sampled.next_obs_t.shape == (20, 10, OBS_DIM)
    assert sampled.reward_t.shape == (20, 10)
    assert set(np.unique(sampled.obs_t[..., 0])) == numbers
    np.testing.assert_allclose(sampled.reward_t, sampled.obs_t[..., 0] + 0.8, rtol=1e-6)


def test_sampling_is_uniform():
    sampled = replay.sample(filled(3), jax.random.PRNGKey(2), (60_000,), OBS_DIM, ACTION_DIM)
    _, counts = np.unique(sampled.obs_t[:, 0], return_counts=True)
    # Six rows: the standard deviation of each count is 91.
    np.testing.assert_allclose(counts, 10_000, atol=450)


def test_capacity_is_a_multiple_of_the_batch():
    buffer = replay.init(7, OBS_DIM, ACTION_DIM)
    with pytest.raises(ValueError, match=r"capacity 7 .* batch size 2"):
        replay.insert(buffer, transitions(1))


def test_population_shares_the_position():
    axes = replay.ReplayBuffer(0, None)
    buffers = replay.ReplayBuffer(jnp.stack([filled(3).data] * 2), filled(3).inserted)
    rows = jax.tree.map(lambda a, b: jnp.stack([a, b]), transitions(7), transitions(17))
    insert = jax.vmap(replay.insert, in_axes=(axes, 0), out_axes=axes)
    after = jax.jit(insert)(buffers, rows)
    assert after.inserted == 8
    np.testing.assert_array_equal(after.data[:, :, 0], [[7, 8, 3, 4, 5, 6], [17, 18, 3, 4, 5, 6]])
