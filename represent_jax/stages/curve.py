"""Phase 2's noise-performance curve, fitted inside jit.

The model is Chen et al. (2020)'s and the REPRESENT paper's (Xue, Chen, Gombolay; RA-L 2025,
Section III-B)

    sigma(eta) = c / (1 + exp(-k (eta - x0))) + y0.

Fitted in these four parameters it is badly conditioned: where the data lie on one tail of the
sigmoid, c and -y0 run to the thousands and cancel. The fit therefore works with the values at the
two ends of the levels, a = sigma(eta_first) and b = sigma(eta_last), and with the shape between
them, a logistic normalised to run from 0 to 1,

    sigma(eta) = a + (b - a) g(eta),
    g(eta) = sinh(kappa t / 2) cosh(z_last / 2) / (sinh(kappa / 2) cosh(z / 2)),

where t in [0, 1] is the place between the ends, z = k (eta - x0) and kappa = k (eta_last -
eta_first). It has no cancellation for any k and x0. a and b enter linearly and are eliminated
(variable projection: Golub and Pereyra, 1973); Levenberg-Marquardt is left with the two shape
parameters log(-k) and z at the middle level, both bounded.
"""

import dataclasses
import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.config import require
from represent_jax.errors import RepresentError

_TINY = 1e-12
_DAMPING_RANGE = (1e-6, 1e6)
_START_STEEPNESS = (1.0, 3.0, 8.0, 20.0)
_START_MIDPOINTS = (0.0, 0.25, 0.5, 0.75, 1.0)


class CurveStatus(enum.IntEnum):
    """How a fit ended."""

    CONVERGED = 0
    MAX_ITERATIONS = 1
    NOT_FALLING = 2
    NON_FINITE = 3


_SENTENCES = {
    CurveStatus.CONVERGED: "the sigmoid fits and falls with the noise level",
    CurveStatus.MAX_ITERATIONS: (
        "the sigmoid falls and fits well enough, but the fit was still improving when its "
        "iterations ran out"
    ),
    CurveStatus.NOT_FALLING: (
        "the returns do not fall along a sigmoid as noise grows; "
        "a monotone (isotonic) fit is used instead"
    ),
    CurveStatus.NON_FINITE: "the returns hold NaN or infinity; there is no curve",
}


def describe(status: int) -> str:
    """Returns the status as a sentence a reader of the report understands."""
    return _SENTENCES[CurveStatus(int(status))]


@dataclasses.dataclass(frozen=True)
class CurveConfig:
    """Settings of the curve fit.

    Attributes:
        statistic: what stands for the trajectories of a level: their "median", which one fallen
            robot does not move, or the "mean" of the paper.
        reward_floor: no step of a rollout counts less than this quantile of the demonstrated
            steps' initial rewards; None: whatever they count. Noise leads where no demonstration
            was, where the initial reward is extrapolated: one level at which robots fall would set
            the scale of all others. For whoever computes the returns that `fit` is given; see
            `methods.pipeline.fit_curves`.
        targets: what the regression learns from: the "curve", or the "returns" of each level as
            they are, without a curve through them (an ablation). For the regression's caller.
        num_iterations: Levenberg-Marquardt iterations of every start.
        steepest: largest -k, per unit of noise level.
        flattest: smallest -k; above zero, so that the sigmoid can only fall.
        max_tail: bound on |k (eta - x0)| at the middle level: how far out on one of its tails the
            sigmoid may lie. At 10 the tail differs from an exponential by less than 1e-4.
        min_r2: smallest R^2 with which the sigmoid is accepted.
        min_drop: smallest fall from the first to the last level, in units of the range of the
            values, with which the sigmoid is accepted.
        tolerance: a fit counts as converged when a full Gauss-Newton step would lower its sum of
            squares by less than this fraction.
    """

    statistic: str = "median"
    reward_floor: float | None = 0.001
    targets: str = "curve"
    num_iterations: int = 60
    steepest: float = 50.0
    flattest: float = 0.1
    max_tail: float = 10.0
    min_r2: float = 0.5
    min_drop: float = 0.2
    tolerance: float = 1e-4

    def __post_init__(self):
        require(
            self.statistic in ("median", "mean"), "statistic", "'median' or 'mean'", self.statistic
        )
        require(
            self.targets in ("curve", "returns"), "targets", "'curve' or 'returns'", self.targets
        )
        floor = self.reward_floor
        require(floor is None or 0.0 <= floor < 1.0, "reward_floor", "none, or in [0, 1)", floor)
        require(self.num_iterations >= 1, "num_iterations", "at least 1", self.num_iterations)
        require(
            0 < self.flattest < self.steepest <= 100,
            "flattest, steepest",
            "0 < flattest < steepest <= 100",
            (self.flattest, self.steepest),
        )
        require(0 < self.max_tail <= 30, "max_tail", "in (0, 30]", self.max_tail)
        require(self.min_r2 <= 1, "min_r2", "at most 1", self.min_r2)
        require(self.min_drop <= 1, "min_drop", "at most 1", self.min_drop)
        require(self.tolerance > 0, "tolerance", "above 0", self.tolerance)


