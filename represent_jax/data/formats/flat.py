"""Steps laid end to end, a row a step, as D4RL has them; and episodes of T+1 observations.

A row holds the observation before the step, the action, the reward, whether the task terminated
there (`terminals`) and whether the episode was cut there (`timeouts`). What the last step of an
episode led to is known only where there are `next_observations`; without them that step is left
out, because rewards are learned from the states that steps lead to.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from represent_jax.data.formats.foreign import rounded
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError

# Names that arrays go by; the first are D4RL's, in which we write.
NAMES: dict[str, tuple[str, ...]] = {
    "observations": ("observations", "obs"),
    "actions": ("actions", "acts"),
    "rewards": ("rewards", "rews"),
    "next_observations": ("next_observations", "next_obs"),
    "terminals": ("terminals", "terminations"),
    "timeouts": ("timeouts", "truncations"),
    "strategy": ("strategy",),
    "episode_lengths": ("episode_lengths",),
    "terminated": ("terminated",),
}


def to_rows(demonstrations: Demonstrations) -> dict[str, np.ndarray]:
    """Lays demonstrations end to end, a row a step; loses nothing of the trajectories.

    Returns:
        `observations` and `next_observations` [N, obs_dim], `actions` [N, action_dim] and `rewards`
        [N] where known, `terminals` and `timeouts` [N] of which one ends every episode, and
        `strategy` [N].
    """
    trajectories = demonstrations.trajectories
    last = np.cumsum([t.length for t in trajectories]) - 1
    terminated = np.array([t.terminated for t in trajectories])
    ends = np.zeros((2, last[-1] + 1), bool)
    ends[0, last], ends[1, last] = terminated, ~terminated
    rows = {
        "observations": np.concatenate([t.obs[:-1] for t in trajectories]),
        "next_observations": np.concatenate([t.obs[1:] for t in trajectories]),
        "terminals": ends[0],
        "timeouts": ends[1],
        "strategy": np.repeat([t.strategy for t in trajectories], [t.length for t in trajectories]),
    }
    if demonstrations.has_actions:
        rows["actions"] = np.concatenate([t.actions for t in trajectories])
    if demonstrations.has_rewards:
        rows["rewards"] = np.concatenate([t.rewards for t in trajectories])
    return rows


def from_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[list[Trajectory], list[str]]:
    """Cuts arrays into trajectories.

    With `terminals`, `timeouts` or `next_observations` a row is a step. Otherwise every episode has
    one observation more than it has actions: `episode_lengths` [n] says how many steps each has,
    and `terminated` [n] which of them ended in a terminal state; without them all is one episode.

    Args:
        arrays: by any of `NAMES`; others are left out.

    Returns:
        The trajectories, and in words what of the arrays was not kept.

    Raises:
        RepresentError: arrays disagree, or do not say where episodes end.
    """
    if "dones" in arrays and not _find(arrays, "terminals"):
        raise RepresentError(
            "'dones' does not say whether the task terminated or a time limit was reached: "
            "give 'terminals' and 'timeouts'"
        )
    known = {name: key for name in NAMES if (key := _find(arrays, name))}
    if "observations" not in known:
        held = sorted(arrays)
        shown = ", ".join(held[:20]) + (", ..." if len(held) > 20 else "")
        raise RepresentError(
            f"no observations: expected {' or '.join(NAMES['observations'])}, found "
            f"{shown or 'nothing'}"
        )
    unused = sorted(set(arrays) - set(known.values()))
    notes = [f"left out: {', '.join(unused)}"] if unused else []
    found = {name: np.asarray(arrays[key]) for name, key in known.items()}
    for name in found.keys() & {"rewards", "terminals", "timeouts", "strategy"}:
        if found[name].shape[1:] == (1,):
            found[name] = found[name][:, 0]
    notes += rounded(**{n: found.get(n) for n in ("observations", "actions", "rewards")})
    by_row = "episode_lengths" not in found and bool(
        found.keys() & {"terminals", "timeouts", "next_observations"}
    )
    trajectories, more = _from_rows(found) if by_row else _from_episodes(found)
    return trajectories, notes + more


def drop_last_steps(
    pieces: Sequence[tuple[np.ndarray, np.ndarray | None, np.ndarray | None, bool, int]],
) -> tuple[list[Trajectory], list[str]]:
    """Makes trajectories of episodes whose final observation is not known, without their last step.

    Args:
        pieces: observations [L, obs_dim], actions [L, action_dim] and rewards [L] or None, whether
            the last step terminated, and the strategy.

    Raises:
        RepresentError: no episode has two observations.
    """
    kept = [
        Trajectory(obs, *(None if x is None else x[:-1] for x in (actions, rewards)), False, of)
        for obs, actions, rewards, _, of in pieces
        if len(obs) > 1
    ]
    if not kept:
        raise RepresentError("no episode has two observations: give next_observations")
    terminal = sum(bool(terminated) for *_, terminated, _ in pieces)
    notes = [f"last step of {len(pieces)} episodes left out: what it led to is not known"]
    if terminal:
        notes.append(f"{terminal} of these steps were terminal: their episodes count as cut")
    return kept, notes


def _find(arrays: Mapping[str, np.ndarray], name: str) -> str | None:
    return next((key for key in NAMES[name] if key in arrays), None)


def strategies_of(values: np.ndarray) -> np.ndarray:
    """Returns strategies as integers.

    Raises:
        RepresentError: some are no whole numbers from 0.
    """
    numbers = np.asarray(values)
    if numbers.dtype.kind not in "biuf":
        raise RepresentError(f"strategy: expected whole numbers from 0, found {numbers.dtype}")
    bad = ~np.isfinite(numbers) | (numbers < 0) | (numbers != np.floor(numbers))
    if bad.any():
        raise RepresentError(f"strategy: expected whole numbers from 0, found {numbers[bad][0]}")
    return numbers.astype(int)


def one_strategy(of_rows: np.ndarray) -> int:
    """Returns the strategy of an episode, which all of its rows have to have.

    Raises:
        RepresentError: they have several, or some are no whole numbers from 0.
    """
    found = np.unique(strategies_of(of_rows))
    if len(found) > 1:
        raise RepresentError(f"strategy: expected one of each episode, found {found.tolist()}")
    return int(found[0])


def _flags(found: Mapping[str, np.ndarray], name: str, num: int) -> np.ndarray:
    values = found.get(name, np.zeros(num, bool))
    if values.shape != (num,):
        raise RepresentError(f"{name} are {values.shape}, expected ({num},)")
    if values.dtype != bool and not np.isin(values, (0, 1)).all():
        raise RepresentError(f"{name}: expected booleans, or zeros and ones")
    return values.astype(bool)


def _from_rows(found: Mapping[str, np.ndarray]) -> tuple[list[Trajectory], list[str]]:
    obs, next_obs = found["observations"], found.get("next_observations")
    for name in found.keys() - {"terminated"}:
        if len(found[name]) != len(obs):
            raise RepresentError(f"{len(obs)} observations but {len(found[name])} {name}")
    if not len(obs):
        raise RepresentError("no steps")
    terminals, timeouts = (_flags(found, name, len(obs)) for name in ("terminals", "timeouts"))
    ends, notes = terminals | timeouts, []
    if next_obs is None:
        if "timeouts" not in found:
            if not terminals[-1]:
                raise RepresentError(
                    "neither 'timeouts' nor 'next_observations', and the last step is not "
                    "terminal: nothing says where episodes were cut at a time limit"
                )
            notes.append("no timeouts: every episode is taken to end where it terminated")
    else:
        if next_obs.shape != obs.shape:
            raise RepresentError(
                f"observations are {obs.shape}, next_observations {next_obs.shape}"
            )
        jumps = np.any(next_obs[:-1] != obs[1:], axis=tuple(range(1, obs.ndim))) & ~ends[:-1]
        ends[:-1] |= jumps
        if jumps.any():
            notes.append(
                f"{jumps.sum()} episodes end without a flag, where next_observations are not those "
                "of the next row; they count as cut"
            )
    cuts = np.flatnonzero(ends[:-1]) + 1

    def split(name):
        rows = found.get(name)
        return [None] * (len(cuts) + 1) if rows is None else np.split(rows, cuts)

    strategy = found.get("strategy", np.zeros(len(obs), int))
    pieces = zip(
        split("observations"),
        split("actions"),
        split("rewards"),
        [rows[-1] for rows in np.split(terminals, cuts)],
        [one_strategy(rows) for rows in np.split(strategy, cuts)],
        strict=True,
    )
    if next_obs is None:
        trajectories, more = drop_last_steps(list(pieces))
        return trajectories, notes + more
    finals = [rows[-1:] for rows in np.split(next_obs, cuts)]
    whole = [
        Trajectory(np.concatenate([piece[0], final]), *piece[1:])
        for piece, final in zip(pieces, finals, strict=True)
    ]
    return whole, notes


def _from_episodes(found: Mapping[str, np.ndarray]) -> tuple[list[Trajectory], list[str]]:
    obs = found["observations"]
    lengths = np.asarray(found.get("episode_lengths", [len(obs) - 1])).reshape(-1)
    if lengths.dtype.kind not in "iu" or (lengths < 1).any():
        raise RepresentError("episode_lengths: expected counts of steps, at least 1")
    num, steps = len(lengths), int(lengths.sum())
    rows = {"observations": steps + num, "actions": steps, "rewards": steps}
    for name, expected in rows.items():
        if name in found and len(found[name]) != expected:
            raise RepresentError(
                f"{name} has {len(found[name])} rows, expected {expected} of {num} episodes with a "
                "final observation each: give 'episode_lengths' and final observations, or a row a "
                "step with 'terminals' and 'timeouts'"
            )
    for name in ("terminated", "strategy"):
        if name in found and found[name].size != num:
            raise RepresentError(f"{name} has {found[name].size} values for {num} episodes")
    cuts = np.cumsum(lengths)[:-1]

    def split(name):
        return np.split(found[name], cuts) if name in found else [None] * num

    pieces = zip(
        np.split(obs, cuts + np.arange(1, num)),
        split("actions"),
        split("rewards"),
        _flags(found, "terminated", num),
        strategies_of(found.get("strategy", np.zeros(num, int)).reshape(-1)),
        strict=True,
    )
    return [Trajectory(*piece) for piece in pieces], []
