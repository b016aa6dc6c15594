"""Every format there and back, and on files that the formats' own libraries wrote."""

import gc
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from represent_jax import data
from represent_jax.data import formats
from represent_jax.data.formats import flat
from represent_jax.errors import RepresentError, UsageError

FILES = Path(__file__).parent / "files"
LIBRARIES = {"minari": ("minari", "h5py"), "imitation": ("datasets",), "d4rl": ("h5py",)}
OUTPUTS = {
    "npz": "mine.npz",
    "minari": "cart/mine-v0",
    "imitation": "mine",
    "d4rl": "mine.hdf5",
    "arrays": "mine.npz",
    "csv": "mine.csv",
}


def format_of(name):
    for library in LIBRARIES.get(name, ()):
        pytest.importorskip(library)
    return "arrays" if name == "csv" else name


def output(tmp_path, name):
    return OUTPUTS[name] if name == "minari" else str(tmp_path / OUTPUTS[name])


@pytest.fixture(autouse=True)
def datasets_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def demonstrations(actions=True, rewards=True, obs_dim=3):
    rng = np.random.default_rng(0)
    return data.Demonstrations(
        "cart",
        tuple(
            data.Trajectory(
                obs=rng.normal(size=(length + 1, obs_dim)),
                actions=rng.uniform(-1, 1, size=(length, 2)) if actions else None,
                rewards=rng.normal(size=length) if rewards else None,
                terminated=terminated,
                strategy=strategy,
            )
            for length, terminated, strategy in (
                (5, False, 1),
                (2, True, 0),
                (1, True, 1),
                (4, False, 0),
            )
        ),
        {"seed": 3, "levels": [0.5, None], "note": 'é, "quoted"\nlines'},
    )


def assert_same(found, expected):
    assert found.env_name == expected.env_name
    assert found.metadata == expected.metadata
    for a, b in zip(found.trajectories, expected.trajectories, strict=True):
        assert (a.terminated, a.strategy) == (b.terminated, b.strategy)
        for name in ("obs", "actions", "rewards"):
            one, other = getattr(a, name), getattr(b, name)
            assert (one is None) == (other is None)
            if one is not None:
                np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("rewards", [True, False])
@pytest.mark.parametrize("name", OUTPUTS)
def test_round_trip_loses_nothing(tmp_path, name, rewards):
    own, out = demonstrations(rewards=rewards), output(tmp_path, name)
    formats.write(format_of(name), out, own)
    assert_same(formats.read(format_of(name), [out]), own)


@pytest.mark.parametrize("name", ["npz", "d4rl", "arrays", "csv"])
def test_round_trip_of_states_alone(tmp_path, name):
    own, out = demonstrations(actions=False, rewards=False), output(tmp_path, name)
    formats.write(format_of(name), out, own)
    assert_same(formats.read(format_of(name), [out]), own)


@pytest.mark.parametrize("name", ["minari", "imitation"])
def test_formats_that_need_actions_say_so(tmp_path, name):
    with pytest.raises(UsageError, match="actions"):
        formats.write(format_of(name), output(tmp_path, name), demonstrations(actions=False))


@pytest.mark.parametrize("name", ["minari", "imitation"])
def test_nothing_is_written_over(tmp_path, name):
    formats.write(format_of(name), output(tmp_path, name), demonstrations())
    with pytest.raises(UsageError, match="already"):
        formats.write(name, output(tmp_path, name), demonstrations())


# --- files of the formats' own libraries ---


def collect(dataset, env_name, max_episode_steps):
    """Two random episodes, collected by Minari itself; returns their observations."""
    format_of("minari")
    import gymnasium
    import minari

    env = minari.DataCollector(gymnasium.make(env_name, max_episode_steps=max_episode_steps))
    env.action_space.seed(0)
    seen = []
    for seed in (0, 1):
        seen.append([env.reset(seed=seed)[0]])
        done = False
        while not done:
            obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
            seen[-1].append(obs)
            done = terminated or truncated
    with warnings.catch_warnings():
        # Of authors that are not given, and of temporary folders left to the garbage collector.
        warnings.simplefilter("ignore")
        env.create_dataset(dataset)
        del env
        gc.collect()
    return seen