class Curve(NamedTuple):
    """A noise-performance curve; with a leading axis on every field when vmapped.

    Attributes:
        x0, y0, c, k: [] parameters of the sigmoid, of the rejected one under NOT_FALLING. Far out
            on a tail c and y0 are huge and cancel: use `evaluate`, not these.
        levels: [L] noise levels, ascending.
        scaled_returns: [L] typical return of each level, min-max scaled to [0, 1].
        fitted: [L] the curve at the levels: the targets of the regression.
        r2: [] coefficient of determination of the sigmoid on the scaled returns.
        status: [] int32 CurveStatus.
    """

    x0: jax.Array
    y0: jax.Array
    c: jax.Array
    k: jax.Array
    levels: jax.Array
    scaled_returns: jax.Array
    fitted: jax.Array
    r2: jax.Array
    status: jax.Array


def fit(levels: jax.Array, returns: jax.Array, config: CurveConfig) -> Curve:
    """Fits the noise-performance curve of one strategy; vmap over returns for several.

    The medians (or means) of each level are min-max scaled to [0, 1] (Chen et al., 2020), so the
    curve does not depend on the units of the learned reward. A sigmoid that does not fall or does
    not fit is replaced by the decreasing isotonic fit of these values, which the status says.

    Args:
        levels: [L] noise levels, ascending.
        returns: [L, repeats] returns of the trajectories of each level under the initial reward.
        config: the settings.

    Returns:
        The curve; every number in it is NaN where the returns are not finite.

    Raises:
        RepresentError: if the shapes do not agree or, where levels are concrete, do not ascend.
    """
    levels, returns = _check(levels, returns)
    typical = (jnp.median if config.statistic == "median" else jnp.mean)(returns, axis=1)
    low, high = jnp.min(typical), jnp.max(typical)
    finite = (
        jnp.all(jnp.isfinite(returns)) & jnp.isfinite(high - low) & jnp.all(jnp.isfinite(levels))
    )

    # Equal returns may differ in the last bits of their means, which must not be scaled up.
    rounding = 16 * jnp.finfo(returns.dtype).eps * jnp.max(jnp.abs(returns))
    varied = finite & (high - low > rounding)
    scaled = jnp.where(varied, (typical - low) / jnp.where(varied, high - low, 1.0), 0.0)
    places = jnp.where(finite, (levels - levels[0]) / (levels[-1] - levels[0]), 0.0)

    span = jnp.where(finite, levels[-1] - levels[0], 1.0)
    shape, converged = _fit_shape(places, span, scaled, config)
    kappa, z_middle = -jnp.exp(shape[0]), shape[1]
    logistic = _normalised_logistic(places, kappa, z_middle)
    first, drop = _regress(logistic, scaled)
    sigmoid = first - drop * logistic

    spread = jnp.sum((scaled - jnp.mean(scaled)) ** 2)
    r2 = 1.0 - jnp.sum((scaled - sigmoid) ** 2) / jnp.where(varied, spread, 1.0)
    r2 = jnp.where(varied, r2, 0.0)
    falls = (r2 >= config.min_r2) & (drop >= config.min_drop)
    status = jnp.where(converged, CurveStatus.CONVERGED, CurveStatus.MAX_ITERATIONS)
    status = jnp.where(falls, status, CurveStatus.NOT_FALLING)
    status = jnp.where(finite, status, CurveStatus.NON_FINITE).astype(jnp.int32)

    k = kappa / span
    x0 = levels[0] + 0.5 * span - z_middle / k
    z_first, z_last = z_middle - 0.5 * kappa, z_middle + 0.5 * kappa
    # logistic(z_last) - logistic(z_first), without the cancellation on a tail.
    rise = jnp.sinh(0.5 * kappa) / (2.0 * jnp.cosh(0.5 * z_first) * jnp.cosh(0.5 * z_last))
    c = -drop / rise
    numbers = dict(
        x0=x0,
        y0=first - c * jax.nn.sigmoid(z_first),
        c=c,
        k=k,
        scaled_returns=scaled,
        fitted=jnp.where(falls, sigmoid, decreasing(scaled)),
        r2=r2,
    )
    numbers = {name: jnp.where(finite, value, jnp.nan) for name, value in numbers.items()}
    return Curve(levels=levels, status=status, **numbers)


