"""What launchers refuse before anything runs."""

import os

import pytest
from absl import flags
from absl.testing import flagsaver

from experiments import launch
from represent_jax.errors import RepresentError, UsageError


def test_settings_are_passed_on():
    assert launch.overrides(["airl.env_steps=3", "horizon=5"]) == ["airl.env_steps=3", "horizon=5"]


@pytest.mark.parametrize("override", ["seed=7", "preset=paper", "method=ssrr", "env=hopper"])
def test_what_has_a_flag_is_no_override(override):
    with pytest.raises(UsageError, match=rf"--override {override}: expected a flag for"):
        launch.overrides(["horizon=5", override])


def test_only_smoke_is_compiled_quickly_and_only_where_nobody_says_how(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    launch.compile_quickly("quick")
    assert "XLA_FLAGS" not in os.environ
    launch.compile_quickly("smoke")
    assert "--xla_backend_optimization_level=0" in os.environ["XLA_FLAGS"]
    monkeypatch.setenv("XLA_FLAGS", "--xla_dump_to=/dump")
    launch.compile_quickly("smoke")
    assert os.environ["XLA_FLAGS"] == "--xla_dump_to=/dump"


def test_files_that_cannot_be_written_are_refused_and_others_left_as_they_are(tmp_path):
    new, old, place = tmp_path / "folder" / "new", tmp_path / "old", tmp_path / "old" / "below"
    old.write_text("kept")
    launch.require_writable(new)
    launch.require_writable(old)
    assert not new.exists() and old.read_text() == "kept"
    with pytest.raises(RepresentError, match="old/below: cannot be written"):
        launch.require_writable(place)
    launch.refuse_to_replace(new)
    with pytest.raises(UsageError, match=r"out: .*old exists already"):
        launch.refuse_to_replace(old)


def test_a_launcher_that_runs_alone_refuses_other_processes(capsys):
    flags.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(distributed=True), pytest.raises(SystemExit):
        launch._guarded(lambda argv: pytest.fail("it ran"), [], distributed=False)
    assert "--distributed: expected experiments.represent" in capsys.readouterr().err


def test_flags_that_would_do_nothing_are_named(monkeypatch):
    names = ("coordinator", "num_processes", "process")
    launch.refuse_beside("without --distributed", names)
    monkeypatch.setattr(flags.FLAGS["process"], "present", 1)
    with pytest.raises(UsageError, match=r"^--process: without effect without --distributed$"):
        launch.refuse_beside("without --distributed", names)
