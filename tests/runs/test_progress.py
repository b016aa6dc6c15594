import sys

import pytest

from represent_jax.runs import progress as module
from represent_jax.runs.progress import progress


@pytest.fixture
def clock(monkeypatch):
    class Clock:
        now = 100.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


def test_lines_are_rare_and_tell_rate_and_time_left(clock, capsys):
    with progress("airl", 10_000, "env steps") as bar:
        assert capsys.readouterr().err == "airl: 0 of 10,000 env steps (0%)\n"
        clock.now += 30  # compilation
        bar.update(1000, "loss 2")
        assert capsys.readouterr().err == "airl: 1,000 of 10,000 env steps (10%), loss 2\n"
        clock.now += 5
        bar.update(1000, "loss 1.5")
        assert capsys.readouterr().err == ""
        clock.now += 5
        bar.update(1000, "loss 1")
        line = "airl: 3,000 of 10,000 env steps (30%), 200/s, 00:35 left, loss 1\n"
        assert capsys.readouterr().err == line
        bar.update(7000)
    assert capsys.readouterr().err.startswith("airl: 10,000 of 10,000 env steps (100%), ")


def test_lines_of_a_resumed_task(clock, capsys):
    with progress("airl", 100, "updates", initial=40) as bar:
        bar.update(10)
        clock.now += 1
        bar.update(10)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "airl: 40 of 100 updates (40%)"
    assert lines[-1] == "airl: 60 of 100 updates (60%), 10.0/s, 00:04 left"


def test_lines_of_a_task_that_does_nothing(clock, capsys):
    with progress("airl", 0, "updates"):
        pass
    assert capsys.readouterr().err == "airl: 0 of 0 updates (0%)\n"


def test_bar_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress("airl", 1000, "env steps", initial=500) as bar:
        assert "airl:  50%" in capsys.readouterr().err
        bar.update(500, "loss 2")
    shown = capsys.readouterr().err
    assert "airl: 100%" in shown
    assert "1.00k/1.00k" in shown
    assert " env steps/s, loss 2]" in shown


def test_errors_pass_through(capsys):
    with pytest.raises(KeyError), progress("airl", 10, "updates"):
        raise KeyError