def evaluate(curve: Curve, eta: jax.Array) -> jax.Array:
    """Returns the curve of one strategy at noise levels eta [...], without cancellation.

    Under NOT_FALLING it is interpolated linearly between the levels and constant outside them.
    Outside the levels a sigmoid is an extrapolation, for which the data say nothing.
    """
    eta = jnp.asarray(eta, curve.fitted.dtype)
    start, span = curve.levels[0], curve.levels[-1] - curve.levels[0]
    middle = start + 0.5 * span
    logistic = _normalised_logistic(
        (eta - start) / span, curve.k * span, curve.k * (middle - curve.x0)
    )
    sigmoid = curve.fitted[0] + (curve.fitted[-1] - curve.fitted[0]) * logistic
    isotonic = jnp.interp(eta, curve.levels, curve.fitted)
    return jnp.where(curve.status == CurveStatus.NOT_FALLING, isotonic, sigmoid)


def decreasing(values: jax.Array) -> jax.Array:
    """Returns the least-squares non-increasing fit of values [L].

    This is what pooling adjacent violators finds, by its min-max formula (Robertson, Wright and
    Dykstra, 1988), which needs no data-dependent loop.
    """
    num = values.shape[0]
    total = jnp.concatenate([jnp.zeros(1, values.dtype), jnp.cumsum(values)])
    index = jnp.arange(num)
    first, last = index[:, None], index[None, :]
    means = (total[last + 1] - total[first]) / jnp.maximum(last - first + 1, 1)
    means = jnp.where(last >= first, means, -jnp.inf)
    best_end = jax.lax.cummax(means, axis=1, reverse=True)
    return jnp.min(jnp.where(last >= first, best_end, jnp.inf), axis=0)


