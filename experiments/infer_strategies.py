"""Finds out how many strategies a pool of demonstrations shows, and which trajectory shows which.

python -m experiments.infer_strategies --demonstrations=pool.npz --out=labelled.npz
python -m experiments.represent --env=half_cheetah --demonstrations=labelled.npz

Labels that the pool has already are not looked at; --compare says how well they were recovered.
"""

import dataclasses

import jax
import numpy as np
from absl import flags

from experiments import launch
from represent_jax import config as configs
from represent_jax.data.catalogue import load_demonstrations
from represent_jax.data.npz import save_demonstrations
from represent_jax.report.tables import Table, to_text
from represent_jax.stages import strategies
from represent_jax.stages.strategies import StrategiesConfig

_DEMONSTRATIONS = flags.DEFINE_string(
    "demonstrations", None, "Name or npz file of the pool.", required=True
)
_OUT = flags.DEFINE_string("out", None, "File to write the labelled demonstrations to.")
_NUM_STRATEGIES = flags.DEFINE_integer(
    "num_strategies", 0, "How many strategies there are; 0 finds out.", lower_bound=0
)
_FIRST = flags.DEFINE_integer(
    "first", 0, "Of the pool, only the trajectories labelled as one of the first; 0 takes all."
)
_COMPARE = flags.DEFINE_bool("compare", False, "Compare with the labels that the pool has.")
_SEED = flags.DEFINE_integer("seed", 0, "Seed.")
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Setting as dotted.key=value; repeatable.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    config = configs.apply_overrides(
        StrategiesConfig(num_strategies=_NUM_STRATEGIES.value), _OVERRIDE.value
    )
    pool = load_demonstrations(_DEMONSTRATIONS.value)
    if _FIRST.value:
        first = [t for t in pool.trajectories if t.strategy < _FIRST.value]
        pool = dataclasses.replace(pool, trajectories=tuple(first))
    found = strategies.infer(jax.random.PRNGKey(_SEED.value), pool.trajectories, config)
    print(to_text(_table(found)))
    doubtful = [i for i in np.argsort(found.confidence) if found.confidence[i] < 0.9][:10]
    if doubtful:
        least = ", ".join(f"{i} ({found.confidence[i]:.2f})" for i in doubtful)
        print(f"least certain trajectories (confidence): {least}")
    if _COMPARE.value:
        known = np.array([t.strategy for t in pool.trajectories])
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
        rows.append(
            (
                f"Strategy {strategy + 1}",
                str(len(own)),
                f"{confidence.mean():.2f}",
                f"{confidence.min():.2f}",
            )
        )
    strengths = ", ".join(f"{i + 1}: {value:.2f}" for i, value in enumerate(found.strengths))
    return Table(
        title=f"{len(found.labels)} trajectories of {found.num_strategies} strategies",
        columns=("strategy", "trajectories", "confidence", "lowest"),
        rows=tuple(rows),
        note=f"Agreement between halves of the episodes, by number of strategies: {strengths}.",
    )


if __name__ == "__main__":
    launch.run(main)
