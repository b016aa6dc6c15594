"""Aggregates over seeds, as Agarwal et al. (NeurIPS 2021, arXiv 2108.13264) advise."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

BOOTSTRAP_SAMPLES = 9_999


class Aggregate(NamedTuple):
    """What several seeds say together.

    Attributes:
      num: number of seeds.
      mean, std: mean and sample standard deviation; the latter is NaN for a single seed.
      iqm: interquartile mean.
      low, high: 95 % bootstrap interval of the interquartile mean; NaN for a single seed.
    """

    num: int
    mean: float
    std: float
    iqm: float
    low: float
    high: float


def aggregate(values: Sequence[float]) -> Aggregate:
    """Aggregates one value a seed; the bootstrap's own seed is fixed.

    Raises:
      ValueError: no values, or some that are not finite.
    """
    x = np.asarray(values, float)
    if x.size == 0 or not np.isfinite(x).all():
        raise ValueError(f"values: expected finite numbers, at least one, found {values}")
    if x.size == 1:
        nan = float("nan")
        return Aggregate(1, float(x[0]), nan, float(x[0]), nan, nan)
    if np.ptp(x) == 0.0:
        return Aggregate(x.size, float(x[0]), 0.0, float(x[0]), float(x[0]), float(x[0]))
    interval = stats.bootstrap(
        (x,),
        _iqm,
        n_resamples=BOOTSTRAP_SAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Aggregate(
        x.size,
        float(x.mean()),
        float(x.std(ddof=1)),
        float(_iqm(x)),
        float(interval.low),
        float(interval.high),
    )


def _iqm(x: np.ndarray, axis: int = -1) -> np.ndarray:
    return stats.trim_mean(x, 0.25, axis=axis)
