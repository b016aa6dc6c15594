"""Datasets of Minari (https://minari.farama.org), the Farama Foundation's offline datasets.

A dataset is named as Minari names it, such as `mujoco/halfcheetah/simple-v0`, in the folder that
`MINARI_DATASETS_PATH` says; or it is the path of a dataset's own folder. Episodes have T+1
observations there, as here.
"""

import os
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from represent_jax.data.formats.foreign import OWN_KEY, assemble, describe, library, rounded
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.errors import RepresentError, UsageError

_STRATEGY = f"{OWN_KEY}_strategy"


def read(dataset: str | os.PathLike, env_name: str = "") -> Demonstrations:
    """Reads one dataset; nothing is downloaded.

    `infos` are not kept. Rewards that are NaN throughout are missing ones.

    Args:
        dataset: name of a local dataset, or the folder of one.
        env_name: name of the environment; that in our own exports if empty.

    Raises:
        UsageError: Minari is not installed, or nobody names the environment.
        RepresentError: no such dataset, observations or actions are no vectors of numbers, or
            what it holds are no demonstrations.
    """
    minari = library("minari", "minari")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            held = _open(minari, dataset)
            for name in ("observation", "action"):
                _require_vectors(f"{dataset}: {name}s", getattr(held, f"{name}_space"))
            episodes = list(held)
            metadata = list(held.storage.get_episode_metadata(held.episode_indices))
    except FileNotFoundError as error:
        raise RepresentError(
            f"{dataset}: no such dataset here; `minari download {dataset}` fetches a public one"
        ) from error
    except (ValueError, AssertionError, TypeError, KeyError, OSError, ImportError) as error:
        raise RepresentError(f"{dataset}: not a dataset that can be read: {error}") from error
    trajectories, notes = [], []
    for i, (episode, extra) in enumerate(zip(episodes, metadata, strict=True)):
        try:
            trajectories.append(_trajectory(episode, int(extra.get(_STRATEGY, 0))))
        except RepresentError as error:
            raise RepresentError(f"{dataset}: episode {i}: {error}") from error
        notes += [f"left out: infos ({', '.join(sorted(episode.infos))})"] if episode.infos else []
        notes += rounded(observations=episode.observations, actions=episode.actions)
    env_spec = held.env_spec.id if held.env_spec is not None else None
    return assemble(
        str(dataset),
        trajectories,
        env_name,
        held.storage.metadata.get(OWN_KEY),
        list(dict.fromkeys(notes)),
        format="minari",
        env_spec=env_spec,
    )


def write(dataset: str | os.PathLike, demonstrations: Demonstrations) -> None:
    """Writes one dataset into the folder that `MINARI_DATASETS_PATH` says.

    Missing rewards are written as NaN. Strategies are in the metadata of the episodes, the
    environment's name and our metadata in those of the dataset.

    Raises:
        UsageError: Minari is not installed, the name is none for a dataset or taken, or actions are
            missing, for which the format has no form.
        RepresentError: the dataset cannot be written.
    """
    minari = library("minari", "minari")
    library("h5py", "minari")
    if not demonstrations.has_actions:
        raise UsageError(f"{dataset}: a Minari dataset needs actions, these have none")
    episodes = [_episode(minari, t) for t in demonstrations.trajectories]
    try:
        with warnings.catch_warnings():
            # Of authors, links and scores that are not given.
            warnings.simplefilter("ignore")
            made = minari.create_dataset_from_buffers(
                str(dataset),
                episodes,
                observation_space=gym.spaces.Box(
                    -np.inf, np.inf, (demonstrations.obs_dim,), np.float32
                ),
                action_space=gym.spaces.Box(-1.0, 1.0, (demonstrations.action_dim,), np.float32),
                description=f"Demonstrations of {demonstrations.env_name}",
            )
    except (ValueError, TypeError, AttributeError) as error:
        raise UsageError(f"{dataset}: {error}") from error
    except OSError as error:
        raise RepresentError(f"{dataset}: cannot be written ({error})") from error
    made.storage.update_episode_metadata(
        [{_STRATEGY: t.strategy} for t in demonstrations.trajectories]
    )
    made.storage.update_metadata({OWN_KEY: describe(demonstrations)})


def _open(minari: Any, dataset: str | os.PathLike) -> Any:
    folder = Path(dataset)
    if not folder.is_dir():
        return minari.load_dataset(str(dataset))
    return minari.MinariDataset(folder / "data" if (folder / "data").is_dir() else folder)


def _require_vectors(what: str, space: gym.Space) -> None:
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        keys = f" of {', '.join(space.spaces)}" if isinstance(space, gym.spaces.Dict) else ""
        raise RepresentError(
            f"{what} are a {type(space).__name__}{keys} of shape {space.shape}, "
            "expected a Box of one axis; save what of it rewards are to see as arrays, which "
            "--from=arrays reads"
        )


def _trajectory(episode: Any, strategy: int) -> Trajectory:
    terminations, truncations = np.asarray(episode.terminations), np.asarray(episode.truncations)
    early = (terminations | truncations)[:-1]
    if early.any():
        raise RepresentError(f"it goes on after it ended at step {int(np.argmax(early))}")
    rewards = np.asarray(episode.rewards)
    return Trajectory(
        obs=episode.observations,
        actions=episode.actions,
        rewards=None if rewards.size and np.isnan(rewards).all() else rewards,
        terminated=bool(terminations[-1]) if terminations.size else False,
        strategy=strategy,
    )


def _episode(minari: Any, t: Trajectory) -> Any:
    last = np.arange(t.length) == t.length - 1
    return minari.data_collector.EpisodeBuffer(
        observations=t.obs,
        actions=t.actions,
        rewards=np.full(t.length, np.nan, np.float32) if t.rewards is None else t.rewards,
        terminations=last & t.terminated,
        truncations=last & (not t.terminated),
    )