def test_a_dataset_that_minari_collected():
    seen = collect("pendulum/random-v0", "Pendulum-v1", 4)
    held = formats.read("minari", ["pendulum/random-v0"], "pendulum")
    assert [t.length for t in held.trajectories] == [4, 4]
    assert not any(t.terminated for t in held.trajectories)
    for t, obs in zip(held.trajectories, seen, strict=True):
        np.testing.assert_array_equal(t.obs, np.array(obs, np.float32))
        assert t.actions.shape == (4, 1) and (t.rewards < 0).all()
    assert held.metadata["env_spec"] == "Pendulum-v1"
    with pytest.raises(UsageError, match="does not say which environment"):
        formats.read("minari", ["pendulum/random-v0"])


def test_a_minari_dataset_of_other_spaces():
    collect("cart/pole-v0", "CartPole-v1", 3)
    with pytest.raises(RepresentError, match=r"cart/pole-v0: actions are a Discrete"):
        formats.read("minari", ["cart/pole-v0"], "cart")
    with pytest.raises(RepresentError, match="minari download cart/none-v0"):
        formats.read("minari", ["cart/none-v0"], "cart")


def test_folders_that_imitation_saved():
    format_of("imitation")
    with_infos = formats.read("imitation", [str(FILES / "imitation_with_infos")], "pendulum")
    assert [t.length for t in with_infos.trajectories] == [3, 5]
    # The library calls both terminal; their infos say that a time limit ended them.
    assert not any(t.terminated for t in with_infos.trajectories)
    assert with_infos.metadata["notes"] == ["left out: infos"]
    np.testing.assert_allclose(
        np.linalg.norm(with_infos.trajectories[1].obs[:, :2], axis=1), 1.0, rtol=1e-6
    )
    bare = formats.read("imitation", [str(FILES / "imitation_without_rewards")], "pendulum")
    old = formats.read("imitation", [str(FILES / "imitation_old.npz")], "pendulum")
    assert not bare.has_rewards and old.has_rewards
    for a, b in zip(bare.trajectories, old.trajectories, strict=True):
        np.testing.assert_array_equal(a.obs, b.obs)
        np.testing.assert_array_equal(a.actions, b.actions)
    assert all(t.terminated for t in old.trajectories)
    assert any("time limit" in note for note in old.metadata["notes"])


def test_files_that_d4rl_wrote():
    format_of("d4rl")
    whole = formats.read("d4rl", [str(FILES / "d4rl_with_next.hdf5")], "pendulum")
    assert [(t.length, t.terminated) for t in whole.trajectories] == [
        (2, True),
        (4, False),
        (1, False),
    ]
    assert "notes" not in whole.metadata
    cut = formats.read("d4rl", [str(FILES / "d4rl_with_timeouts.hdf5")], "pendulum")
    assert [(t.length, t.terminated) for t in cut.trajectories] == [(1, False), (3, False)]
    np.testing.assert_array_equal(cut.trajectories[1].obs, whole.trajectories[1].obs[:-1])
    np.testing.assert_array_equal(cut.trajectories[1].actions, whole.trajectories[1].actions[:-1])
    assert cut.metadata["notes"][0].startswith("last step of 3 episodes left out")
    with pytest.raises(RepresentError, match=r"d4rl_plain.hdf5: neither 'timeouts' nor"):
        formats.read("d4rl", [str(FILES / "d4rl_plain.hdf5")], "pendulum")


# --- several inputs ---


def test_inputs_become_strategies_in_order(tmp_path):
    one, two = str(tmp_path / "one.npz"), str(tmp_path / "two.npz")
    obs = np.arange(8.0).reshape(4, 2)
    np.savez(one, observations=obs, actions=np.zeros((3, 1)))
    np.savez(two, obs=obs[:3], acts=np.ones((2, 1)))
    held = formats.read("arrays", [one, two], "cart")
    assert [(t.strategy, t.length) for t in held.trajectories] == [(0, 3), (1, 2)]
    assert [source["input"] for source in held.metadata["inputs"]] == [one, two]
    assert held.metadata["source"] == f"{one} + {two}"
    formats.write("arrays", str(tmp_path / "both.npz"), held)
    again = formats.read("arrays", [str(tmp_path / "both.npz"), two], "cart")
    assert [t.strategy for t in again.trajectories] == [0, 1, 2]