def _check(levels: jax.Array, returns: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns both as floating arrays after checking their shapes and the order of the levels."""
    if np.ndim(levels) != 1 or np.shape(levels)[0] < 2:
        raise RepresentError(
            f"the curve needs levels [L] with L >= 2, found shape {np.shape(levels)}"
        )
    if np.ndim(returns) != 2 or np.shape(returns)[0] != np.shape(levels)[0]:
        raise RepresentError(
            f"the curve needs returns [{np.shape(levels)[0]}, repeats], one row a noise level, "
            f"found shape {np.shape(returns)}"
        )
    if not isinstance(levels, jax.core.Tracer) and not np.all(np.diff(levels) > 0):
        raise RepresentError(f"the noise levels must ascend, found {np.asarray(levels).tolist()}")
    returns = jnp.asarray(returns)
    returns = returns.astype(jnp.promote_types(returns.dtype, jnp.float32))
    return jnp.asarray(levels, returns.dtype), returns


def _normalised_logistic(places: jax.Array, kappa: jax.Array, z_middle: jax.Array) -> jax.Array:
    """Returns the logistic of slope kappa that is 0 at place 0 and 1 at place 1; kappa < 0."""
    z = z_middle + kappa * (places - 0.5)
    z_last = z_middle + 0.5 * kappa
    # cosh(x / 2) = exp(|x| / 2) (1 + exp(-|x|)) / 2, so no exponent below is above zero.
    near, near_last = jnp.exp(-jnp.abs(z)), jnp.exp(-jnp.abs(z_last))
    exponent = 0.5 * (kappa * (1.0 - places) + jnp.abs(z_last) - jnp.abs(z))
    ratio = jnp.expm1(kappa * places) / jnp.expm1(kappa)
    return ratio * jnp.exp(exponent) * (1.0 + near_last) / (1.0 + near)


def _regress(logistic: jax.Array, values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the first value and the drop >= 0 of the best `first - drop * logistic`."""
    centred = logistic - jnp.mean(logistic)
    drop = -jnp.sum(centred * values) / (jnp.sum(centred**2) + _TINY)
    drop = jnp.maximum(drop, 0.0)
    return jnp.mean(values) + drop * jnp.mean(logistic), drop


def _fit_shape(
    places: jax.Array, span: jax.Array, values: jax.Array, config: CurveConfig
) -> tuple[jax.Array, jax.Array]:
    """Returns the best shape [log(-kappa), z_middle] of all starts and whether it converged."""
    steepness = np.log([config.flattest, config.steepest])
    lower = jnp.stack([steepness[0] + jnp.log(span), -config.max_tail * jnp.ones_like(span)])
    upper = jnp.stack([steepness[1] + jnp.log(span), config.max_tail * jnp.ones_like(span)])

    def residuals(shape):
        logistic = _normalised_logistic(places, -jnp.exp(shape[0]), shape[1])
        first, drop = _regress(logistic, values)
        return values - first + drop * logistic

    def linearise(shape):
        """Returns cost [], gradient [2] and curvature [2, 2] of the parameters not at a bound."""
        errors, jacobian = residuals(shape), jax.jacfwd(residuals)(shape)
        gradient = jacobian.T @ errors
        held = ((shape <= lower) & (gradient > 0)) | ((shape >= upper) & (gradient < 0))
        jacobian = jnp.where(held, 0.0, jacobian)
        return jnp.sum(errors**2), jnp.where(held, 0.0, gradient), jacobian.T @ jacobian

    def solve(gradient, curvature, damping):
        """Returns the damped step [2], by Cramer's rule in units in which the diagonal is 1."""
        scale = jnp.sqrt(jnp.diagonal(curvature) + _TINY)
        overlap = curvature[0, 1] / (scale[0] * scale[1])
        slope = gradient / scale
        step = (1.0 + damping) * slope - overlap * slope[::-1]
        return step / ((1.0 + damping) ** 2 - overlap**2) / scale

    def iterate(carry, _):
        shape, damping = carry[:2]
        cost, gradient, curvature = linearise(shape)
        gain = gradient @ solve(gradient, curvature, _DAMPING_RANGE[0])
        trial = jnp.clip(shape - solve(gradient, curvature, damping), lower, upper)
        trial_cost = jnp.sum(residuals(trial) ** 2)
        better = trial_cost < cost
        damping = jnp.clip(jnp.where(better, damping / 4.0, damping * 3.0), *_DAMPING_RANGE)
        shape = jnp.where(better, trial, shape)
        return (shape, damping, jnp.where(better, trial_cost, cost), gain), None

    def descend(start):
        carry = (jnp.clip(start, lower, upper), *[jnp.ones_like(span)] * 3)
        (shape, _, cost, gain), _ = jax.lax.scan(iterate, carry, length=config.num_iterations)
        return shape, cost, gain

    shapes, costs, gains = jax.vmap(descend)(_starts(span))
    best = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
    # 1e-10 is the sum of squares at which a perfect fit to values of order 1 is rounding error.
    return shapes[best], gains[best] <= config.tolerance * costs[best] + 1e-10


def _starts(span: jax.Array) -> jax.Array:
    """Returns the starts [starts, 2], steepness x place of the midpoint between the levels."""
    kappa, midpoint = np.meshgrid(_START_STEEPNESS, _START_MIDPOINTS, indexing="ij")
    shapes = np.stack([np.log(kappa), -kappa * (0.5 - midpoint)], axis=-1).reshape(-1, 2)
    return jnp.asarray(shapes, span.dtype)
