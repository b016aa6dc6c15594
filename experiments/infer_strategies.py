"""Finds out how many strategies a pool of demonstrations shows, and which trajectory shows which.

python -m experiments.infer_strategies --demonstrations=pool.npz --out=labelled.npz
python -m experiments.represent --env=half_cheetah --demonstrations=labelled.npz \\
    --override num_strategies=3

Labels that the pool has already are not looked at; --compare says how well they were recovered, and
with --sizes how well they are in smaller pools, drawn at random from the pool's strategies:

python -m experiments.infer_strategies --demonstrations=half_cheetah_test --by_agent \\
    --compare --sizes=1,2,3,5,8
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from absl import flags

from experiments import launch
from represent_jax import config as configs
from represent_jax.data.catalogue import load_demonstrations
from represent_jax.data.npz import save_demonstrations
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import UsageError
from represent_jax.methods import demonstrators
from represent_jax.report.tables import Table, to_text
from represent_jax.report.values import format_number
from represent_jax.stages import strategies
from represent_jax.stages.strategies import StrategiesConfig

_DEMONSTRATIONS = flags.DEFINE_string(
    "demonstrations", None, "Name or npz file of the pool.", required=True
)
_OUT = flags.DEFINE_string("out", None, "File to write the labelled demonstrations to.")
_NUM_STRATEGIES = flags.DEFINE_integer(
    "num_strategies", 0, "How many strategies there are; 0 finds out.", lower_bound=0
)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace a file that --out names.")
_FIRST = flags.DEFINE_integer(
    "first", 0, "Of the pool, only the trajectories labelled as one of the first; 0 takes all."
)
_BY_AGENT = flags.DEFINE_bool(
    "by_agent", False, "Take every agent of a test set, a skill at a snapshot, for a strategy."
)
_COMPARE = flags.DEFINE_bool("compare", False, "Compare with the labels that the pool has.")
_SIZES = flags.DEFINE_list(
    "sizes", [], "With --compare: numbers of the pool's strategies in smaller pools."
)
_POOLS = flags.DEFINE_integer("pools", 20, "Smaller pools of each size.", lower_bound=1)
_SEED = flags.DEFINE_integer("seed", 0, "Seed.")
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Setting as dotted.key=value; repeatable.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    config = configs.apply_overrides(
        StrategiesConfig(num_strategies=_NUM_STRATEGIES.value), _OVERRIDE.value
    )
    if _OUT.value and not _OVERWRITE.value:
        launch.refuse_to_replace(_OUT.value)
    pool = load_demonstrations(_DEMONSTRATIONS.value)
    if _BY_AGENT.value:
        pool = demonstrators.by_agent(pool)
    if _FIRST.value:
        first = [t for t in pool.trajectories if t.strategy < _FIRST.value]
        pool = dataclasses.replace(pool, trajectories=tuple(first))
    if _SIZES.value:
        if not _COMPARE.value or _OUT.value:
            raise UsageError("sizes: expected --compare and no --out beside it")
        print(to_text(_smaller_pools(pool, config)))
        return
    found = strategies.infer(jax.random.PRNGKey(_SEED.value), pool.trajectories, config)
    print(to_text(_table(found)))
    criterion = "log evidence" if pool.has_actions else "agreement of the halves of episodes"
    values = ", ".join(
        f"{i + 1}: {value:.2f}" for i, value in enumerate(found.criterion) if not np.isnan(value)
    )
    print(f"{criterion}, by number of strategies: {values}")
    doubtful = [i for i in np.argsort(found.confidence) if found.confidence[i] < 0.9999][:10]
    if doubtful:
        least = ", ".join(f"{i} ({found.confidence[i]:.4f})" for i in doubtful)
        print(f"least certain trajectories (confidence): {least}")
    if _COMPARE.value:
        known = _known(pool.trajectories)
        print(
            f"known strategies {known.max() + 1}, found {found.num_strategies}; "
            f"purity {strategies.purity(found.labels, known):.3f}, "
            f"adjusted Rand index {strategies.adjusted_rand(found.labels, known):.3f}"
        )
    if _OUT.value:
        save_demonstrations(_OUT.value, strategies.label(pool, found))
        print(f"written to {_OUT.value}")


def _table(found: strategies.Strategies) -> Table:
    rows = []
    for strategy in range(found.num_strategies):
        own = np.flatnonzero(found.labels == strategy)
        confidence = found.confidence[own]
        cells = (f"{confidence.mean():.4f}", f"{confidence.min():.4f}")
        rows.append((f"Strategy {strategy + 1}", str(len(own)), *cells))
    return Table(
        title=f"{len(found.labels)} trajectories of {found.num_strategies} strategies",
        columns=("strategy", "trajectories", "confidence", "lowest"),
        rows=tuple(rows),
        note="",
    )


def _smaller_pools(pool: Demonstrations, config: StrategiesConfig) -> Table:
    rng = np.random.default_rng(_SEED.value)
    rows = []
    for size in _SIZES.value:
        if not size.isdigit() or not 1 <= int(size) <= pool.num_strategies:
            raise UsageError(f"sizes: expected 1 to {pool.num_strategies}, found {size!r}")
        judged = []
        for _ in range(_POOLS.value):
            chosen = list(rng.choice(pool.num_strategies, int(size), replace=False))
            own = [t for t in pool.trajectories if t.strategy in chosen]
            own = [dataclasses.replace(t, strategy=chosen.index(t.strategy)) for t in own]
            judged.append(_judge(own, config))
        number, purity, rand, given = np.array(judged).T
        share = np.mean(number == int(size))
        shown = f"{number.min():.0f} to {number.max():.0f}"
        means = (format_number(float(np.mean(x)), 3) for x in (purity, rand, given))
        rows.append((size, f"{number.mean():.1f}", shown, f"{100 * share:.0f} %", *means))
    return Table(
        title=f"{pool.env_name}: {_POOLS.value} pools of each size, labels hidden",
        columns=("strategies", "found", "range", "right", "purity", "Rand", "purity, number given"),
        rows=tuple(rows),
        note="",
    )


def _judge(
    trajectories: Sequence[Trajectory], config: StrategiesConfig
) -> tuple[float, float, float, float]:
    """Number found, purity, adjusted Rand index, and purity where the number is given."""
    key, known = jax.random.PRNGKey(_SEED.value), _known(trajectories)
    found = strategies.infer(key, trajectories, config)
    given = dataclasses.replace(config, num_strategies=int(known.max()) + 1)
    labels = strategies.infer(key, trajectories, given).labels
    return (
        found.num_strategies,
        strategies.purity(found.labels, known),
        strategies.adjusted_rand(found.labels, known),
        strategies.purity(labels, known),
    )


def _known(trajectories: Sequence[Trajectory]) -> np.ndarray:
    return np.array([t.strategy for t in trajectories])


if __name__ == "__main__":
    launch.run(main)
