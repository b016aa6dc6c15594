import functools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax import runs
from represent_jax.errors import RepresentError
from represent_jax.runs import checkpoint

NUM_CHUNKS = 6
UNITS = 50
CONFIG = {"seed": 0}


@functools.partial(jax.jit, donate_argnums=0)
def step(state):
    key, key_noise = jax.random.split(state["key"])
    x = 0.9 * state["x"] + jax.random.normal(key_noise, state["x"].shape)
    new_state = {"key": key, "x": x, "count": state["count"] + 1}
    return new_state, {"loss": jnp.mean(x**2), "count": new_state["count"]}


def initial(size=1000):
    return {"key": jax.random.PRNGKey(0), "x": jnp.zeros(size), "count": jnp.int32(0)}


def advance(run, step_fn=step, state=None, checkpoint_seconds=0.0, num_chunks=NUM_CHUNKS):
    return runs.advance(
        run,
        "airl",
        initial() if state is None else state,
        step_fn,
        num_chunks,
        units_per_chunk=UNITS,
        checkpoint_seconds=checkpoint_seconds,
    )


def logged(run):
    return [{k: v for k, v in line.items() if k != "time"} for line in run.read_log()]


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


def stopping(at):
    calls = iter(range(1, 10**6))

    def step_fn(state):
        if next(calls) == at:
            raise KeyboardInterrupt
        return step(state)

    return step_fn


def test_interrupted_loop_ends_in_the_same_state_and_log(tmp_path):
    with runs.open_run(tmp_path / "whole", CONFIG) as whole:
        expected = advance(whole)
    for at in (1, 4):
        path = tmp_path / f"interrupted_{at}"
        with runs.open_run(path, CONFIG) as run, pytest.raises(KeyboardInterrupt):
            advance(run, stopping(at))
        calls = []
        with runs.open_run(path, CONFIG, resume=True) as run:
            final = advance(run, lambda state: calls.append(1) or step(state))  # noqa: B023
            assert logged(run) == logged(whole)
        assert_same(final, expected)
        assert len(calls) == NUM_CHUNKS - at + 1


def test_what_is_costly_to_begin_with_is_made_only_where_nothing_was_saved(tmp_path):
    made = []

    def start():
        made.append(1)
        return initial()

    def go_on(run, step_fn=step):
        return runs.advance(
            run,
            "airl",
            start,
            step_fn,
            NUM_CHUNKS,
            checkpoint_seconds=0.0,
            example=jax.eval_shape(initial),
        )

    expected = advance(None)
    with runs.open_run(tmp_path / "run", CONFIG) as run, pytest.raises(KeyboardInterrupt):
        go_on(run, stopping(at=3))
    assert len(made) == 1
    with runs.open_run(tmp_path / "run", CONFIG, resume=True) as run:
        assert_same(go_on(run), expected)
    assert len(made) == 1


def test_steps_after_the_last_checkpoint_are_logged_once(tmp_path):
    with runs.open_run(tmp_path / "whole", CONFIG) as whole:
        expected = advance(whole)
    path = tmp_path / "interrupted"
    with runs.open_run(path, CONFIG) as run:
        with pytest.raises(KeyboardInterrupt):
            advance(run, stopping(3))
        with pytest.raises(KeyboardInterrupt):
            advance(run, stopping(4), checkpoint_seconds=1e9)
        assert [line["step"] for line in run.read_log()] == [50, 100, 150, 200, 250]
        assert_same(advance(run), expected)
        assert logged(run) == logged(whole)


def test_without_a_run_nothing_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with runs.open_run(tmp_path / "run", CONFIG) as run:
        assert_same(advance(None), advance(run))
    assert os.listdir(tmp_path) == ["run"]
    assert "airl: 0 of 300 env steps (0%)" in capsys.readouterr().err


def test_checkpoints_are_not_written_too_often(tmp_path):
    with runs.open_run(tmp_path, CONFIG) as run:
        advance(run, checkpoint_seconds=1e9)
        assert run.load_progress("airl", initial()) is None


