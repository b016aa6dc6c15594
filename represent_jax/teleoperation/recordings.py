"""The file that recorded episodes go to: ordinary demonstrations that only ever grow.

Beside its trajectories the file keeps the seed of each one's initial state, in
`metadata["teleoperation"]["reset_seeds"]`. Physics on the host is deterministic: the seed and the
recorded actions give the motion back, so positions need no place of their own.
"""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from brax.envs import base

from represent_jax.data.atomic import disk_errors
from represent_jax.data.npz import load_demonstrations, save_demonstrations
from represent_jax.data.trajectories import SOURCES, Demonstrations, Trajectory
from represent_jax.errors import RepresentError, UsageError

_METADATA_KEY = "teleoperation"


def read(path: str | os.PathLike, env: base.Env) -> Demonstrations | None:
    """Returns what the file holds, None where there is no file yet.

    Raises:
        RepresentError: it is no whole file of demonstrations.
        UsageError: it is of another environment, or lacks the actions or rewards that episodes
            driven here have.
    """
    if not Path(path).exists():
        return None
    found = load_demonstrations(path)
    if found.env_name != env.name:
        raise UsageError(f"{path}: demonstrations of {found.env_name}, expected {env.name}")
    if not (found.has_actions and found.has_rewards):
        raise UsageError(f"{path}: it lacks actions or rewards; record to another file")
    try:
        found.check_against(env.observation_size, env.action_size, -1.0, 1.0)
    except RepresentError as error:
        raise UsageError(f"{path}: {error}") from error
    return found


def append(
    path: str | os.PathLike, env: base.Env, trajectory: Trajectory, reset_seed: int
) -> Demonstrations:
    """Adds an episode to the file, which holds it whole when this returns.

    What others have written to the file in the meantime stays in it.

    Args:
        path: the file; made where there is none.
        env: the environment.
        trajectory: the episode.
        reset_seed: seed of its initial state.

    Returns:
        All that the file holds.

    Raises:
        UsageError: the episode's strategy leaves one out, or the file is of another environment.
        RepresentError: the file is broken or cannot be written; it is left as it was.
    """
    with _alone(Path(path)):
        before = read(path, env)
        known = before.num_strategies if before else 0
        if trajectory.strategy > known:
            raise UsageError(
                f"strategy: expected 1 to {known + 1}, found {trajectory.strategy + 1}; strategies "
                f"are numbered without a gap, and {path} has {known}"
            )
        metadata = dict(before.metadata) if before else {}
        if _METADATA_KEY not in metadata:
            sources = [metadata["source"]] if "source" in metadata else []
            metadata["source"] = SOURCES.join([*sources, _METADATA_KEY])
        seeds = [*(reset_seeds(before) if before else ()), reset_seed]
        metadata[_METADATA_KEY] = {"reset_seeds": seeds}
        trajectories = (*(before.trajectories if before else ()), trajectory)
        after = Demonstrations(env.name, trajectories, metadata)
        save_demonstrations(path, after)
    return after


def reset_seeds(demonstrations: Demonstrations) -> tuple[int | None, ...]:
    """Returns the seed of each trajectory's initial state, None where it was not driven here."""
    num = len(demonstrations.trajectories)
    seeds = demonstrations.metadata.get(_METADATA_KEY, {}).get("reset_seeds", ())
    # Another program may have added to the file or taken from it: then they are nobody's.
    return tuple(seeds) if len(seeds) == num else (None,) * num


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keeps a second server from adding to the same file between reading and writing."""
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)
