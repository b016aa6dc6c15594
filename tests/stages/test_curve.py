"""The noise-performance curve against scipy, closed forms and bad input."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from represent_jax.errors import RepresentError, UsageError
from represent_jax.stages.curve import (
    CurveConfig,
    CurveStatus,
    decreasing,
    describe,
    evaluate,
    fit,
)

CONFIG = CurveConfig(statistic="mean")
LEVELS = 0.05 * np.arange(20)
HOPPER_LEVELS = LEVELS[:17]

# (x0, y0, c, k) of the fits released with Chen et al. (2020), five seeds a row.
RELEASED = {
    "hopper_airl": [
        (3.05, -1487, 1488, -3.26),
        (3.24, -1570, 1571, -3.03),
        (2.99, -2034, 2036, -3.52),
        (3.18, -334, 335, -2.38),
        (2.18, -50.4, 51.5, -2.75),
    ],
    "hopper_noisy_airl": [
        (0.97, -1.97, 3.24, -2.38),
        (0.56, -0.30, 1.41, -4.08),
        (3.91, -422, 423, -1.89),
        (3.34, -166, 167, -1.95),
        (3.82, -314, 316, -1.86),
    ],
    "half_cheetah_airl": [
        (-2.59, -0.21, 107, -1.73),
        (0.03, -0.01, 1.91, -4.14),
        (-0.67, -0.08, 7.22, -2.60),
        (0.08, -0.03, 1.74, -4.16),
        (0.03, -0.05, 1.97, -3.50),
    ],
    "half_cheetah_noisy_airl": [
        (0.29, 0.18, 1.07, -3.76),
        (0.47, 0.18, 0.65, -14.4),
        (-9.62, -2.81, 73.6, -0.30),
        (0.26, 0.20, 0.80, -14.7),
        (0.39, 0.14, 0.86, -8.38),
    ],
    "ant_noisy_airl": [
        (0.47, -0.36, 1.78, -2.75),
        (0.73, -1.04, 2.57, -1.82),
        (0.43, -0.41, 1.94, -2.48),
        (0.45, -0.17, 1.40, -3.78),
        (0.44, -0.08, 1.21, -4.78),
    ],
}

# Per-level means of two released noise data sets.
HOPPER_MEANS = [
    *(0.92, 1.0, 0.93, 0.87, 0.79, 0.79, 0.76, 0.68),
    *(0.58, 0.52, 0.47, 0.40, 0.33, 0.21, 0.28, 0.0),
]
HALF_CHEETAH_MEANS = [
    *(1.0, 0.98, 0.86, 0.90, 0.75, 0.71, 0.63, 0.63, 0.71, 0.61),
    *(0.54, 0.48, 0.60, 0.54, 0.0, 0.22, 0.41, 0.11, 0.44, 0.33),
]


@functools.partial(jax.jit, static_argnums=2)
def jitted_fit(levels, returns, config=CONFIG):
    return fit(levels, returns, config)


@jax.jit
def vmapped_fit(returns):
    return jax.vmap(lambda one: fit(LEVELS, one, CONFIG))(returns)


def repeated(means):
    """Returns returns [L, 5] with these means; one width, so that few programs are compiled."""
    return np.tile(np.asarray(means, np.float32)[:, None], 5)


def sigmoid(parameters, levels):
    x0, y0, c, k = parameters
    return c / (1.0 + np.exp(-k * (levels - x0))) + y0


def scaled(means):
    return (means - means.min()) / (means.max() - means.min())


def reference(levels, means):
    """Returns scipy's best fit in float64, same bounds, as (sum of squares, fitted)."""
    span, middle = levels[-1] - levels[0], 0.5 * (levels[0] + levels[-1])

    def curve(p):
        """The model as printed, in the values at both ends, log(-k) and z at the middle."""
        k = -np.exp(p[2])
        logistic = 1.0 / (1.0 + np.exp(-k * (levels - middle) - p[3]))
        return p[0] + (p[1] - p[0]) * (logistic - logistic[0]) / (logistic[-1] - logistic[0])

    tail = CONFIG.max_tail
    lower = [-np.inf, -np.inf, np.log(CONFIG.flattest), -tail]
    upper = [np.inf, np.inf, np.log(CONFIG.steepest), tail]
    fits = []
    for k in (-2.0, -6.0, -15.0):
        for x0 in (0.0, 0.5, 1.0):
            start = [1.0, 0.0, np.log(-k), np.clip(k * span * (0.5 - x0), -0.9 * tail, 0.9 * tail)]
            fits.append(
                scipy.optimize.least_squares(
                    lambda p: curve(p) - means, start, bounds=(lower, upper)
                )
            )
    best = min(fits, key=lambda found: found.cost)
    return 2.0 * best.cost, curve(best.x)