def test_inputs_that_do_not_go_together(tmp_path):
    def save(name, **arrays):
        np.savez(tmp_path / name, **arrays)
        return str(tmp_path / name)

    plain = save("plain.npz", obs=np.zeros((4, 2)), acts=np.zeros((3, 1)))
    wide = save("wide.npz", obs=np.zeros((4, 3)), acts=np.zeros((3, 1)))
    paid = save("paid.npz", obs=np.zeros((4, 2)), acts=np.zeros((3, 1)), rews=np.zeros(3))
    states = save("states.npz", obs=np.zeros((4, 2)))
    with pytest.raises(RepresentError, match=r"wide.npz: observations have 3 .*plain.npz have 2"):
        formats.read("arrays", [plain, wide], "cart")
    with pytest.raises(RepresentError, match=r"plain.npz has no rewards, .*paid.npz has them"):
        formats.read("arrays", [paid, plain], "cart")
    assert not formats.read("arrays", [paid, plain], "cart", ["rewards"]).has_rewards
    with pytest.raises(RepresentError, match=r"states.npz has no actions"):
        formats.read("arrays", [plain, states], "cart")
    data.save_demonstrations(tmp_path / "a.npz", demonstrations())
    np.savez(tmp_path / "b.npz")
    with pytest.raises(UsageError, match="did you mean rewards"):
        formats.read("npz", [str(tmp_path / "a.npz")], leave_out=["reward"])
    with pytest.raises(UsageError, match="did you mean minari"):
        formats.read("minary", [plain], "cart")
    with pytest.raises(UsageError, match="no inputs"):
        formats.read("arrays", [], "cart")


# --- plain arrays ---


@pytest.mark.parametrize(
    "arrays, message",
    [
        ({"acts": np.zeros((3, 1))}, "no observations: expected observations or obs, found acts"),
        ({"obs": np.zeros((3, 2)), "acts": np.zeros((3, 1))}, "actions has 3 rows, expected 2"),
        ({"obs": np.zeros((3, 2)), "dones": np.ones(3)}, "'dones' does not say"),
        ({"obs": np.zeros((3, 2)), "terminals": np.zeros(3)}, "neither 'timeouts' nor"),
        ({"obs": np.zeros((3, 2)), "terminals": np.full(3, 2)}, "zeros and ones"),
        ({"obs": np.zeros((3, 2)), "terminals": np.zeros(2)}, "3 observations but 2 terminals"),
        ({"obs": np.zeros((3, 2)), "timeouts": np.ones(3)}, "no episode has two observations"),
        ({"obs": np.zeros((3, 2)), "next_obs": np.zeros((3, 1))}, "next_observations"),
        ({"obs": np.zeros((4, 2)), "episode_lengths": np.array([2])}, "expected 3 of 1 episodes"),
        ({"obs": np.zeros((4, 2)), "episode_lengths": np.array([0.5])}, "counts of steps"),
        ({"obs": np.full((3, 2), np.nan)}, "not finite"),
        ({"obs": np.full((3, 2), 1e300)}, "not finite"),
        ({"obs": np.zeros(3)}, "1 axes, they need 2"),
    ],
)
def test_arrays_that_say_too_little(tmp_path, arrays, message):
    np.savez(tmp_path / "mine.npz", **arrays)
    with pytest.raises(RepresentError, match=message) as caught:
        formats.read("arrays", [str(tmp_path / "mine.npz")], "cart")
    assert "mine.npz" in str(caught.value)


def test_rows_are_cut_where_episodes_end():
    obs = np.arange(12.0, dtype=np.float32).reshape(6, 2)
    next_obs = np.concatenate([obs[1:], [[90, 91]]]).astype(np.float32)
    next_obs[1] = [50, 51]  # no flag, but the next row begins elsewhere
    rows = {"observations": obs, "next_observations": next_obs, "terminals": np.arange(6) == 3}
    cut, notes = flat.from_arrays(rows)
    assert [(t.length, t.terminated) for t in cut] == [(2, False), (2, True), (2, False)]
    np.testing.assert_array_equal(cut[0].obs[-1], [50, 51])
    np.testing.assert_array_equal(cut[2].obs[-1], [90, 91])
    assert notes == [
        "1 episodes end without a flag, where next_observations are not those of the next row; "
        "they count as cut"
    ]


def test_float64_is_rounded_and_said_so():
    exact, third = np.zeros((3, 2)), np.full((3, 2), 1 / 3)
    assert flat.from_arrays({"obs": exact})[1] == []
    trajectories, notes = flat.from_arrays({"obs": third, "qpos": exact})
    assert notes == ["left out: qpos", "rounded to float32: observations"]
    assert trajectories[0].obs.dtype == np.float32


