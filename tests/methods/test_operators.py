"""Operators press keys as people do, and what they demonstrated ships."""

import dataclasses
import importlib.util

import numpy as np
import pytest

import represent_jax as rj
from represent_jax.envs import make_env
from represent_jax.errors import UsageError
from represent_jax.methods.operators import (
    OPERATORS,
    Driver,
    Operator,
    OperatorsConfig,
    View,
    keys_of,
)

START = View(np.array([-0.43, 0.12, 2.02]), np.array([-0.27, 0.35, 1.62]), 0.0)
EXACT = Operator(aim_error=0.0, pause_rate=0.0, think_steps=0.0, fast_share=0.0)


def _presses(operator, views, seed=0):
    hands = keys_of(operator, np.random.default_rng(seed))
    next(hands)
    return [hands.send(view) for view in views]


def test_an_operator_presses_two_keys_towards_where_the_hand_should_be():
    pressed = _presses(EXACT, [START] * 3)
    # Down by 30 cm and to the right by 16.
    assert pressed == [frozenset({"d", "e", "shift"})] * 3
    turned = _presses(dataclasses.replace(EXACT, strategy="hold"), [START])
    assert turned[0] - {"shift"} == {"z"}


def test_an_operator_thinks_pauses_and_differs_by_seed():
    operator = Operator(think_steps=20.0, pause_rate=0.5)
    runs = [_presses(operator, [START] * 100, seed) for seed in (0, 0, 1)]
    assert runs[0] == runs[1] != runs[2]
    assert runs[0][0] == frozenset() and any(runs[0])


@pytest.mark.skipif(
    importlib.util.find_spec("gymnasium_robotics") is None, reason="needs the extra 'kitchen'"
)
@pytest.mark.parametrize("name", sorted(OPERATORS))
def test_an_operator_pushes_the_kettle_through_the_keys(name):
    env = make_env(name, "mujoco")
    env.task.horizon = 150
    trajectory = Driver(env).episode(EXACT, seed=0)
    assert trajectory.length == 150
    start, end = trajectory.obs[0, 32:35], trajectory.obs[-1, 32:35]
    assert end[1] - start[1] > 0.01 and abs(end[0] - start[0]) < 0.02
    assert np.abs(trajectory.actions).max() <= 1.0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("strategy", "pull"), ("reaction_steps", -1), ("decision_steps", 0)),
        *(("aim_error", -1.0), ("pause_rate", 2.0), ("lapse_rate", -0.1)),
    ],
)
def test_operators_that_cannot_be_are_errors(field, value):
    with pytest.raises(UsageError, match=f"^{field}: expected .*, found {value!r}$"):
        Operator(**{field: value})


def test_styles_are_judged_by_two_demonstrations_at_least():
    with pytest.raises(UsageError, match=r"^demonstrations: expected 2 \("):
        OperatorsConfig(demonstrations=1)


@pytest.mark.parametrize(
    ("name", "successes", "best"), [("franka_kitchen", 5, -80.0), ("franka_kitchen_hand", 2, -85.0)]
)
def test_what_ships_is_at_the_papers_level_and_says_who_made_it(name, successes, best):
    demonstrations = rj.load_demonstrations(name)
    for strategy, target in enumerate(OperatorsConfig().target_returns):
        assert abs(demonstrations.mean_return(strategy) / target - 1.0) < 0.05
    assert demonstrations.metadata["style_accuracy"]["1-2"]["trajectories"] >= 0.95
    pushed, held = np.split(np.array(demonstrations.metadata["outcomes"]["success"]), 2)
    assert (pushed.sum(), held.sum()) == (successes, 0)
    test = rj.load_demonstrations(f"{name}_test")
    returns = np.array([t.total_reward for t in test.trajectories])
    assert len(returns) == 50 and returns.min() < -200.0 and returns.max() > best
    for data in (demonstrations, test):
        assert "scripted operators" in data.metadata["source"]
