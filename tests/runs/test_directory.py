import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from represent_jax import runs
from represent_jax.errors import RepresentError, UsageError
from represent_jax.runs import checkpoint


@dataclasses.dataclass(frozen=True)
class Config:
    seed: int = 0
    sizes: tuple[int, ...] = (4, 4)
    rate: float = 0.1


@pytest.fixture
def run(tmp_path):
    with runs.open_run(tmp_path / "run", Config()) as run:
        yield run


def events(path):
    """Reads the length-prefixed records of TensorBoard: tags, steps, values and session starts."""
    found = []
    for file in sorted(path.iterdir()):
        content, at = file.read_bytes(), 0
        while at < len(content):
            length = int.from_bytes(content[at : at + 8], "little")
            event = Event.FromString(content[at + 12 : at + 12 + length])
            at += 12 + length + 4
            found += [(v.tag, event.step, round(v.simple_value, 6)) for v in event.summary.value]
            if event.HasField("session_log"):
                found.append(("start", event.step, None))
    return found


def test_open_makes_and_resumes(tmp_path):
    path = tmp_path / "new" / "run"
    for resume in (True, True):
        run = runs.open_run(path, Config(), resume=resume)
        assert run.path == path
    assert runs.load_config_json(path) == {"seed": 0, "sizes": [4, 4], "rate": 0.1}


def test_a_folder_belongs_to_one_at_a_time(tmp_path):
    path = tmp_path / "run"
    with (
        runs.open_run(path, Config()),
        pytest.raises(UsageError, match="run: another process works in this folder"),
        runs.open_run(path, Config(), resume=True),
    ):
        pass
    # Whoever had it left it, and who was refused took nothing.
    with runs.open_run(path, Config(), resume=True):
        pass


def test_open_refuses(tmp_path):
    path = tmp_path / "run"
    runs.open_run(path, Config())
    with pytest.raises(UsageError, match=r"run: not empty; resume"):
        runs.open_run(path, Config())
    with pytest.raises(UsageError, match=r"another configuration: seed \(0 there, 1 here\)$"):
        runs.open_run(path, Config(seed=1), resume=True)
    with pytest.raises(
        UsageError, match=r"seed .*, sizes \(\[4, 4\] there, \[8\] here\), rate .* and 1 more"
    ):
        runs.open_run(path, {"seed": 1, "sizes": (8,), "rate": 1.0, "x": 2}, resume=True)

    (path / "config.json").write_text(json.dumps({"format_version": 0, "config": {}}))
    with pytest.raises(UsageError, match="run of format version 0, known is 1"):
        runs.open_run(path, Config(), resume=True)
    (path / "config.json").write_text("{")
    with pytest.raises(RepresentError, match=r"config.json: cannot be read"):
        runs.open_run(path, Config(), resume=True)

    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("")
    with pytest.raises(UsageError, match="not the folder of a run"):
        runs.open_run(tmp_path / "other", Config(), resume=True)
    with pytest.raises(UsageError, match="a file, expected a folder"):
        runs.open_run(tmp_path / "other" / "notes.txt", Config())


def test_open_after_a_kill_before_the_first_file(tmp_path):
    (tmp_path / ".tmp-config.json").write_text("{")
    runs.open_run(tmp_path, Config(), resume=True)
    assert runs.load_config_json(tmp_path)["seed"] == 0


def test_output_makes_a_stage_done(run):
    assert not run.is_done("airl")
    with pytest.raises(RepresentError, match="stage 'airl' is not done"):
        run.load_output("airl", jnp.zeros(3))
    run.save_progress("airl", 10, jnp.zeros(2))
    run.save_output("airl", {"w": jnp.arange(3.0)})
    assert run.is_done("airl")
    assert run.load_progress("airl", jnp.zeros(2)) is None
    np.testing.assert_array_equal(run.load_output("airl", {"w": jnp.zeros(3)})["w"], [0, 1, 2])


def test_progress_keeps_the_newest(run):
    assert run.load_progress("airl", jnp.zeros(2)) is None
    for step in (5, 10, 100):
        run.save_progress("airl", step, jnp.full(2, float(step)))
    folder = run.path / "checkpoints" / "airl" / "progress"
    assert sorted(f.name for f in folder.iterdir()) == ["000000000010", "000000000100"]
    step, state = run.load_progress("airl", jnp.zeros(2))
    assert (step, state.tolist()) == (100, [100, 100])


def test_progress_skips_what_is_broken(run):
    for step in (5, 10):
        run.save_progress("airl", step, jnp.full(2, float(step)))
    arrays = run.path / "checkpoints" / "airl" / "progress" / "000000000010" / "arrays"
    for file in arrays.rglob("*"):
        if file.is_file():
            file.write_bytes(b"")
    step, state = run.load_progress("airl", jnp.zeros(2))
    assert (step, state.tolist()) == (5, [5, 5])
    run.save_progress("airl", 7, jnp.full(2, 7.0))
    assert sorted(f.name for f in arrays.parents[1].iterdir()) == ["000000000005", "000000000007"]


def test_progress_survives_a_failing_save(run, monkeypatch):
    run.save_progress("airl", 5, jnp.full(2, 5.0))

    def fail(path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "replacing", fail)
    with pytest.raises(RepresentError, match="no space left"):
        run.save_progress("airl", 10, jnp.full(2, 10.0))
    assert run.load_progress("airl", jnp.zeros(2))[0] == 5


def test_log_and_rewind(run):
    for step in (1, 2, 3):
        run.log("airl", step, {"loss": jnp.float32(step / 2), "each": np.array([step, np.nan])})
    run.log("noise", 7, {"level": 0.5})
    run.close()
    with open(run.path / "metrics.jsonl", "a") as file:
        file.write('{"stage": "airl", "st')
    assert [line["step"] for line in run.read_log("airl")] == [1, 2, 3]

    run.rewind_log("airl", 1)
    run.log("airl", 2, {"loss": 9.0})
    run.close()
    lines = [{k: v for k, v in line.items() if k != "time"} for line in run.read_log()]
    assert lines == [
        {"stage": "airl", "step": 1, "loss": 0.5, "each": [1.0, None]},
        {"stage": "noise", "step": 7, "level": 0.5},
        {"stage": "airl", "step": 2, "loss": 9.0},
    ]
    assert events(run.path / "tensorboard" / "noise") == [("level", 7, 0.5)]
    assert set(events(run.path / "tensorboard" / "airl")) == {
        *(("loss", step, step / 2) for step in (1, 2, 3)),
        *(("each/0", step, float(step)) for step in (1, 2, 3)),
        ("start", 2, None),
        ("loss", 2, 9.0),
    }


def test_results_are_strict_json(run):
    with pytest.raises(RepresentError, match=r"results.json: no such file"):
        run.read_results()
    run.write_results(
        {"a": np.float32(0.5), "b": jnp.arange(2), "c": {"d": (1, np.nan)}, "e": True}
    )
    assert run.read_results() == {"a": 0.5, "b": [0, 1], "c": {"d": [1, None]}, "e": True}


def test_arrays(run):
    run.save_arrays("scatter", {"task/test/true": jnp.arange(3), "x": np.zeros((2, 2))})
    loaded = run.load_arrays("scatter")
    np.testing.assert_array_equal(loaded["task/test/true"], [0, 1, 2])
    assert loaded["x"].shape == (2, 2)
    with pytest.raises(RepresentError, match=r"curves.npz: no such file"):
        run.load_arrays("curves")