def test_csv_of_a_person(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text(
        "episode, obs_0, obs_1, action_0, terminated, comment\n"
        "a, 0, 0.5, 1, false, first\n"
        "a, 1, 0.5, , true, final\n"
        "b, 2, 0.5, -1, 0, \n"
        "b, 3, 0.5, -0.5, 0, \n"
        "b, 4, 0.5, , 0, \n"
    )
    held = formats.read("arrays", [str(path)], "cart")
    assert [(t.length, t.terminated) for t in held.trajectories] == [(1, True), (2, False)]
    np.testing.assert_array_equal(held.trajectories[1].actions, [[-1], [-0.5]])
    assert not held.has_rewards and held.metadata["notes"] == ["left out: comment"]


@pytest.mark.parametrize(
    "text, message",
    [
        ("obs_0,action_0\n0,1\n1,x\n", "column action_0: expected a number, found 'x'"),
        ("obs_0,action_0\n0,1\n1\n", "not every row has 2 cells"),
        ("x,y\n0,1\n", "no columns obs_0"),
        ("episode,obs_0,action_0\n0,0,1\n0,1,\n1,0,1\n1,1,1\n", "others do not"),
        ("", "no columns obs_0"),
        ("obs_0,strategy\n0,nan\n1,nan\n", "strategy: expected whole numbers from 0, found nan"),
        ("obs_0,strategy\n0,0.9\n1,0.9\n", "strategy: expected whole numbers from 0, found 0.9"),
        ("obs_0,strategy\n0,0\n1,1\n", r"strategy: expected one of each episode, found \[0, 1\]"),
        ("obs_0,terminated\n0,0\n1,2\n", "column terminated: expected 0 or 1, found '2'"),
    ],
)
def test_csv_that_is_no_table_of_episodes(tmp_path, text, message):
    (tmp_path / "mine.csv").write_text(text)
    with pytest.raises(RepresentError, match=message):
        formats.read("arrays", [str(tmp_path / "mine.csv")], "cart")


@pytest.mark.parametrize(
    "strategy, message",
    [
        ([0, 0, 1, 1], r"strategy: expected one of each episode, found \[0, 1\]"),
        ([0.0, 0.0, 0.0, np.nan], "strategy: expected whole numbers from 0, found nan"),
        ([-1, -1, -1, -1], "strategy: expected whole numbers from 0, found -1"),
        (["a", "a", "b", "b"], "strategy: expected whole numbers from 0, found <U1"),
    ],
)
def test_rows_whose_strategies_are_none(strategy, message):
    rows = {
        "observations": np.arange(4.0)[:, None],
        "next_observations": np.arange(1.0, 5.0)[:, None],
        "strategy": np.array(strategy),
    }
    with pytest.raises(RepresentError, match=message):
        flat.from_arrays(rows)
    rows["strategy"] = np.array([1.0, 1.0, 1.0, 1.0])
    [trajectory], _ = flat.from_arrays(rows)
    assert trajectory.strategy == 1


# --- what is no file of the format ---


@pytest.mark.parametrize("name", [name for name in OUTPUTS if name != "minari"])
def test_files_of_another_kind(tmp_path, name):
    out = output(tmp_path, name)
    with pytest.raises(RepresentError, match=r"no such file|unknown demonstrations"):
        formats.read(format_of(name), [out], "cart")
    Path(out).write_bytes(b"\xff\xfe something else")
    with pytest.raises(RepresentError, match="mine"):
        formats.read(format_of(name), [out], "cart")


@pytest.mark.parametrize("name", ["minari", "imitation"])
def test_folders_of_another_kind(tmp_path, name):
    (tmp_path / "folder").mkdir()
    with pytest.raises(RepresentError, match="folder: not a dataset"):
        formats.read(format_of(name), [str(tmp_path / "folder")], "cart")


@pytest.mark.parametrize(
    "name, module, extra",
    [
        ("minari", "minari", "minari"),
        ("imitation", "datasets", "imitation"),
        ("d4rl", "h5py", "hdf5"),
    ],
)
def test_a_missing_library_names_its_extra(tmp_path, monkeypatch, name, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=rf"pip install 'represent_jax\[{extra}\]'"):
        formats.read(name, [str(tmp_path)], "cart")
    with pytest.raises(UsageError, match=rf"pip install 'represent_jax\[{extra}\]'"):
        formats.write(name, output(tmp_path, name), demonstrations())
