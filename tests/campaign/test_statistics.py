"""Aggregates over seeds against closed forms."""

import math

import numpy as np
import pytest

from represent_jax.campaign.statistics import aggregate


def test_mean_std_and_interquartile_mean():
    found = aggregate([1.0, 2.0, 3.0, 4.0, 100.0, -50.0, 2.5, 3.5])
    assert found.num == 8
    assert found.mean == pytest.approx(66.0 / 8)
    assert found.std == pytest.approx(np.std([1, 2, 3, 4, 100, -50, 2.5, 3.5], ddof=1))
    # The lowest and the highest two are left out.
    assert found.iqm == pytest.approx((2.0 + 2.5 + 3.0 + 3.5) / 4)
    assert found.low <= found.iqm <= found.high


def test_interval_covers_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = [
        found.low <= 0.0 <= found.high
        for found in (aggregate(rng.normal(size=20)) for _ in range(60))
    ]
    assert 0.85 <= np.mean(covered) <= 1.0


def test_equal_values_have_no_spread_and_one_seed_has_none_to_tell():
    same = aggregate([2.0, 2.0, 2.0])
    assert same[1:] == (2.0, 0.0, 2.0, 2.0, 2.0)
    alone = aggregate([2.0])
    assert alone.mean == alone.iqm == 2.0
    assert all(math.isnan(value) for value in (alone.std, alone.low, alone.high))


def test_what_is_not_finite_is_refused():
    for values in ([], [1.0, float("nan")]):
        with pytest.raises(ValueError, match="finite"):
            aggregate(values)
