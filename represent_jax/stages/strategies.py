"""Strategies of demonstrations that nobody labelled: how many there are, and whose is whose.

A demonstrator's strategy shows in how the robot moves: in the distribution of one-step changes of
the observation. Every trajectory is described by the mean of random Fourier features of these
changes (Rahimi and Recht, NeurIPS 2007), so that the distance between two descriptions is the
maximum mean discrepancy between the two motions (Gretton et al., JMLR 2012), and Ward's clustering
of the descriptions gives the strategies.

Their number is the largest with which the two halves of the same trajectories, clustered each by
itself, agree: the prediction strength of Tibshirani and Walther (2005), for which no labels are
needed, since the halves of an episode have one demonstrator. Halves are drawn anew in blocks of
steps, so that a few trajectories cannot agree by chance. A strategy is believed only if at least
two trajectories show it.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.optimize import linear_sum_assignment

from represent_jax.config import require
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError

# Changes beyond this many standard deviations, as of a fall, count as this many.
_MAX_DEVIATIONS = 5.0


@dataclasses.dataclass(frozen=True)
class StrategiesConfig:
    """Settings of the inference; one choice for all domains.

    Attributes:
      num_strategies: how many there are; 0 if that is to be found out.
      max_strategies: the most to be looked for.
      min_strength: prediction strength from which a number of strategies is believed. At 0.5 most
        pairs of every strategy are together in both halves; where nothing is drawn anew,
        Tibshirani and Walther advise 0.8 to 0.9.
      num_features: random Fourier features.
      bandwidth: width of their kernel in units of the median distance between changes.
      block_steps: steps that are drawn together when trajectories are resampled.
      num_resamples: resamples behind the strengths, and behind the confidences.
    """

    num_strategies: int = 0
    max_strategies: int = 12
    min_strength: float = 0.5
    num_features: int = 512
    bandwidth: float = 0.25
    block_steps: int = 10
    num_resamples: int = 100

    def __post_init__(self) -> None:
        require(self.num_strategies >= 0, "num_strategies", "at least 0", self.num_strategies)
        require(0.0 < self.min_strength <= 1.0, "min_strength", "in (0, 1]", self.min_strength)
        require(self.bandwidth > 0.0, "bandwidth", "positive", self.bandwidth)
        for field in ("max_strategies", "num_features", "block_steps", "num_resamples"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))


class Strategies(NamedTuple):
    """Who demonstrates what.

    Attributes:
      labels: strategy of every trajectory, numbered by first appearance, `[num_trajectories]` int.
      probabilities: share of resamples in which a trajectory falls to each strategy,
        `[num_trajectories, num_strategies]`.
      strengths: prediction strength of 1, 2, ... strategies, mean over resamples,
        `[most looked for]`.
    """

    labels: np.ndarray
    probabilities: np.ndarray
    strengths: np.ndarray

    @property
    def num_strategies(self) -> int:
        """How many there are."""
        return self.probabilities.shape[1]

    @property
    def confidence(self) -> np.ndarray:
        """Probability of the strategy that each trajectory was given, `[num_trajectories]`."""
        return self.probabilities[np.arange(len(self.labels)), self.labels]


def infer(
    key: jax.Array, trajectories: Sequence[Trajectory], config: StrategiesConfig
) -> Strategies:
    """Infers the strategies of trajectories; the strategies they name are not looked at.

    Args:
      key: PRNG key.
      trajectories: the pool, in any order, lengths may differ; rewards and actions are not used.
      config: settings.

    Raises:
      RepresentError: there are no trajectories, one is shorter than two steps, or more strategies
        are asked for than there are trajectories.
    """
    if not len(trajectories):
        raise RepresentError("trajectories: expected at least 1, found none")
    if config.num_strategies > len(trajectories):
        raise RepresentError(
            f"num_strategies: expected at most {len(trajectories)}, the number of trajectories, "
            f"found {config.num_strategies}"
        )
    key_features, key_halves, key_wholes = jax.random.split(key, 3)
    features = _features(key_features, _changes(trajectories), config)
    most = max(1, min(config.max_strategies, len(trajectories) // 2))
    strengths = _strengths(_rng(key_halves), features, most, config)
    found = 1 + int(np.flatnonzero(strengths >= config.min_strength)[-1])
    number = config.num_strategies or found
    tree = _tree(np.stack([rows.mean(axis=0) for rows in features]))
    labels = _by_appearance(_cut(tree, number))
    probabilities = _probabilities(_rng(key_wholes), features, labels, number, config)
    return Strategies(labels, probabilities, strengths)


def label(demonstrations: Demonstrations, strategies: Strategies) -> Demonstrations:
    """Gives every demonstration its inferred strategy; metadata holds the confidences."""
    trajectories = [
        dataclasses.replace(t, strategy=int(strategy))
        for t, strategy in zip(demonstrations.trajectories, strategies.labels, strict=True)
    ]
    inferred = {
        "confidence": strategies.confidence.round(4).tolist(),
        "strengths": strategies.strengths.round(4).tolist(),
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


def _changes(trajectories: Sequence[Trajectory]) -> list[np.ndarray]:
    """One-step changes of every trajectory in units of their spread, `[num_steps, obs_dim]`."""
    changes = [np.diff(t.obs.astype(np.float64), axis=0) for t in trajectories]
    for i, rows in enumerate(changes):
        if len(rows) < 2:
            raise RepresentError(f"trajectory {i}: expected at least 2 steps, found {len(rows)}")
    pooled = np.concatenate(changes)
    mean, spread = pooled.mean(axis=0), pooled.std(axis=0)
    # What never changes tells nothing; what hardly changes must not be blown up.
    scale = np.where(spread > 1e-8, spread, np.inf)
    return [np.clip((x - mean) / scale, -_MAX_DEVIATIONS, _MAX_DEVIATIONS) for x in changes]


def _features(
    key: jax.Array, changes: list[np.ndarray], config: StrategiesConfig
) -> list[np.ndarray]:
    """Random Fourier features of every step, `[num_steps, 2 * num_features]`."""
    key_pairs, key_frequencies = jax.random.split(key)
    pooled = np.concatenate(changes)
    first, second = np.asarray(jax.random.randint(key_pairs, (2, 2000), 0, len(pooled)))
    distance = np.median(np.linalg.norm(pooled[first] - pooled[second], axis=1))
    width = config.bandwidth * max(float(distance), 1e-8)
    shape = (pooled.shape[1], config.num_features)
    frequencies = np.asarray(jax.random.normal(key_frequencies, shape), np.float64) / width
    phases = [x @ frequencies for x in changes]
    scale = np.sqrt(config.num_features)
    return [np.concatenate([np.cos(p), np.sin(p)], axis=1) / scale for p in phases]


def _rng(key: jax.Array) -> np.random.Generator:
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))


def _tree(descriptions: np.ndarray) -> np.ndarray | None:
    """Ward's tree of `[num_trajectories, dim]`; None for a single one."""
    return linkage(descriptions, "ward") if len(descriptions) > 1 else None