def assert_as_good_as_scipy(levels, returns):
    found = jitted_fit(levels, returns)
    means = scaled(np.asarray(returns, np.float64).mean(axis=1))
    expected_squares, expected = reference(levels, means)
    squares = np.sum((np.asarray(found.fitted, np.float64) - means) ** 2)
    assert found.status == CurveStatus.CONVERGED
    assert squares <= expected_squares * 1.0001 + 1e-9
    np.testing.assert_allclose(found.fitted, expected, atol=3e-4)
    np.testing.assert_allclose(found.scaled_returns, means, atol=1e-5)
    spread = np.sum((means - means.mean()) ** 2)
    np.testing.assert_allclose(found.r2, 1.0 - expected_squares / spread, atol=1e-5)


@pytest.mark.parametrize("name", RELEASED)
def test_agrees_with_scipy_on_noisy_released_shapes(name):
    levels = HOPPER_LEVELS if name.startswith("hopper") else LEVELS
    random = np.random.default_rng(0)
    for parameters in RELEASED[name]:
        noise = random.normal(scale=0.1, size=(levels.size, 5))
        returns = 4000.0 * (sigmoid(parameters, levels)[:, None] + noise) - 13000.0
        assert_as_good_as_scipy(levels, returns.astype(np.float32))


@pytest.mark.parametrize("name", RELEASED)
def test_recovers_noiseless_released_curves(name):
    levels = HOPPER_LEVELS if name.startswith("hopper") else LEVELS
    for parameters in RELEASED[name]:
        values = sigmoid(np.float64(parameters), levels)
        curve = jitted_fit(levels, repeated(values))
        np.testing.assert_allclose(curve.fitted, scaled(values), atol=2e-6)
        between = np.linspace(levels[0], levels[-1], 101)
        expected = (sigmoid(parameters, between) - values.min()) / np.ptp(values)
        np.testing.assert_allclose(evaluate(curve, between), expected, atol=2e-5)
        np.testing.assert_allclose(curve.k, parameters[3], rtol=0.02)


@pytest.mark.parametrize("means", [HOPPER_MEANS, HALF_CHEETAH_MEANS])
def test_agrees_with_scipy_on_released_means(means):
    means = np.asarray(means)
    assert_as_good_as_scipy(LEVELS[: means.size], repeated(means))


def test_reports_the_parameters_it_was_made_from():
    parameters = (0.45, -0.2, 1.4, -6.0)
    values = sigmoid(parameters, LEVELS)
    curve = jitted_fit(LEVELS, repeated(7.0 * values + 3.0))
    low, scale = values.min(), np.ptp(values)
    np.testing.assert_allclose(
        [curve.x0, curve.y0, curve.c, curve.k],
        [0.45, (-0.2 - low) / scale, 1.4 / scale, -6.0],
        rtol=1e-3,
    )
    reported = sigmoid([float(curve.x0), float(curve.y0), float(curve.c), float(curve.k)], LEVELS)
    np.testing.assert_allclose(reported, curve.fitted, atol=1e-5)
    np.testing.assert_allclose(curve.r2, 1.0, atol=1e-6)


def test_is_indifferent_to_the_units_of_the_reward():
    returns = repeated(HALF_CHEETAH_MEANS)
    plain = jitted_fit(LEVELS, returns)
    other = jitted_fit(LEVELS, 250.0 * returns - 1000.0)
    np.testing.assert_allclose(plain.fitted, other.fitted, atol=1e-4)


def test_levels_may_start_above_zero_and_be_uneven():
    levels = np.array([0.1, 0.15, 0.3, 0.5, 0.55, 0.7, 0.9])
    values = sigmoid((0.5, 0.0, 1.0, -9.0), levels)
    curve = jitted_fit(levels, repeated(values))
    np.testing.assert_allclose([curve.x0, curve.k], [0.5, -9.0], rtol=1e-3)
    np.testing.assert_allclose(evaluate(curve, levels), curve.fitted, atol=1e-6)


def test_jit_agrees_with_no_jit():
    returns = repeated(HALF_CHEETAH_MEANS)
    plain = fit(LEVELS, returns, CONFIG)
    compiled = jitted_fit(LEVELS, returns)
    np.testing.assert_allclose(plain.fitted, compiled.fitted, atol=1e-4)
    assert plain.status == compiled.status


def test_vmap_agrees_with_a_loop():
    random = np.random.default_rng(1)
    shapes = [sigmoid(p, LEVELS) for p in RELEASED["half_cheetah_noisy_airl"]]
    returns = np.stack(shapes)[:, :, None] + random.normal(scale=0.05, size=(5, 20, 5))
    returns[4] = returns[4, ::-1]
    curves = vmapped_fit(returns)
    for i in range(5):
        one = jitted_fit(LEVELS, returns[i])
        np.testing.assert_allclose(curves.fitted[i], one.fitted, atol=5e-5)
        assert curves.status[i] == one.status
    assert curves.status.dtype == jnp.int32
    values = jax.vmap(evaluate, in_axes=(0, None))(curves, LEVELS)
    np.testing.assert_allclose(values, curves.fitted, atol=1e-5)


