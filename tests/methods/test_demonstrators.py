"""Which snapshot becomes whose demonstrations."""

import numpy as np
import pytest

from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.errors import RepresentError, UsageError
from represent_jax.methods import demonstrators
from represent_jax.methods.demonstrators import DemonstratorConfig, Snapshot


def _snapshot(env_steps, returns, accuracy=1.0):
    """Two episodes of four steps for each skill, worth the given return."""
    num_skills = len(returns)
    rewards = np.tile(np.asarray(returns, float)[:, None, None] / 4, (1, 2, 4))
    batch = TrajectoryBatch(
        obs=np.zeros((num_skills, 2, 5, 3)),
        actions=np.zeros((num_skills, 2, 4, 1)),
        rewards=rewards,
        mask=np.ones((num_skills, 2, 4)),
        strategy=np.zeros((num_skills, 2), np.int32),
        noise_level=np.zeros((num_skills, 2)),
    )
    return Snapshot(env_steps, batch, np.full(num_skills, accuracy))


def test_each_target_gets_the_nearest_snapshot_of_the_skill_that_serves_it_best():
    snapshots = [_snapshot(10, (5, 50)), _snapshot(20, (9, 102)), _snapshot(30, (40, 200))]
    chosen, env_steps = demonstrators.choose_demonstrations(snapshots, (100.0, 10.0))
    returns = {t.strategy: t.total_reward for t in chosen}
    assert returns == {0: pytest.approx(102.0), 1: pytest.approx(9.0)}
    assert env_steps == [20, 20] and len(chosen) == 4


def test_who_runs_and_then_lies_down_is_not_steady():
    steady, falling = _snapshot(10, (90.0,)), _snapshot(20, (100.0,))
    falling.trajectories.rewards[..., :2] *= 2.0
    falling.trajectories.rewards[..., 2:] = 0.0
    for weight, expected in ((0.0, 20), (1.0, 10)):
        _, env_steps = demonstrators.choose_demonstrations(
            [steady, falling], (100.0,), steadiness_weight=weight
        )
        assert env_steps == [expected]


def test_a_skill_that_is_not_known_yet_does_not_demonstrate():
    snapshots = [_snapshot(10, (100, 10), accuracy=0.5), _snapshot(20, (130, 13))]
    _, env_steps = demonstrators.choose_demonstrations(snapshots, (100.0, 10.0), 0.9)
    assert env_steps == [20, 20]
    with pytest.raises(RepresentError, match="never known"):
        demonstrators.choose_demonstrations(snapshots[:1], (100.0, 10.0), 0.9)


def test_test_set_spreads_over_training():
    snapshots = [_snapshot(i, (i, 2 * i)) for i in range(11)]
    chosen = demonstrators.choose_test_set(snapshots, num_snapshots=3, per_skill=1)
    assert [t.total_reward for t in chosen] == pytest.approx([0, 0, 5, 10, 10, 20])


def test_bad_settings_are_named():
    with pytest.raises(UsageError, match="target_returns"):
        DemonstratorConfig(target_returns=(1.0,))
    with pytest.raises(UsageError, match="test_seed"):
        DemonstratorConfig(seed=3, test_seed=3)
    with pytest.raises(UsageError, match=r"target_returns.*none that is 0"):
        DemonstratorConfig(target_returns=(0.0, 1.0, 2.0))
    for field, value in (
        *(("env_steps", 0), ("snapshot_env_steps", 0), ("demonstration_horizon", -1)),
        *(("trajectories_per_skill", 1), ("test_trajectories_per_skill", 0)),
        *(("test_snapshots", 1), ("min_skill_accuracy", 7.0)),
    ):
        with pytest.raises(UsageError, match=f"^{field}: expected"):
            DemonstratorConfig(**{field: value})
