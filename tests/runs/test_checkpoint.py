import errno
import os
from typing import NamedTuple

import flax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from represent_jax.errors import RepresentError
from represent_jax.runs import checkpoint


class Pair(NamedTuple):
    first: jax.Array
    second: jax.Array


@flax.struct.dataclass
class State:
    params: dict
    pair: Pair
    optimizer: optax.OptState


def state(seed=0):
    key = jax.random.PRNGKey(seed)
    params = {"dense/0": jax.random.normal(key, (3, 4)), "bias": jnp.zeros(4, jnp.bfloat16)}
    return {
        "state": State(params, Pair(key, jnp.arange(3)), optax.adam(1e-3).init(params)),
        "empty": jnp.zeros((0, 2)),
        "flags": jnp.array([True, False]),
        "special": jnp.array([jnp.nan, -0.0, jnp.inf, 1e-45]),
        "float64": np.linspace(0, 1, 5),
        "counters": [3, 2.5, True, np.int64(2**40)],
        "nothing": None,
    }


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert type(x) is type(y)
        x, y = np.asarray(x), np.asarray(y)
        assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())


def test_round_trip_is_bit_exact(tmp_path):
    saved = state()
    checkpoint.save(tmp_path / "a", saved)
    assert checkpoint.is_whole(tmp_path / "a")
    assert_same(checkpoint.load(tmp_path / "a", state(seed=1)), saved)


def test_abstract_example_and_single_leaf(tmp_path):
    saved = {"x": jnp.arange(6.0).reshape(2, 3), "key": jax.random.PRNGKey(3)}
    checkpoint.save(tmp_path / "a", saved)
    assert_same(checkpoint.load(tmp_path / "a", jax.eval_shape(lambda: saved)), saved)
    checkpoint.save(tmp_path / "b", jnp.arange(3))
    assert_same(checkpoint.load(tmp_path / "b", jnp.zeros(3, jnp.int32)), jnp.arange(3))
    checkpoint.save(tmp_path / "c", {})
    assert checkpoint.load(tmp_path / "c", {}) == {}


def test_loaded_leaves_can_be_donated(tmp_path):
    checkpoint.save(tmp_path / "a", jnp.arange(1024.0))
    loaded = checkpoint.load(tmp_path / "a", jnp.zeros(1024))
    doubled = jax.jit(lambda x: 2 * x, donate_argnums=0)(loaded)
    np.testing.assert_array_equal(doubled, 2 * np.arange(1024.0))


def test_saving_again_replaces(tmp_path):
    checkpoint.save(tmp_path / "a", {"x": jnp.zeros(3), "y": jnp.zeros(2)})
    checkpoint.save(tmp_path / "a", {"x": jnp.ones(3)})
    assert_same(checkpoint.load(tmp_path / "a", {"x": jnp.zeros(3)}), {"x": jnp.ones(3)})


@pytest.mark.parametrize(
    "example, message",
    [
        ({"x": jnp.zeros(4)}, r"state\['x'\] is float32\[3\] in the file, expected float32\[4\]"),
        ({"x": jnp.zeros(3, int)}, r"is float32\[3\] in the file, expected int32\[3\]"),
        ({"y": jnp.zeros(3)}, r"state\['x'\] is float32\[3\] in the file, expected absent"),
        ({"x": jnp.zeros(3), "y": 1}, r"state\['y'\] is absent in the file, expected int64\[\]"),
    ],
)
def test_another_example_is_refused(tmp_path, example, message):
    checkpoint.save(tmp_path / "a", {"x": jnp.ones(3)})
    with pytest.raises(RepresentError, match=message) as caught:
        checkpoint.load(tmp_path / "a", example)
    assert not isinstance(caught.value, checkpoint.BrokenCheckpoint)


def test_broken_checkpoints_are_noticed(tmp_path):
    example = {"x": np.random.default_rng(0).normal(size=1000)}
    with pytest.raises(checkpoint.BrokenCheckpoint, match="not a whole checkpoint"):
        checkpoint.load(tmp_path / "a", example)

    checkpoint.save(tmp_path / "a", example)
    (tmp_path / "a" / "leaves.json").write_text("{")
    with pytest.raises(checkpoint.BrokenCheckpoint, match="not a whole checkpoint"):
        checkpoint.load(tmp_path / "a", example)

    checkpoint.save(tmp_path / "a", example)
    files = [f for f in (tmp_path / "a" / "arrays").rglob("*") if f.is_file()]
    largest = max(files, key=lambda f: f.stat().st_size)
    content = bytearray(largest.read_bytes())
    content[len(content) // 2] ^= 1
    largest.write_bytes(content)
    with pytest.raises(checkpoint.BrokenCheckpoint):
        checkpoint.load(tmp_path / "a", example)

    largest.unlink()
    with pytest.raises(checkpoint.BrokenCheckpoint, match="cannot be read"):
        checkpoint.load(tmp_path / "a", example)


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
        ValueError(
            "RESOURCE_EXHAUSTED: Failed to write: No space left on device [os_error_code='28']"
        ),
    ],
)
def test_no_space_left(tmp_path, monkeypatch, capfd, error):
    import orbax.checkpoint as ocp

    def full(*args, **kwargs):
        raise error

    monkeypatch.setattr(ocp.StandardCheckpointHandler, "save", full)
    with pytest.raises(RepresentError, match=r"a: no space left on the device$"):
        checkpoint.save(tmp_path / "a", {"x": jnp.zeros(3)})
    assert not (tmp_path / "a").exists()
    assert capfd.readouterr().err == ""