def test_rising_returns_fall_back_to_a_monotone_fit():
    curve = jitted_fit(LEVELS, repeated(LEVELS) + np.arange(5.0))
    assert curve.status == CurveStatus.NOT_FALLING
    np.testing.assert_allclose(curve.fitted, 0.5, atol=1e-6)
    assert "isotonic" in describe(curve.status)


def test_a_poor_fit_falls_back_to_a_monotone_fit():
    means = np.where(np.arange(20) % 2, 0.0, 1.0) - 0.3 * LEVELS
    curve = jitted_fit(LEVELS, repeated(means))
    assert curve.status == CurveStatus.NOT_FALLING
    assert curve.r2 < CONFIG.min_r2
    assert np.all(np.diff(curve.fitted) <= 0)
    np.testing.assert_allclose(evaluate(curve, LEVELS[3:5]), curve.fitted[3:5], atol=1e-6)
    halfway = 0.5 * (curve.fitted[3] + curve.fitted[4])
    np.testing.assert_allclose(evaluate(curve, 0.175), halfway, atol=1e-6)


@pytest.mark.parametrize("value", [0.0, -13000.1])
def test_constant_returns_give_no_nan(value):
    curve = jitted_fit(LEVELS, np.full((20, 5), value))
    assert curve.status == CurveStatus.NOT_FALLING
    assert all(np.all(np.isfinite(field)) for field in curve)
    np.testing.assert_array_equal(curve.fitted, 0.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_returns_are_reported_and_leave_the_others_alone(bad):
    returns = np.stack([repeated(sigmoid((0.4, 0.0, 1.0, -7.0), LEVELS))] * 5)
    returns[0, 4, 0] = bad
    curves = vmapped_fit(returns)
    assert list(curves.status) == [CurveStatus.NON_FINITE] + 4 * [CurveStatus.CONVERGED]
    assert np.all(np.isnan(curves.fitted[0])) and np.isnan(curves.r2[0])
    assert np.all(np.isfinite(curves.fitted[1:]))


def test_too_few_iterations_are_reported():
    returns = repeated(sigmoid((2.9, -200.0, 202.0, -3.0), LEVELS))
    returns = returns + np.random.default_rng(0).normal(scale=0.02, size=returns.shape)
    curve = jitted_fit(LEVELS, returns, CurveConfig(num_iterations=1, tolerance=1e-6))
    assert curve.status == CurveStatus.MAX_ITERATIONS
    assert curve.r2 > 0.5


def test_decreasing_pools_adjacent_violators():
    np.testing.assert_allclose(decreasing(jnp.array([3.0, 1.0, 2.0, 0.0])), [3, 1.5, 1.5, 0])
    np.testing.assert_allclose(decreasing(jnp.array([1.0, 2.0, 3.0])), [2, 2, 2])
    values = np.random.default_rng(2).normal(size=30).astype(np.float32)
    expected = scipy.optimize.isotonic_regression(values, increasing=False).x
    np.testing.assert_allclose(jax.jit(decreasing)(values), expected, atol=1e-5)


def test_every_status_has_a_sentence():
    assert len({describe(status) for status in CurveStatus}) == len(CurveStatus)


def test_bad_shapes_and_settings_are_refused():
    with pytest.raises(RepresentError, match=r"returns \[20, repeats\]"):
        fit(LEVELS, np.zeros((19, 5)), CONFIG)
    with pytest.raises(RepresentError, match="L >= 2"):
        fit(LEVELS[:1], np.zeros((1, 5)), CONFIG)
    with pytest.raises(RepresentError, match="must ascend"):
        fit(LEVELS[::-1], np.zeros((20, 5)), CONFIG)
    with pytest.raises(UsageError, match="flattest"):
        CurveConfig(flattest=60.0)
    with pytest.raises(UsageError, match="statistic"):
        CurveConfig(statistic="mode")


def test_one_fallen_robot_moves_the_mean_but_not_the_median():
    returns = repeated(HOPPER_MEANS)
    levels = LEVELS[: len(HOPPER_MEANS)]
    fallen = returns.copy()
    fallen[8, 0] -= 100.0
    clean, median = (fit(levels, r, CurveConfig()) for r in (returns, fallen))
    np.testing.assert_array_equal(clean.fitted, median.fitted)
    assert float(jitted_fit(levels, fallen).r2) < 0.5 < float(median.r2)
