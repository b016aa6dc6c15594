"""Clusters of trajectories by how the robot moves, for demonstrations that lack actions.

Every trajectory is described by the mean of random Fourier features (Rahimi and Recht, NeurIPS
2007) of the one-step changes of its observation, so that the distance between two descriptions is
the maximum mean discrepancy between the two motions (Gretton et al., JMLR 2012), and Ward's
clustering of the descriptions gives the strategies.

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
from represent_jax.data.trajectories import Trajectory
from represent_jax.errors import RepresentError

# Changes beyond this many standard deviations, as of a fall, count as this many.
_MAX_DEVIATIONS = 5.0


@dataclasses.dataclass(frozen=True)
class MotionConfig:
    """Settings of the clustering; one choice for all domains.

    Attributes:
      min_strength: prediction strength from which a number of strategies is believed. At 0.5 most
        pairs of every strategy are together in both halves; where nothing is drawn anew,
        Tibshirani and Walther advise 0.8 to 0.9.
      num_features: random Fourier features.
      bandwidth: width of their kernel in units of the median distance between changes.
      block_steps: steps that are drawn together when trajectories are resampled.
      num_resamples: resamples behind the strengths, and behind the probabilities.
    """

    min_strength: float = 0.5
    num_features: int = 512
    bandwidth: float = 0.25
    block_steps: int = 10
    num_resamples: int = 100

    def __post_init__(self) -> None:
        require(0.0 < self.min_strength <= 1.0, "min_strength", "in (0, 1]", self.min_strength)
        require(self.bandwidth > 0.0, "bandwidth", "positive", self.bandwidth)
        for field in ("num_features", "block_steps", "num_resamples"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))


class MotionClusters(NamedTuple):
    """Which trajectory is in which cluster.

    Attributes:
      labels: cluster of every trajectory, `[num_trajectories]` int.
      probabilities: share of resamples in which a trajectory falls to each cluster,
        `[num_trajectories, num_clusters]`.
      strengths: prediction strength of 1, 2, ... clusters, mean over resamples,
        `[most looked for]`.
    """

    labels: np.ndarray
    probabilities: np.ndarray
    strengths: np.ndarray


def cluster(
    key: jax.Array,
    trajectories: Sequence[Trajectory],
    config: MotionConfig,
    num_clusters: int = 0,
    max_clusters: int = 12,
) -> MotionClusters:
    """Clusters trajectories by the distribution of their changes of the observation.

    Args:
      key: PRNG key of the features and of the resamples.
      trajectories: in any order, lengths may differ; rewards and actions are not used.
      config: settings.
      num_clusters: how many there are; 0 if that is to be found out.
      max_clusters: the most to be looked for.

    Raises:
      RepresentError: a trajectory is shorter than two steps, or trajectories are too much alike for
        as many clusters.
    """
    key_features, key_halves, key_wholes = jax.random.split(key, 3)
    features = _features(key_features, _changes(trajectories), config)
    most = max(1, min(max_clusters, len(trajectories) // 2))
    strengths = _strengths(_rng(key_halves), features, most, config)
    number = num_clusters or 1 + int(np.flatnonzero(strengths >= config.min_strength)[-1])
    labels = _cut(_tree(np.stack([rows.mean(axis=0) for rows in features])), number)
    found = len(np.unique(labels))
    if found < number:
        raise RepresentError(
            f"num_clusters: expected at most {found}, as many as are told apart, found {number}"
        )
    probabilities = _probabilities(_rng(key_wholes), features, labels, number, config)
    return MotionClusters(labels, probabilities, strengths)


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


def _features(key: jax.Array, changes: list[np.ndarray], config: MotionConfig) -> list[np.ndarray]:
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


def _blocks(rows: np.ndarray, config: MotionConfig) -> np.ndarray:
    """Mean features of consecutive blocks of steps, `[num_blocks, dim]`."""
    parts = np.array_split(rows, -(-len(rows) // config.block_steps))
    return np.stack([part.mean(axis=0) for part in parts])


def _drawn(rng: np.random.Generator, blocks: Sequence[np.ndarray]) -> np.ndarray:
    """A description of every trajectory from blocks drawn with replacement."""
    return np.stack([b[rng.integers(len(b), size=len(b))].mean(axis=0) for b in blocks])


def _strengths(
    rng: np.random.Generator, features: list[np.ndarray], most: int, config: MotionConfig
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


def _probabilities(
    rng: np.random.Generator,
    features: list[np.ndarray],
    labels: np.ndarray,
    number: int,
    config: MotionConfig,
) -> np.ndarray:
    """Clusters resampled trajectories, and counts which falls where."""
    blocks = [_blocks(rows, config) for rows in features]
    votes = np.zeros((len(labels), number))
    for _ in range(config.num_resamples):
        again = _cut(_tree(_drawn(rng, blocks)), number)
        here, there = linear_sum_assignment(-_votes(again, labels, number))
        names = np.zeros(number, int)
        names[here] = there
        votes[np.arange(len(labels)), names[again]] += 1.0
    return votes / config.num_resamples


def _votes(again: np.ndarray, labels: np.ndarray, number: int) -> np.ndarray:
    """How many trajectories are in each new cluster (row) and in each old one (column)."""
    table = np.zeros((number, number))
    np.add.at(table, (again, labels), 1.0)
    return table