def _cut(tree: np.ndarray | None, number: int) -> np.ndarray:
    """The partition of a tree into a number of clusters, `[num_trajectories]`."""
    return np.zeros(1, int) if tree is None else fcluster(tree, number, "maxclust") - 1


def _blocks(rows: np.ndarray, config: StrategiesConfig) -> np.ndarray:
    """Mean features of consecutive blocks of steps, `[num_blocks, dim]`."""
    parts = np.array_split(rows, -(-len(rows) // config.block_steps))
    return np.stack([part.mean(axis=0) for part in parts])


def _drawn(rng: np.random.Generator, blocks: Sequence[np.ndarray]) -> np.ndarray:
    """A description of every trajectory from blocks drawn with replacement."""
    return np.stack([b[rng.integers(len(b), size=len(b))].mean(axis=0) for b in blocks])


def _strengths(
    rng: np.random.Generator, features: list[np.ndarray], most: int, config: StrategiesConfig
) -> np.ndarray:
    """How well the clusters of each half foretell those of the other, by their number, `[most]`.

    What counts is the cluster that is foretold worst: of its pairs, the share that is together in
    the other half too. A cluster of one has no pair, and foretells nothing.
    """
    middles = [len(rows) // 2 for rows in features]
    halves = [
        [_blocks(rows[:middle], config) for rows, middle in zip(features, middles, strict=True)],
        [_blocks(rows[middle:], config) for rows, middle in zip(features, middles, strict=True)],
    ]
    strengths = np.ones(most)
    if most > 1:
        strengths[1:] = 0.0
        for _ in range(config.num_resamples):
            trees = [_tree(_drawn(rng, blocks)) for blocks in halves]
            for number in range(2, most + 1):
                one, other = (_cut(tree, number) for tree in trees)
                strengths[number - 1] += min(_foretold(one, other), _foretold(other, one))
        strengths[1:] /= config.num_resamples
    return strengths


def _foretold(labels: np.ndarray, by: np.ndarray) -> float:
    shares = []
    for cluster in range(labels.max() + 1):
        members = by[labels == cluster]
        num_pairs = len(members) * (len(members) - 1)
        together = (members[:, None] == members[None, :]).sum() - len(members)
        shares.append(together / num_pairs if num_pairs else 0.0)
    return float(min(shares))


def _by_appearance(labels: np.ndarray) -> np.ndarray:
    """Numbers clusters in the order in which the trajectories first show them."""
    order = {cluster: i for i, cluster in enumerate(dict.fromkeys(labels.tolist()))}
    return np.array([order[cluster] for cluster in labels.tolist()])


def _probabilities(
    rng: np.random.Generator,
    features: list[np.ndarray],
    labels: np.ndarray,
    number: int,
    config: StrategiesConfig,
) -> np.ndarray:
    """Clusters resampled trajectories, and counts which falls where."""
    blocks = [_blocks(rows, config) for rows in features]
    votes = np.zeros((len(labels), number))
    for _ in range(config.num_resamples):
        again = _cut(_tree(_drawn(rng, blocks)), number)
        here, there = linear_sum_assignment(-_contingency(again, labels, number))
        names = np.zeros(number, int)
        names[here] = there
        votes[np.arange(len(labels)), names[again]] += 1.0
    return votes / config.num_resamples


def _contingency(labels: np.ndarray, known: np.ndarray, number: int = 0) -> np.ndarray:
    """How many trajectories have each label (row) and each known strategy (column)."""
    table = np.zeros((number or labels.max() + 1, number or known.max() + 1))
    np.add.at(table, (labels, known), 1.0)
    return table
