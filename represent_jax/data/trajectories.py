"""Trajectories, sets of demonstrations, and trajectories padded to one length.

The layout is that of the `imitation` library: T+1 observations and T actions, the last observation
being the true final one; the true reward and the demonstrator's strategy are kept beside them.
Actions and rewards may be missing: rewards are learned from states, and the true ones only judge.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from represent_jax.errors import RepresentError

# In float32 a clipped action may lie half a unit in the last place past a float64 bound.
_BOUND_TOLERANCE = 1e-6

# Stands between the sources of demonstrations that were put together, in `metadata["source"]`.
SOURCES = " + "


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of one strategy.

    Attributes:
        obs: observations, the final one included, float32 [T+1, obs_dim].
        actions: executed actions, float32 [T, action_dim]; None where they are not known.
        rewards: true rewards, float32 [T]; None where they are not known.
        terminated: whether the episode ended in a terminal state rather than at the time limit.
        strategy: number of the demonstrator, counted from 0.

    Raises:
        RepresentError: on construction, when ranks or lengths disagree, T is 0, or a value is not
            finite.
    """

    obs: np.ndarray
    actions: np.ndarray | None
    rewards: np.ndarray | None
    terminated: bool
    strategy: int

    def __post_init__(self):
        for name, rank in (("obs", 2), ("actions", 2), ("rewards", 1)):
            if name == "obs" or getattr(self, name) is not None:
                object.__setattr__(self, name, _finite_float32(name, getattr(self, name), rank))
        object.__setattr__(self, "terminated", bool(self.terminated))
        object.__setattr__(self, "strategy", int(self.strategy))
        if self.actions is not None and len(self.actions) and len(self.obs) != self.length + 1:
            raise RepresentError(
                f"trajectory of {self.length} actions has {len(self.obs)} observations, "
                f"it needs {self.length + 1}"
            )
        if self.length < 1:
            raise RepresentError("trajectory of zero length: it needs at least 1 step, has 0")
        if self.rewards is not None and len(self.rewards) != self.length:
            raise RepresentError(
                f"trajectory of {self.length} steps has {len(self.rewards)} rewards, "
                f"it needs {self.length}"
            )
        if self.strategy < 0:
            raise RepresentError(f"strategies count from 0, found {self.strategy}")

    @property
    def length(self) -> int:
        """Number of steps T."""
        return len(self.obs) - 1 if self.actions is None else len(self.actions)

    @property
    def total_reward(self) -> float:
        """Undiscounted true return.

        Raises:
            RepresentError: the rewards are missing.
        """
        if self.rewards is None:
            raise RepresentError("a trajectory without rewards has no true return")
        return float(self.rewards.sum(dtype=np.float64))


