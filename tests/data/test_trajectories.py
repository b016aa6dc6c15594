import dataclasses

import jax
import numpy as np
import pytest

from represent_jax import data
from represent_jax.errors import RepresentError


def trajectory(length=3, strategy=0, obs_dim=2, action_dim=1, terminated=False):
    rng = np.random.default_rng(length + 10 * strategy)
    return data.Trajectory(
        obs=rng.normal(size=(length + 1, obs_dim)),
        actions=rng.uniform(-1, 1, size=(length, action_dim)),
        rewards=np.arange(length) + strategy,
        terminated=terminated,
        strategy=strategy,
    )


def fields(**changes):
    values = {
        "obs": np.zeros((4, 2)),
        "actions": np.zeros((3, 1)),
        "rewards": np.zeros(3),
        "terminated": False,
        "strategy": 0,
    }
    return values | changes


def test_trajectory_holds_float32_and_its_return():
    made = trajectory(4)
    assert made.obs.dtype == made.actions.dtype == made.rewards.dtype == np.float32
    assert made.length == 4
    assert made.total_reward == 0 + 1 + 2 + 3


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"obs": np.zeros((3, 2))}, "3 actions has 3 observations, it needs 4"),
        ({"rewards": np.zeros(2)}, "3 steps has 2 rewards, it needs 3"),
        ({"rewards": np.zeros((3, 1))}, "rewards of a trajectory have 2 axes, they need 1"),
        ({"obs": np.zeros(4)}, "obs of a trajectory have 1 axes, they need 2"),
        (
            {"obs": np.zeros((1, 2)), "actions": np.zeros((0, 1)), "rewards": np.zeros(0)},
            "zero length",
        ),
        ({"obs": np.full((4, 2), np.nan)}, r"obs .* 8 of 8 values .* \(nan\) at step 0"),
        ({"rewards": np.array([0.0, 1e300, 0.0])}, r"rewards .* 1 of 3 .* \(inf\) at step 1"),
        ({"strategy": -1}, "count from 0, found -1"),
    ],
)
def test_trajectory_refuses(changes, message):
    with pytest.raises(RepresentError, match=message):
        data.Trajectory(**fields(**changes))


def test_demonstrations_by_strategy():
    demos = data.Demonstrations("cart", (trajectory(3, 1), trajectory(2, 0), trajectory(4, 1)))
    assert (demos.obs_dim, demos.action_dim, demos.num_strategies) == (2, 1, 2)
    assert [t.length for t in demos.of_strategy(1)] == [3, 4]
    assert demos.mean_return(1) == (6 + 10) / 2


@pytest.mark.parametrize(
    "trajectories, metadata, message",
    [
        ((), {}, "no trajectories"),
        ((trajectory(), trajectory(obs_dim=3)), {}, "obs of trajectory 1 have 3 .* have 2"),
        ((trajectory(), trajectory(action_dim=4)), {}, "actions of trajectory 1 have 4 .* have 1"),
        ((trajectory(), trajectory(strategy=2)), {}, r"strategies are \[0, 2\], expected \[0, 1\]"),
        ((trajectory(),), {"array": np.zeros(2)}, "metadata: .*not JSON serializable"),
    ],
)
def test_demonstrations_refuse(trajectories, metadata, message):
    with pytest.raises(RepresentError, match=message):
        data.Demonstrations("cart", trajectories, metadata)


def test_check_against_an_environment():
    actions = np.array([[0.1], [0.7], [-1.0]])
    demos = data.Demonstrations("cart", (data.Trajectory(**fields(actions=actions)),))
    demos.check_against(2, 1, -1.0, np.array([1.0]))
    demos.check_against(2, 1, -1.0, 0.7)
    with pytest.raises(RepresentError, match=r"observations have 2 .* environment's have 3"):
        demos.check_against(3, 1, -1.0, 1.0)
    with pytest.raises(RepresentError, match=r"actions have 1 .* environment's have 2"):
        demos.check_against(2, 2, -1.0, 1.0)
    with pytest.raises(
        RepresentError, match=r"action 0 at step 1 of trajectory 0 is 0.7, .* \[-1, 0.5\]"
    ):
        demos.check_against(2, 1, -1.0, 0.5)


def test_pad_unpad_round_trip():
    originals = (trajectory(3, 1, terminated=True), trajectory(5, 0))
    batch = data.pad(originals, horizon=5, noise_level=[0.25, 0.5])
    assert batch.obs.shape == (2, 6, 2)
    assert batch.actions.shape == (2, 5, 1)
    np.testing.assert_array_equal(batch.mask, [[1, 1, 1, 0, 0], [1, 1, 1, 1, 1]])
    np.testing.assert_array_equal(batch.obs[0, 3:], np.tile(originals[0].obs[-1], (3, 1)))
    np.testing.assert_array_equal(batch.noise_level, [0.25, 0.5])
    for original, back in zip(originals, data.unpad(batch), strict=True):
        for name in ("obs", "actions", "rewards", "terminated", "strategy"):
            np.testing.assert_array_equal(getattr(back, name), getattr(original, name))


def test_returns_with_and_without_jit():
    batch = data.pad((trajectory(3), trajectory(5, 1)), horizon=6)
    np.testing.assert_array_equal(data.returns(batch), [3, 15])
    np.testing.assert_array_equal(jax.jit(data.returns)(batch), [3, 15])


def test_pad_refuses_what_does_not_fit():
    with pytest.raises(RepresentError, match="7 steps exceeds the horizon of 5"):
        data.pad((trajectory(7),), horizon=5)
    with pytest.raises(RepresentError, match="no trajectories"):
        data.pad((), horizon=5)


def paused(obs, terminated=False):
    obs = np.asarray(obs, np.float32)[:, None]
    steps = np.arange(len(obs) - 1, dtype=np.float32)
    return data.Trajectory(obs, steps[:, None] / 10, steps, terminated, 0)


def test_without_pauses_keeps_the_steps_that_move():
    moving = data.without_pauses(paused([0.0, 0.0, 1.0, 1.05, 2.0, 2.0], terminated=True), 0.1)
    np.testing.assert_allclose(moving.obs[:, 0], [0.0, 1.05, 2.0])
    np.testing.assert_allclose(moving.rewards, [1.0, 3.0])
    np.testing.assert_allclose(moving.actions[:, 0], [0.1, 0.3])
    assert not moving.terminated


def test_without_pauses_takes_states_alone_and_keeps_all_where_asked():
    one = dataclasses.replace(paused([0.0, 0.0, 1.0]), actions=None, rewards=None)
    assert data.without_pauses(one, 0.1).length == 1
    assert data.without_pauses(one, 0.0) is one
    with pytest.raises(RepresentError, match="never moves"):
        data.without_pauses(one, 5.0)
