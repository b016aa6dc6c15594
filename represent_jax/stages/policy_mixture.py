"""A mixture of policies over whole trajectories: good divisions, and the evidence of each.

All demonstrators act in one environment, whose dynamics cancel when two explanations of a
trajectory are compared; what is left is p(actions | states). The policy of a group of trajectories
is linear, its weights integrated out under a matrix-normal prior that is centred at the policy of
all; the covariance of the noise is one for all groups, integrated out under an inverse Wishart
prior. The evidence of a division then has a closed form in sums of second moments.

In float64 with NumPy: evidences are differences of large sums.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from represent_jax.data.trajectories import Trajectory

_RIDGE = 1e-3  # added to the correlations of states, whose parts may determine one another
_NOISE_FLOOR = 1e-6  # of the actions' variance: deterministic policies leave none
_CHOW_STEPS = 1e-4
_MAX_SWEEPS = 50


class Moments(NamedTuple):
    """Weighted second moments of features and residual actions; they add up over trajectories.

    Attributes:
      features: of features with features, `[..., num_features, num_features]`.
      cross: of features with actions, `[..., num_features, action_dim]`.
      actions: of actions with actions, `[..., action_dim, action_dim]`.
      squared: of features with features by squared weights, `[..., num_features, num_features]`.
      weight: sum of the steps' weights, `[...]`.
    """

    features: np.ndarray
    cross: np.ndarray
    actions: np.ndarray
    squared: np.ndarray
    weight: np.ndarray

    def at(self, index: int | Sequence[int] | np.ndarray) -> "Moments":
        """Returns the moments at an index of the first axis."""
        return Moments(*(x[index] for x in self))

    def plus(self, other: "Moments") -> "Moments":
        """Returns the moments of both together."""
        return Moments(*(x + y for x, y in zip(self, other, strict=True)))

    def summed(self, axis: int) -> "Moments":
        """Returns the moments of all along one of the leading axes."""
        return Moments(*(x.sum(axis=axis) for x in self))

    def grouped(self, labels: np.ndarray, num_groups: int) -> "Moments":
        """Returns the moments of each group, `[num_groups, ...]`."""
        members = np.eye(num_groups)[labels].T
        return Moments(*(np.tensordot(members, x, axes=1) for x in self))


class Pooled(NamedTuple):
    """The policy of all trajectories together.

    Attributes:
      step: moments of the features of a typical step, `[num_features, num_features]`.
      noise: covariance of the actions around it, `[action_dim, action_dim]`.
    """

    step: np.ndarray
    noise: np.ndarray


class Model(NamedTuple):
    """What the evidence of a division depends on, besides the moments of its groups.

    Attributes:
      precision: of the prior of a group's weights, in units of the noise,
        `[num_features, num_features]`.
      noise: scale of the inverse Wishart prior, `[action_dim, action_dim]`.
      degrees: degrees of freedom of the noise's posterior.
      concentration: of the Dirichlet prior of the groups' shares.
    """

    precision: np.ndarray
    noise: np.ndarray
    degrees: float
    concentration: float

    def fit(self, moments: Moments) -> tuple[np.ndarray, np.ndarray]:
        """Fits policies to groups, whatever their leading axes.

        Returns:
          The squares that each policy leaves, `[..., action_dim, action_dim]`, and how many nats
          its freedom costs (Occam's factor), `[...]`.
        """
        precision = moments.features + self.precision
        left = moments.actions - np.swapaxes(moments.cross, -1, -2) @ np.linalg.solve(
            precision, moments.cross
        )
        freedom = np.linalg.slogdet(precision)[1] - np.linalg.slogdet(self.precision)[1]
        return left, 0.5 * len(self.noise) * freedom

    def log_evidence(self, left: np.ndarray, occam: np.ndarray | float) -> np.ndarray:
        """Log evidence of all actions but for a constant, from the sums over groups of a `fit`."""
        return -0.5 * self.degrees * np.linalg.slogdet(self.noise + left)[1] - occam

    def log_prior(self, sizes: np.ndarray) -> float:
        """Log probability of labels by the sizes of the groups, `[num_groups]`."""
        a, num_groups = self.concentration, len(sizes)
        drawn = gammaln(num_groups * a) - gammaln(sizes.sum() + num_groups * a)
        return float(drawn + np.sum(gammaln(sizes + a) - gammaln(a)))


def moments_of(trajectories: Sequence[Trajectory]) -> tuple[Moments, Pooled]:
    """Moments of the halves of every trajectory, `[num_trajectories, 2, ...]`.

    Features are 1 and the observation, actions are taken around the policy of all trajectories;
    observations and actions in units of their spread.
    """
    obs = _standardised(np.concatenate([t.obs[:-1] for t in trajectories]))
    actions = _standardised(np.concatenate([t.actions for t in trajectories]))
    weight = _mallows_weights(obs)
    features = np.concatenate([np.ones((len(obs), 1)), obs], axis=1)
    every = _products(features, actions, weight)
    step = every.features / every.weight + 1e-6 * np.eye(features.shape[1])
    actions = actions - features @ np.linalg.solve(every.features + step, every.cross)
    noise = (actions * weight[:, None]).T @ actions / weight.sum()
    noise += _NOISE_FLOOR * np.eye(actions.shape[1])
    halves, start = [], 0
    for length in (t.length for t in trajectories):
        middle, end = start + (length + 1) // 2, start + length
        for part in (slice(start, middle), slice(middle, end)):
            halves.append(_products(features[part], actions[part], weight[part]))
        start = end
    leaves = (np.stack(leaf) for leaf in zip(*halves, strict=True))
    shape = (len(trajectories), 2)
    return Moments(*(x.reshape(*shape, *x.shape[1:]) for x in leaves)), Pooled(step, noise)


def _standardised(rows: np.ndarray) -> np.ndarray:
    """Without the columns that never vary, the others around 0 and of spread 1; float64."""
    rows = rows.astype(np.float64)
    spread = rows.std(axis=0)
    varies = spread > 1e-6 * np.maximum(1.0, np.abs(rows).max(axis=0))
    return (rows - rows.mean(axis=0))[:, varies] / spread[varies]


def _mallows_weights(obs: np.ndarray) -> np.ndarray:
    """Weights by which no state tells more about a linear policy than a typical one, `[rows]`.

    A policy is linear near the usual states at best; without weights it is the few states of a
    fall, far from all others, that decide.
    """
    if obs.shape[1] == 0:
        return np.ones(len(obs))
    covariance = obs.T @ obs / len(obs) + _RIDGE * np.eye(obs.shape[1])
    distance = np.sum(obs * np.linalg.solve(covariance, obs.T).T, axis=1) / obs.shape[1]
    return 1.0 / np.maximum(1.0, distance)


def _products(features: np.ndarray, actions: np.ndarray, weight: np.ndarray) -> Moments:
    weighted = features * weight[:, None]
    return Moments(
        features=weighted.T @ features,
        cross=weighted.T @ actions,
        actions=(actions * weight[:, None]).T @ actions,
        squared=weighted.T @ weighted,
        weight=np.asarray(weight.sum()),
    )


def overdispersion(halves: Moments, pooled: Pooled) -> float:
    """By how many times the halves of a trajectory differ more than noise explains.

    It is Chow's F statistic of a policy for each half against one for both, over all trajectories;
    about 1 where the model is right.

    Args:
      halves: `[num_trajectories, 2, ...]`.
      pooled: the policy of all.
    """
    # Weak, so that what two policies give up to their priors is no difference between them.
    precision = _CHOW_STEPS * pooled.step
    model = Model(precision, pooled.noise, degrees=0.0, concentration=1.0)

    def fit(moments: Moments) -> tuple[float, float]:
        left = np.linalg.solve(pooled.noise, model.fit(moments)[0])
        used = np.linalg.solve(moments.features + precision, moments.squared)
        return tuple(float(np.trace(x, axis1=-2, axis2=-1).sum()) for x in (left, used))

    (left_by_one, used_by_one), (left_by_two, used_by_two) = fit(halves.summed(1)), fit(halves)
    free = float(halves.weight.sum()) - used_by_two
    if used_by_two <= used_by_one or free <= 0.0 or left_by_two <= 0.0:
        return 1.0
    return (left_by_one - left_by_two) / (used_by_two - used_by_one) / (left_by_two / free)


def merge(moments: Moments, model: Model, numbers: Sequence[int]) -> list[np.ndarray]:
    """Merges, from single trajectories on, the two groups that lose least evidence.

    Args:
      moments: `[num_trajectories, ...]`.
      model: the model.
      numbers: numbers of groups to report.

    Returns:
      The labels, `[num_trajectories]`, at each of the numbers.
    """
    num, action_dim = len(moments.weight), len(model.noise)
    labels, alive = np.arange(num), list(range(num))
    groups = Moments(*(x.copy() for x in moments))
    left, occam = model.fit(groups)
    more_left, more_occam = np.zeros((num, num, action_dim, action_dim)), np.zeros((num, num))

    def compare(i: int, others: list[int]) -> None:
        """Stores what merging group i with others adds to what is left, and to Occam's factors."""
        if others:
            joint_left, joint_occam = model.fit(groups.at(others).plus(groups.at(i)))
            more_left[i, others] = more_left[others, i] = joint_left - left[others] - left[i]
            more_occam[i, others] = more_occam[others, i] = joint_occam - occam[others] - occam[i]

    for i in range(num):
        compare(i, list(range(i)))
    found = []
    while True:
        if len(alive) in numbers:
            found.append(np.searchsorted(alive, labels))
        if len(alive) <= min(numbers):
            return found
        losing, keeping = (np.array(alive)[k] for k in np.tril_indices(len(alive), -1))
        evidence = model.log_evidence(
            left[alive].sum(axis=0) + more_left[losing, keeping], more_occam[losing, keeping]
        )
        lost, kept = (int(k[np.argmax(evidence)]) for k in (losing, keeping))
        alive.remove(lost)
        labels[labels == lost] = kept
        for group, member in zip(groups, moments.at(labels == kept), strict=True):
            group[kept] = member.sum(axis=0)
        left[kept], occam[kept] = model.fit(groups.at(kept))
        compare(kept, [k for k in alive if k != kept])


def settle(labels: np.ndarray, moments: Moments, model: Model) -> np.ndarray:
    """Moves trajectories to their best group, one by one until none moves; empties no group."""
    labels = labels.copy()
    for _ in range(_MAX_SWEEPS):
        moved = False
        for i, label in enumerate(labels):
            if np.sum(labels == label) > 1:
                scores = label_scores(i, labels, moments, model)
                if scores.max() > scores[label] + 1e-9:
                    labels[i], moved = np.argmax(scores), True
        if not moved:
            break
    return labels


def label_scores(i: int, labels: np.ndarray, moments: Moments, model: Model) -> np.ndarray:
    """Log probability of each label of trajectory i given all others, but for a constant."""
    num_groups = labels.max() + 1
    others = np.arange(len(labels)) != i
    groups = moments.at(others).grouped(labels[others], num_groups)
    left, occam = model.fit(groups)
    left_with, occam_with = model.fit(groups.plus(moments.at(i)))
    evidence = model.log_evidence(
        left.sum(axis=0) - left + left_with, occam.sum() - occam + occam_with
    )
    sizes = np.bincount(labels[others], minlength=num_groups)
    return evidence + np.log(sizes + model.concentration)


def log_joint(labels: np.ndarray, moments: Moments, model: Model) -> float:
    """Log probability of actions and labels, but for a constant that no division changes."""
    num_groups = labels.max() + 1
    left, occam = model.fit(moments.grouped(labels, num_groups))
    sizes = np.bincount(labels, minlength=num_groups)
    evidence = model.log_evidence(left.sum(axis=0), occam.sum())
    return float(evidence) + model.log_prior(sizes)