@dataclasses.dataclass(frozen=True, eq=False)
class Demonstrations:
    """Trajectories in one environment by M demonstrators, each with a strategy of its own.

    Attributes:
        env_name: name of the environment.
        trajectories: the demonstrations, in any order of strategies.
        metadata: where they come from; anything JSON can hold.

    Raises:
        RepresentError: on construction, when there are none, dimensions disagree, some of them lack
            actions or rewards and others do not, strategies are not exactly 0, ..., M-1, or JSON
            cannot hold the metadata.
    """

    env_name: str
    trajectories: tuple[Trajectory, ...]
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "trajectories", tuple(self.trajectories))
        if not self.trajectories:
            raise RepresentError(f"demonstrations of {self.env_name}: no trajectories")
        first = self.trajectories[0]
        for name in ("obs", "actions", "rewards"):
            for i, trajectory in enumerate(self.trajectories):
                found, expected = getattr(trajectory, name), getattr(first, name)
                if (found is None) != (expected is None):
                    lacks, has = (i, 0) if found is None else (0, i)
                    raise RepresentError(
                        f"demonstrations of {self.env_name}: trajectory {lacks} has no {name}, "
                        f"trajectory {has} has them; all need them, or none"
                    )
                if found is not None and found.shape[1:] != expected.shape[1:]:
                    raise RepresentError(
                        f"demonstrations of {self.env_name}: {name} of trajectory {i} have "
                        f"{found.shape[1]} dimensions, those of trajectory 0 have "
                        f"{expected.shape[1]}"
                    )
        strategies = sorted({trajectory.strategy for trajectory in self.trajectories})
        if strategies != list(range(len(strategies))):
            raise RepresentError(
                f"demonstrations of {self.env_name}: strategies are {strategies}, "
                f"expected {list(range(len(strategies)))}"
            )
        try:
            json.dumps(dict(self.metadata))
        except (TypeError, ValueError) as error:
            raise RepresentError(f"demonstrations of {self.env_name}: metadata: {error}") from error

    @property
    def obs_dim(self) -> int:
        """Size of an observation."""
        return self.trajectories[0].obs.shape[1]

    @property
    def action_dim(self) -> int | None:
        """Size of an action, None where actions are missing."""
        return self.trajectories[0].actions.shape[1] if self.has_actions else None

    @property
    def has_actions(self) -> bool:
        """Whether the actions are known."""
        return self.trajectories[0].actions is not None

    @property
    def has_rewards(self) -> bool:
        """Whether the true rewards are known."""
        return self.trajectories[0].rewards is not None

    @property
    def num_strategies(self) -> int:
        """Number of demonstrators M."""
        return 1 + max(trajectory.strategy for trajectory in self.trajectories)

    def of_strategy(self, strategy: int) -> tuple[Trajectory, ...]:
        """Returns the trajectories of one demonstrator, counted from 0."""
        return tuple(t for t in self.trajectories if t.strategy == strategy)

    def mean_return(self, strategy: int) -> float:
        """Returns the mean true return of one demonstrator, counted from 0.

        Raises:
            RepresentError: the rewards are missing.
        """
        return float(np.mean([t.total_reward for t in self.of_strategy(strategy)]))

    def check_against(
        self,
        obs_dim: int,
        action_dim: int,
        action_low: np.ndarray | float,
        action_high: np.ndarray | float,
    ) -> None:
        """Checks that the demonstrations can come from an environment.

        Args:
            obs_dim: size of the environment's observations.
            action_dim: size of its actions.
            action_low: smallest actions, a number or [action_dim].
            action_high: largest actions, a number or [action_dim].

        Raises:
            RepresentError: dimensions differ, or an action is out of bounds.
        """
        where = f"demonstrations of {self.env_name}"
        for name, found, expected in (
            ("observations", self.obs_dim, obs_dim),
            ("actions", self.action_dim, action_dim),
        ):
            if found is not None and found != expected:
                raise RepresentError(
                    f"{where}: {name} have {found} dimensions, the environment's have {expected}"
                )
        if not self.has_actions:
            return
        low, high = (np.broadcast_to(b, action_dim) for b in (action_low, action_high))
        for i, trajectory in enumerate(self.trajectories):
            below = trajectory.actions < low - _BOUND_TOLERANCE
            above = trajectory.actions > high + _BOUND_TOLERANCE
            if (below | above).any():
                step, axis = np.argwhere(below | above)[0]
                raise RepresentError(
                    f"{where}: action {axis} at step {step} of trajectory {i} is "
                    f"{trajectory.actions[step, axis]:g}, out of bounds "
                    f"[{low[axis]:g}, {high[axis]:g}]"
                )


class TrajectoryBatch(NamedTuple):
    """N trajectories padded to one horizon T; numpy or JAX arrays.

    Attributes:
        obs: observations [N, T+1, obs_dim]; past the end the final observation is repeated.
        actions: executed actions [N, T, action_dim], zero past the end; None where missing.
        rewards: true rewards [N, T], zero past the end; None where missing.
        mask: 1 while the episode runs, 0 past the end, float32 [N, T].
        strategy: number of the demonstrator, int32 [N].
        noise_level: probability with which an action was replaced by a random one, float32 [N].
    """

    obs: np.ndarray
    actions: np.ndarray | None
    rewards: np.ndarray | None
    mask: np.ndarray
    strategy: np.ndarray
    noise_level: np.ndarray


