"""How time and memory grow: measured at small sizes, extrapolated along a line from there.

Seeds, strategies and targets are members of one population, so the axis of seeds stands for all
three; the axis of strategies is that of the joint regression, which trains them as one member.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents.rollout import rollout
from represent_jax.data.trajectories import TrajectoryBatch
from represent_jax.envs import Episode, make_env
from represent_jax.errors import UsageError, unknown
from represent_jax.stages import regression
from represent_jax.stages.regression import RegressionData
from represent_jax.stages.regression_config import RegressionConfig

_OBS_DIM, _ACTION_DIM, _HORIZON = 17, 6, 1_000  # HalfCheetah's
_UPDATES = 5
_LEVELS = 20  # noisy rollouts of a strategy

Program = tuple[Callable, tuple]


@dataclasses.dataclass(frozen=True)
class Growth:
    """What one size takes.

    Attributes:
      axis: what grows.
      work: what is done at that size.
      size: how many seeds, environments, and so on.
      seconds: the median of the rounds, or a point of the line.
      mib: what the compiled program keeps: arguments, outputs, temporary arrays.
      measured: whether it was; else it was extrapolated.
    """

    axis: str
    work: str
    size: int
    seconds: float
    mib: float
    measured: bool


@dataclasses.dataclass(frozen=True)
class Line:
    """start + slope * size, through points by least squares, and how well it explains them.

    Attributes:
      start, slope: of the line.
      r_squared: share of the points' variance; 1 where they do not vary.
    """

    start: float
    slope: float
    r_squared: float

    def at(self, size: float) -> float:
        return self.start + self.slope * size


def fit_line(sizes: Sequence[float], values: Sequence[float]) -> Line:
    """Fits a line by least squares; at least two different sizes are needed."""
    slope, start = np.polyfit(sizes, values, 1)
    rest = np.asarray(values) - (start + slope * np.asarray(sizes))
    spread = np.sum(np.square(values - np.mean(values)))
    explained = 1.0 - np.sum(np.square(rest)) / spread if spread > 0 else 1.0
    return Line(float(start), float(slope), float(explained))


def parse(text: str) -> tuple[str, list[int], list[int]]:
    """Reads `axis:measured sizes:extrapolated sizes`, sizes apart by commas.

    Raises:
      UsageError: no such axis, or sizes that are none, or fewer than two to measure.
    """
    axis, _, sizes = text.partition(":")
    if axis not in AXES:
        raise unknown("axis", axis, AXES)
    measured, _, far = sizes.partition(":")
    lists = [[int(size) for size in part.split(",") if size.isdigit()] for part in (measured, far)]
    given = sum(len(part.split(",")) for part in (measured, far) if part)
    if given != sum(map(len, lists)) or len(set(lists[0])) < 2 or 0 in (*lists[0], *lists[1]):
        raise UsageError(f"scaling: expected axis:1,2,4:64, found {text!r}")
    return axis, *lists


def measure(
    axis: str, sizes: Sequence[int], far: Sequence[int], repeats: int
) -> tuple[list[Growth], Line, Line]:
    """Measures an axis, and extrapolates it.

    Args:
      axis: one of `AXES`.
      sizes: where it is measured.
      far: where it is extrapolated.
      repeats: rounds, in which the sizes take turns.

    Returns:
      A row for every size, and the lines of seconds and of MiB.
    """
    make, work = AXES[axis]
    programs = [_compiled(make(size)) for size in sizes]
    rounds = [[_seconds(*program[:2]) for program in programs] for _ in range(repeats)]
    seconds = np.median(rounds, axis=0)
    mib = [program[2] for program in programs]
    lines = fit_line(sizes, seconds), fit_line(sizes, mib)
    rows = [
        Growth(axis, work, *row, measured=True) for row in zip(sizes, seconds, mib, strict=True)
    ]
    rows += [
        Growth(axis, work, size, *(line.at(size) for line in lines), measured=False) for size in far
    ]
    return rows, *lines


def _compiled(program: Program) -> tuple[Callable, tuple, float]:
    """Compiles and warms up a program; returns it, its arguments, and the MiB that it keeps."""
    function, arguments = program
    compiled = jax.jit(function).lower(*arguments).compile()
    jax.block_until_ready(compiled(*arguments))
    plan = compiled.memory_analysis()
    kept = plan.argument_size_in_bytes + plan.output_size_in_bytes + plan.temp_size_in_bytes
    return compiled, arguments, kept / 2**20


def _seconds(compiled: Callable, arguments: tuple) -> float:
    start = time.perf_counter()
    jax.block_until_ready(compiled(*arguments))
    return time.perf_counter() - start


def _seeds(size: int) -> Program:
    """Regressions of one strategy each, side by side in one vmap."""
    config = RegressionConfig()
    data = _regression_data(1, 5)
    keys = jax.random.split(jax.random.PRNGKey(0), size)
    states = jax.vmap(lambda key: regression.init(key, _OBS_DIM, _ACTION_DIM, 1, config))(keys)
    data = jax.tree.map(lambda x: jnp.stack([x] * size), data)
    return jax.vmap(lambda state, data: regression.train(state, data, config, _UPDATES)), (
        states,
        data,
    )


def _strategies(size: int) -> Program:
    return _joint_regression(size, 5)


def _demonstrations(size: int) -> Program:
    return _joint_regression(2, size)


def _joint_regression(num_strategies: int, num_demonstrations: int) -> Program:
    config = RegressionConfig()
    key = jax.random.PRNGKey(0)
    state = regression.init(key, _OBS_DIM, _ACTION_DIM, num_strategies, config)
    data = _regression_data(num_strategies, num_demonstrations)
    return lambda state, data: regression.train(state, data, config, _UPDATES), (state, data)


def _regression_data(num_strategies: int, num_demonstrations: int) -> RegressionData:
    rng = np.random.default_rng(0)

    def batch(num: int) -> TrajectoryBatch:
        shape = (num_strategies, num)
        obs = rng.normal(size=(*shape, _HORIZON + 1, _OBS_DIM))
        actions = rng.uniform(-1.0, 1.0, (*shape, _HORIZON, _ACTION_DIM))
        strategy = np.tile(np.arange(num_strategies, dtype=np.int32)[:, None], (1, num))
        return TrajectoryBatch(
            obs=jnp.asarray(obs, jnp.float32),
            actions=jnp.asarray(actions, jnp.float32),
            rewards=jnp.zeros((*shape, _HORIZON)),
            mask=jnp.ones((*shape, _HORIZON)),
            strategy=jnp.asarray(strategy),
            noise_level=jnp.zeros(shape),
        )

    targets = jnp.asarray(rng.uniform(size=(num_strategies, _LEVELS)), jnp.float32)
    return RegressionData(batch(_LEVELS), targets, batch(num_demonstrations))


def _environments(size: int) -> Program:
    return _rollouts(size, 100)


def _horizon(size: int) -> Program:
    return _rollouts(20, size)


def _rollouts(num_envs: int, horizon: int) -> Program:
    env = Episode(make_env("half_cheetah"), horizon, auto_reset=False)

    def act(params: jax.Array, obs_t: jax.Array, key: jax.Array) -> jax.Array:
        return jnp.tanh(obs_t @ params)

    def run(params: jax.Array, key: jax.Array) -> TrajectoryBatch:
        return rollout(env, act, params, key, jnp.full(num_envs, 0.5))

    return run, (jnp.ones((_OBS_DIM, _ACTION_DIM)), jax.random.PRNGKey(0))


AXES: dict[str, tuple[Callable[[int], Program], str]] = {
    "seeds": (_seeds, f"{_UPDATES} updates of a regression each"),
    "environments": (_environments, "rollouts of 100 steps"),
    "strategies": (_strategies, f"{_UPDATES} updates of the joint regression"),
    "demonstrations": (_demonstrations, f"{_UPDATES} updates, two strategies"),
    "horizon": (_horizon, "20 rollouts"),
}
