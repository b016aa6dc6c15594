"""Real time, and keys of a page that may fall silent."""

import pytest

from represent_jax.teleoperation.keys import HeldKeys
from represent_jax.teleoperation.pace import Pace


def test_steps_are_due_at_the_control_rate():
    pace = Pace(dt=0.1)
    pace.restart(5.0)
    assert [pace.due(t) for t in (5.0, 5.05, 5.11, 5.15, 5.25)] == [1, 0, 1, 0, 1]
    assert pace.wait(5.25) == pytest.approx(0.05)
    assert pace.wait(9.0) == 0.0


def test_a_short_stall_is_made_up_for():
    pace = Pace(dt=0.01, max_debt=0.2)
    pace.restart(0.0)
    assert pace.due(0.0) == 1
    assert pace.due(0.125) == 12
    assert pace.wait(0.125) == pytest.approx(0.005)


def test_time_beyond_the_longest_debt_is_lost():
    pace = Pace(dt=0.01, max_debt=0.2)
    pace.restart(0.0)
    assert pace.due(3.0) == 20
    assert pace.due(3.0) == 0
    assert pace.due(3.0101) == 1


def test_a_slow_step_is_never_refused_altogether():
    pace = Pace(dt=2.0, max_debt=0.2)
    pace.restart(0.0)
    assert [pace.due(0.0), pace.due(1.9), pace.due(2.0)] == [1, 0, 1]


def test_speed_is_simulated_by_real_time():
    pace = Pace(dt=0.1, max_debt=0.1)
    pace.restart(0.0)
    for tick in range(11):
        pace.due(0.2 * tick)
    assert pace.speed == pytest.approx(0.6, abs=0.1)
    pace.restart(10.0)
    assert pace.speed == 1.0


def test_a_short_touch_counts_for_one_step():
    keys = HeldKeys()
    keys.update(["w", "a"], 0.0)
    keys.update(["a"], 0.01)
    assert keys.take(0.05) == {"w", "a"}
    assert keys.take(0.06) == {"a"}


def test_keys_not_heard_of_are_released():
    keys = HeldKeys(patience=1.0)
    keys.update(["w"], 0.0)
    assert keys.take(0.9) == {"w"}
    keys.update(["w"], 0.95)
    assert keys.take(1.9) == {"w"}
    assert keys.take(2.0) == frozenset()


def test_silence_is_since_anything_was_heard():
    keys = HeldKeys()
    assert keys.silence(7.0) == float("inf")
    keys.update(["w"], 7.0)
    keys.release()
    assert keys.silence(9.5) == 2.5
    keys.hear(9.5)
    assert keys.silence(10.0) == 0.5 and keys.take(10.0) == frozenset()


def test_released_keys_are_forgotten_even_if_no_step_took_them():
    keys = HeldKeys()
    keys.update(["w"], 0.0)
    keys.release()
    assert keys.take(0.0) == frozenset()