def pad(
    trajectories: Sequence[Trajectory], horizon: int, noise_level: np.ndarray | float = 0.0
) -> TrajectoryBatch:
    """Stacks trajectories of any lengths up to the horizon.

    Args:
        trajectories: N trajectories of equal dimensions, N >= 1; all or none have actions, and
            rewards.
        horizon: length T of the batch, in steps.
        noise_level: noise level of the trajectories, a number or [N].

    Raises:
        RepresentError: there are no trajectories, or one is longer than the horizon.
    """
    if not trajectories:
        raise RepresentError("no trajectories to pad")
    longest = max(trajectory.length for trajectory in trajectories)
    if longest > horizon:
        raise RepresentError(f"a trajectory of {longest} steps exceeds the horizon of {horizon}")
    num = len(trajectories)
    missing = [horizon - trajectory.length for trajectory in trajectories]
    pairs = list(zip(trajectories, missing, strict=True))
    return TrajectoryBatch(
        obs=np.stack([np.pad(t.obs, ((0, m), (0, 0)), mode="edge") for t, m in pairs]),
        actions=_stack_padded([t.actions for t in trajectories], missing),
        rewards=_stack_padded([t.rewards for t in trajectories], missing),
        mask=np.stack([(np.arange(horizon) < t.length).astype(np.float32) for t, _ in pairs]),
        strategy=np.array([t.strategy for t in trajectories], np.int32),
        noise_level=np.broadcast_to(np.asarray(noise_level, np.float32), num).copy(),
    )


def _stack_padded(rows: list[np.ndarray | None], missing: list[int]) -> np.ndarray | None:
    if rows[0] is None:
        return None
    padded = zip(rows, missing, strict=True)
    return np.stack([np.pad(x, ((0, m),) + ((0, 0),) * (x.ndim - 1)) for x, m in padded])


def without_pauses(trajectory: Trajectory, least_change: float) -> Trajectory:
    """Leaves out the steps in which nothing moves: of those a policy without memory learns to rest.

    Args:
        trajectory: one episode.
        least_change: change of the entry of the observation that changes most, below which a step
            is a pause; with 0 nothing is left out.

    Raises:
        RepresentError: all of it is a pause.
    """
    moves = np.abs(np.diff(trajectory.obs, axis=0)).max(axis=1) >= least_change
    if moves.all():
        return trajectory
    if not moves.any():
        raise RepresentError(
            f"a trajectory of strategy {trajectory.strategy} never moves: no observation changes "
            f"by {least_change:g} in a step"
        )
    last = 1 + np.flatnonzero(moves)[-1]
    return Trajectory(
        obs=np.concatenate([trajectory.obs[:-1][moves], trajectory.obs[last : last + 1]]),
        actions=None if trajectory.actions is None else trajectory.actions[moves],
        rewards=None if trajectory.rewards is None else trajectory.rewards[moves],
        terminated=trajectory.terminated and bool(moves[-1]),
        strategy=trajectory.strategy,
    )


def unpad(batch: TrajectoryBatch) -> tuple[Trajectory, ...]:
    """Returns the trajectories of a batch; those that stop before the horizon as terminated."""
    obs, actions, rewards, mask, strategy, _ = (
        None if leaf is None else np.asarray(leaf) for leaf in batch
    )
    lengths = mask.sum(axis=1).astype(int)
    return tuple(
        Trajectory(
            obs=obs[i, : length + 1],
            actions=None if actions is None else actions[i, :length],
            rewards=None if rewards is None else rewards[i, :length],
            terminated=length < mask.shape[1],
            strategy=strategy[i],
        )
        for i, length in enumerate(lengths)
    )


def returns(batch: TrajectoryBatch) -> np.ndarray:
    """Returns the undiscounted true return of every trajectory [N]; works under jit.

    Raises:
        RepresentError: the rewards are missing.
    """
    if batch.rewards is None:
        raise RepresentError("trajectories without rewards have no true returns")
    return (batch.rewards * batch.mask).sum(axis=-1)


def _finite_float32(name: str, values: Any, rank: int) -> np.ndarray:
    with np.errstate(over="ignore"):
        array = np.asarray(values, np.float32)
    if array.ndim != rank:
        raise RepresentError(f"{name} of a trajectory have {array.ndim} axes, they need {rank}")
    bad = ~np.isfinite(array)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise RepresentError(
            f"{name} of a trajectory: {bad.sum()} of {array.size} values are not finite, "
            f"the first ({array[first]}) at step {first[0]}"
        )
    return array
