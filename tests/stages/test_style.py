"""The style classifier on styles that differ, and on styles that do not."""

import numpy as np
import pytest

from represent_jax.data.trajectories import Trajectory
from represent_jax.errors import RepresentError
from represent_jax.stages import style


def _trajectories(places, num=4, length=60):
    rng = np.random.default_rng(0)
    return [
        Trajectory(
            obs=rng.normal(size=(length + 1, 3)) + place,
            actions=np.zeros((length, 1)),
            rewards=np.zeros(length),
            terminated=False,
            strategy=strategy,
        )
        for strategy, place in enumerate(places)
        for _ in range(num)
    ]


def test_distant_styles_are_told_apart_and_equal_ones_are_not():
    accuracy = style.pairwise_accuracy(_trajectories((-3.0, 3.0, 3.0)))
    assert accuracy["1-2"]["states"] > 0.99 and accuracy["1-2"]["trajectories"] == 1.0
    assert accuracy["2-3"]["states"] < 0.7


def test_a_single_trajectory_cannot_be_judged():
    with pytest.raises(RepresentError, match="strategy 1: expected at least 2 trajectories"):
        style.pairwise_accuracy(_trajectories((-3.0, 3.0), num=1))
