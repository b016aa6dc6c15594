"""Strategies of demonstrations that nobody labelled: how many there are, and whose is whose.

A strategy is a way to choose actions, so that trajectories are a mixture of policies
(`stages.policy_mixture`), and the number of strategies is that of the highest evidence. Two things
keep evidence that comes from simple policies honest:

- The two halves of a trajectory are of one strategy by definition. By as many times as they differ
  more than noise explains, the evidence is tempered; it needs no labels to know.
- How far strategies lie from each other is averaged over.

Demonstrations that lack actions are told apart by how the robot moves (`stages.motion_clusters`).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from scipy.special import logsumexp

from represent_jax.config import require
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError
from represent_jax.stages import motion_clusters, policy_mixture
from represent_jax.stages.motion_clusters import MotionConfig
from represent_jax.stages.policy_mixture import Model, Moments


@dataclasses.dataclass(frozen=True)
class StrategiesConfig:
    """Settings of the inference; one choice for all domains.

    Attributes:
      num_strategies: how many there are; 0 if that is to be found out.
      max_strategies: the most to be looked for.
      prior_steps: how many typical steps the prior of a strategy's policy is worth, which is
        centred at the policy of all demonstrations. Few let strategies lie far apart, many hold
        them together; the evidence is averaged over these.
      concentration: of the Dirichlet prior of the strategies' shares of the trajectories.
      motion: settings where actions are missing.
    """

    num_strategies: int = 0
    max_strategies: int = 12
    prior_steps: tuple[float, ...] = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
    concentration: float = 1.0
    motion: MotionConfig = MotionConfig()

    def __post_init__(self) -> None:
        require(self.num_strategies >= 0, "num_strategies", "at least 0", self.num_strategies)
        require(self.max_strategies >= 1, "max_strategies", "at least 1", self.max_strategies)
        require(
            bool(self.prior_steps) and all(steps > 0.0 for steps in self.prior_steps),
            "prior_steps",
            "one or more positive numbers",
            self.prior_steps,
        )
        require(self.concentration > 0.0, "concentration", "positive", self.concentration)


class Strategies(NamedTuple):
    """Who demonstrates what.

    Attributes:
      labels: strategy of every trajectory, numbered by first appearance, `[num_trajectories]` int.
      probabilities: probability of each strategy given the labels of all other trajectories, or,
        where actions are missing, share of resamples, `[num_trajectories, num_strategies]`.
      criterion: how well 1, 2, ... strategies do, nan where a number was not looked at,
        `[most looked at]`: their tempered log evidence, less the highest; where actions are
        missing, the agreement of the halves of trajectories.
      overdispersion: by how many times the halves of a trajectory differ more than noise explains;
        evidence and probabilities are tempered by it where it is above 1. 1 where actions are
        missing.
    """

    labels: np.ndarray
    probabilities: np.ndarray
    criterion: np.ndarray
    overdispersion: float

    @property
    def num_strategies(self) -> int:
        """How many there are."""
        return self.probabilities.shape[1]

    @property
    def confidence(self) -> np.ndarray:
        """Probability of the strategy that each trajectory was given, `[num_trajectories]`."""
        return self.probabilities[np.arange(len(self.labels)), self.labels]


class _Division(NamedTuple):
    log_joint: float
    labels: np.ndarray
    model: Model


def infer(
    key: jax.Array, trajectories: Sequence[Trajectory], config: StrategiesConfig
) -> Strategies:
    """Infers the strategies of trajectories; the strategies they name are not looked at.

    Args:
      key: PRNG key; without effect where actions are known, since nothing is drawn then.
      trajectories: the pool, in any order, lengths may differ; all have actions, or none has.
        Rewards are not used.
      config: settings.

    Raises:
      RepresentError: there are no trajectories, more strategies are asked for than there are
        trajectories, or one without actions is shorter than two steps.
    """
    num = len(trajectories)
    if not num:
        raise RepresentError("trajectories: expected at least 1, found none")
    if config.num_strategies > num:
        raise RepresentError(
            f"num_strategies: expected at most {num}, the number of trajectories, "
            f"found {config.num_strategies}"
        )
    if trajectories[0].actions is None:
        found = motion_clusters.cluster(
            key, trajectories, config.motion, config.num_strategies, config.max_strategies
        )
        labels, order = _by_appearance(found.labels)
        return Strategies(labels, found.probabilities[:, order], found.strengths, 1.0)
    return _by_policy(trajectories, config)


def _by_policy(trajectories: Sequence[Trajectory], config: StrategiesConfig) -> Strategies:
    num = len(trajectories)
    numbers = [config.num_strategies]
    if not config.num_strategies:
        numbers = list(range(1, min(config.max_strategies, num) + 1))
    halves, pooled = policy_mixture.moments_of(trajectories)
    overdispersion = policy_mixture.overdispersion(halves, pooled)
    moments = Moments(*(x / max(1.0, overdispersion) for x in halves.summed(1)))
    degrees = float(moments.weight.sum()) + len(pooled.noise) + 2
    divisions: dict[int, list[_Division]] = {number: [] for number in numbers}
    for steps in config.prior_steps:
        model = Model(steps * pooled.step, pooled.noise, degrees, config.concentration)
        for start in policy_mixture.merge(moments, model, numbers):
            labels = policy_mixture.settle(start, moments, model)
            log_joint = policy_mixture.log_joint(labels, moments, model)
            divisions[labels.max() + 1].append(_Division(log_joint, labels, model))
    log_evidence = np.full(max(numbers), np.nan)
    for number, own in divisions.items():
        log_evidence[number - 1] = logsumexp([one.log_joint for one in own]) - np.log(len(own))
    log_evidence -= np.nanmax(log_evidence)
    best = max(divisions[1 + int(np.nanargmax(log_evidence))], key=lambda one: one.log_joint)
    labels, _ = _by_appearance(best.labels)
    scores = np.stack(
        [policy_mixture.label_scores(i, labels, moments, best.model) for i in range(num)]
    )
    probabilities = np.exp(scores - logsumexp(scores, axis=1, keepdims=True))
    return Strategies(labels, probabilities, log_evidence, overdispersion)


def label(demonstrations: Demonstrations, strategies: Strategies) -> Demonstrations:
    """Gives every demonstration its inferred strategy; metadata holds the confidences."""
    trajectories = [
        dataclasses.replace(t, strategy=int(strategy))
        for t, strategy in zip(demonstrations.trajectories, strategies.labels, strict=True)
    ]
    inferred = {
        "confidence": strategies.confidence.round(4).tolist(),
        "criterion": [
            None if np.isnan(value) else round(float(value), 4) for value in strategies.criterion
        ],
        "overdispersion": round(strategies.overdispersion, 4),
    }
    return dataclasses.replace(
        demonstrations,
        trajectories=tuple(trajectories),
        metadata={**demonstrations.metadata, "inferred_strategies": inferred},
    )


def purity(labels: np.ndarray, known: np.ndarray) -> float:
    """Share of trajectories whose known strategy is the most frequent one of their label."""
    table = _contingency(np.asarray(labels), np.asarray(known))
    return float(table.max(axis=1).sum() / table.sum())


def adjusted_rand(labels: np.ndarray, known: np.ndarray) -> float:
    """Agreement of two partitions, 1 if equal, 0 on average by chance (Hubert and Arabie, 1985)."""
    table = _contingency(np.asarray(labels), np.asarray(known))

    def pairs(counts):
        return float((counts * (counts - 1) / 2).sum())

    together, rows, columns = pairs(table), pairs(table.sum(axis=1)), pairs(table.sum(axis=0))
    total = pairs(table.sum())
    expected = rows * columns / total if total else 0.0
    most = 0.5 * (rows + columns)
    return 1.0 if most == expected else (together - expected) / (most - expected)


def _by_appearance(labels: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Numbers groups in the order in which trajectories first show them; which was which before."""
    order = list(dict.fromkeys(labels.tolist()))
    return np.array([order.index(group) for group in labels.tolist()]), order


def _contingency(labels: np.ndarray, known: np.ndarray) -> np.ndarray:
    """How many trajectories have each label (row) and each known strategy (column)."""
    table = np.zeros((labels.max() + 1, known.max() + 1))
    np.add.at(table, (labels, known), 1.0)
    return table
