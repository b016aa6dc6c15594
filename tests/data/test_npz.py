import errno
import os

import numpy as np
import pytest

from represent_jax import data
from represent_jax.data.npz import FORMAT_VERSION
from represent_jax.errors import RepresentError


@pytest.fixture
def demos():
    rng = np.random.default_rng(0)
    return data.Demonstrations(
        "cart",
        tuple(
            data.Trajectory(
                obs=rng.normal(size=(length + 1, 3)),
                actions=rng.uniform(-1, 1, size=(length, 2)),
                rewards=rng.normal(size=length),
                terminated=length < 5,
                strategy=strategy,
            )
            for length, strategy in ((5, 0), (2, 1), (1, 1))
        ),
        {"seed": 3, "levels": [0.5, None], "note": "é"},
    )


def rewrite(path, **changes):
    """Writes the arrays of a file again with some changed, or left out where None."""
    with np.load(path) as file:
        arrays = dict(file) | changes
    np.savez_compressed(path, **{k: v for k, v in arrays.items() if v is not None})


def test_round_trip(tmp_path, demos):
    path = tmp_path / "new" / "demos.npz"
    data.save_demonstrations(path, demos)
    loaded = data.load_demonstrations(path)
    assert loaded.env_name == demos.env_name
    assert loaded.metadata == demos.metadata
    for a, b in zip(loaded.trajectories, demos.trajectories, strict=True):
        for name in ("obs", "actions", "rewards", "terminated", "strategy"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert os.listdir(path.parent) == ["demos.npz"]


def test_same_demonstrations_are_the_same_bytes(tmp_path, demos):
    data.save_demonstrations(tmp_path / "a.npz", demos)
    data.save_demonstrations(tmp_path / "b.npz", demos)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.parametrize("kept", [0, 3, 100, 0.5, -1])
def test_truncated_file(tmp_path, demos, kept):
    path = tmp_path / "demos.npz"
    data.save_demonstrations(path, demos)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * kept) if isinstance(kept, float) else kept])
    with pytest.raises(RepresentError, match=r"demos.npz: not a whole npz file"):
        data.load_demonstrations(path)


def test_corrupted_file(tmp_path, demos):
    path = tmp_path / "demos.npz"
    data.save_demonstrations(path, demos)
    whole = bytearray(path.read_bytes())
    whole[150] ^= 0xFF
    path.write_bytes(whole)
    with pytest.raises(RepresentError, match=r"demos.npz: not a whole npz file"):
        data.load_demonstrations(path)


def test_foreign_files(tmp_path, demos):
    (tmp_path / "text.npz").write_text("obs,actions\n")
    with pytest.raises(RepresentError, match=r"text.npz: not a whole npz file"):
        data.load_demonstrations(tmp_path / "text.npz")
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(RepresentError, match=r"one.npy: not a whole npz file"):
        data.load_demonstrations(tmp_path / "one.npy")
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(RepresentError, match=r"other.npz: .*no 'format_version'"):
        data.load_demonstrations(tmp_path / "other.npz")
    np.savez(tmp_path / "pickle.npz", weights=np.array([{}]))
    with pytest.raises(RepresentError, match=r"pickle.npz: .*allow_pickle=False"):
        data.load_demonstrations(tmp_path / "pickle.npz")
    with pytest.raises(RepresentError, match=r"none.npz: no such file"):
        data.load_demonstrations(tmp_path / "none.npz")
    with pytest.raises(RepresentError, match="a directory, expected an npz file"):
        data.load_demonstrations(tmp_path)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"format_version": np.array(99)}, f"format version 99, known is {FORMAT_VERSION}"),
        ({"actions": None, "metadata": None}, "has no 'actions', 'metadata'"),
        ({"rewards": np.zeros(7)}, "'rewards' has 7 rows, 'episode_lengths' asks for 8"),
        ({"episode_lengths": np.array(3)}, "demos.npz: "),
        ({"episode_lengths": np.array([5, 3, 0])}, "zero length"),
        ({"strategy": np.array([0, 3, 3])}, r"strategies are \[0, 3\]"),
        ({"rewards": np.full(8, np.nan)}, "not finite"),
        ({"metadata": np.array("{")}, "demos.npz: "),
    ],
)
def test_files_with_wrong_contents(tmp_path, demos, changes, message):
    path = tmp_path / "demos.npz"
    data.save_demonstrations(path, demos)
    rewrite(path, **changes)
    with pytest.raises(RepresentError, match=message) as caught:
        data.load_demonstrations(path)
    assert "demos.npz" in str(caught.value)


def test_no_space_left_keeps_the_old_file(tmp_path, demos, monkeypatch):
    path = tmp_path / "demos.npz"
    data.save_demonstrations(path, demos)
    before = path.read_bytes()

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(RepresentError, match=r"demos.npz: no space left"):
        data.save_demonstrations(path, demos)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["demos.npz"]


def test_unwritable_place(tmp_path, demos):
    (tmp_path / "file").write_text("")
    with pytest.raises(RepresentError, match="cannot be written"):
        data.save_demonstrations(tmp_path / "file" / "demos.npz", demos)