def test_progress_is_shown_before_the_first_chunk_and_described(capsys):
    shown = []

    def step_fn(state):
        shown.append(capsys.readouterr().err)
        return state + 1, {"return": state, "loss": 0.0}

    describe = "return {return:.1f}".format_map
    runs.advance(None, "policies", 0, step_fn, 2, unit="updates", describe=describe)
    assert shown == ["policies: 0 of 2 updates (0%)\n", ""]
    assert capsys.readouterr().err.endswith(", return 1.0\n")


@pytest.mark.parametrize("value", [np.nan, np.array([0.0, np.inf])])
def test_diverging_loss_stops_and_keeps_the_checkpoint(tmp_path, value):
    def step_fn(state):
        state, metrics = step(state)
        bad = {"critic_loss": value} if metrics["count"] == 4 else {}
        return state, metrics | bad

    with runs.open_run(tmp_path, CONFIG) as run:
        with pytest.raises(RepresentError, match=r"^airl: critic_loss is .* after 200 env steps"):
            advance(run, step_fn)
        assert run.load_progress("airl", initial())[0] == 150


def test_other_metrics_need_not_be_finite():
    state = runs.advance(None, "airl", 0, lambda s: (s + 1, {"pearson": np.nan}), 2)
    assert state == 2


def test_state_of_another_shape_is_refused(tmp_path):
    with runs.open_run(tmp_path, CONFIG) as run:
        with pytest.raises(KeyboardInterrupt):
            advance(run, stopping(3))
        with pytest.raises(RepresentError, match=r"\['x'\] is float32\[1000\] .* float32\[7\]"):
            advance(run, state=initial(7))


# -- kill -9 ------------------------------------------------------------------------------------

SIZE_WHEN_KILLED = 500_000
SAVE_THAT_DIES = 3


def run_and_die(path, instant):
    """Runs in a child process, which kills itself in the middle of its third save."""
    die = functools.partial(os.kill, os.getpid(), signal.SIGKILL)
    save = checkpoint.save
    saves = []

    def die_when_arrays_appear(folder):
        while not any(f.is_file() for f in Path(folder).rglob("arrays*/**/*")):
            time.sleep(1e-4)
        die()

    def deadly_save(folder, tree):
        saves.append(folder)
        if len(saves) == SAVE_THAT_DIES:
            if instant == "while the arrays are written":
                threading.Thread(target=die_when_arrays_appear, args=(folder,)).start()
            else:
                checkpoint.replacing = lambda path: die()
        save(folder, tree)

    checkpoint.save = deadly_save
    advance(runs.open_run(path, CONFIG), state=initial(SIZE_WHEN_KILLED))


@pytest.mark.parametrize("instant", ["while the arrays are written", "before the last file"])
def test_killed_in_the_middle_of_saving(tmp_path, instant):
    here = Path(__file__)
    script = f"import test_loop; test_loop.run_and_die({str(tmp_path / 'run')!r}, {instant!r})"
    paths = [str(here.parent), str(here.parents[2]), os.environ.get("PYTHONPATH", "")]
    child = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert child.returncode == -signal.SIGKILL, child.stderr

    folder = tmp_path / "run" / "checkpoints" / "airl" / "progress"
    unfinished = folder / f"{SAVE_THAT_DIES * UNITS:012d}"
    assert unfinished.is_dir() and not checkpoint.is_whole(unfinished)
    with runs.open_run(tmp_path / "run", CONFIG, resume=True) as run:
        assert run.load_progress("airl", initial(SIZE_WHEN_KILLED))[0] == 2 * UNITS
        final = advance(run, state=initial(SIZE_WHEN_KILLED))
        assert [line["step"] for line in run.read_log()] == [50, 100, 150, 200, 250, 300]
    assert_same(final, advance(None, state=initial(SIZE_WHEN_KILLED)))
