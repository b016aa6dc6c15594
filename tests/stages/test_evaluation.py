"""Correlations against scipy, ties and degenerate input included."""

import jax.numpy as jnp
import numpy as np
from scipy import stats

from represent_jax.stages import evaluation


def test_correlations_agree_with_scipy():
    rng = np.random.default_rng(0)
    a = rng.normal(size=50)
    b = np.round(a + rng.normal(size=50), 1)  # with ties
    found = evaluation.correlate(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose(found.pearson, stats.pearsonr(a, b).statistic, rtol=1e-4)
    np.testing.assert_allclose(found.spearman, stats.spearmanr(a, b).statistic, rtol=1e-4)


def test_constant_input_is_nan_not_an_error():
    assert np.isnan(evaluation.pearson(jnp.ones(5), jnp.arange(5.0)))


def test_slope_is_that_of_least_squares():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=30), rng.normal(size=30)
    found = evaluation.slope(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose(found, stats.linregress(a, b).slope, rtol=1e-4)
    assert np.isnan(evaluation.slope(jnp.ones(5), jnp.arange(5.0)))
