"""Videos for a run's page: demonstrators to the left, the learned policy to the right.

videos/<target>.mp4   one clock for all panels
videos/videos.json    what they show, or why there are none
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from brax.envs import base

from represent_jax.data.atomic import replacing
from represent_jax.data.trajectories import Demonstrations
from represent_jax.envs import Environment, Episode
from represent_jax.errors import RepresentError
from represent_jax.physics import offscreen
from represent_jax.report import video
from represent_jax.report.values import display_name
from represent_jax.runs.directory import RunDirectory, plain

_SECONDS = 10.0
_FPS = 30.0
_PANEL_SIZE = (320, 240)
# The share of the way moved that frames have to show. Of a gait, five times as fast, a third is
# left, and it jumps about; of an arm that is driven by keys, four fifths or more.
_LEAST_SHOWN = 0.6

Policy = Callable[[jax.Array], jax.Array]


class Panel(NamedTuple):
    """What a part of a video shows.

    Attributes:
        name: who moves.
        true_return: of the whole episode, even where the video shows its beginning alone.
    """

    name: str
    true_return: float | None


class Video(NamedTuple):
    """One video.

    Attributes:
        target: "task", "strategy_1", ...
        file: path relative to the run's folder.
        panels: from left to right.
        speed: how many times as fast as it was everything moves.
    """

    target: str
    file: str
    panels: tuple[Panel, ...]
    speed: int = 1


class Showcase(NamedTuple):
    """What a run has to show.

    Attributes:
        videos: one a target.
        notices: what is missing and why, a sentence each.
    """

    videos: tuple[Video, ...]
    notices: tuple[str, ...]


def motion(
    env: base.Env, policy: Policy, key: jax.Array, num_steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Plays a policy once.

    Args:
        env: an environment; its state says in `done` when an episode ends.
        policy: from observations `[obs_dim]` to actions `[action_dim]`.
        key: PRNG key of the initial state.
        num_steps: the longest that is played.

    Returns:
        Positions `[T + 1, nq]` and true rewards `[T]`, T <= num_steps.
    """

    @jax.jit
    def play(key):
        def body(state, _):
            state = env.step(state, policy(state.obs))
            return state, (state.pipeline_state.qpos, state.reward, state.done)

        start = env.reset(key)
        return start.pipeline_state.qpos, *jax.lax.scan(body, start, None, length=num_steps)[1]

    start, qpos, rewards, done = jax.device_get(play(key))
    length = int(np.argmax(done)) + 1 if done.any() else num_steps
    return np.concatenate([start[None], qpos[:length]]), rewards[:length]


def make(
    run: RunDirectory,
    env: base.Env,
    horizon: int,
    demonstrations: Demonstrations,
    group_names: Sequence[str],
    load_policies: Callable[[], Mapping[str, Policy]],
    seed: int = 0,
) -> Showcase:
    """Makes the videos of a run, and notes beside them what they show or why there are none.

    Args:
        run: the run's folder.
        env: its environment.
        horizon: environment steps of an episode.
        demonstrations: of all its groups; the first of each is shown.
        group_names: what the groups are called, in order.
        load_policies: returns the policies, by target; called where videos can be made at all.
        seed: of the policies' initial state.
    """
    demonstrated, notices, videos = {}, [], []
    try:
        if not isinstance(env, Environment):
            raise RepresentError(
                f"only tasks on this package's engines can be shown, not {env.name}"
            )
        video.check_available()
        demonstrated, notices = _demonstrated(env, demonstrations, group_names)
        for target, policy in load_policies().items():
            qpos, rewards = motion(
                Episode(env, horizon, auto_reset=False), policy, jax.random.PRNGKey(seed), horizon
            )
            own = [target] if target in group_names else group_names
            moving = [demonstrated[name] for name in own if name in demonstrated]
            moving.append((Panel("Learned policy", float(rewards.sum())), qpos))
            file = f"videos/{target}.mp4"
            speed = _render(env, [positions for _, positions in moving], run.path / file)
            videos.append(Video(target, file, tuple(panel for panel, _ in moving), speed))
    except RepresentError as error:
        notices.append(f"No videos: {error}.")
    shown = Showcase(tuple(videos), tuple(notices))
    with replacing(run.videos / "videos.json") as temporary:
        found = [one._asdict() | {"panels": [p._asdict() for p in one.panels]} for one in videos]
        temporary.write_text(json.dumps(plain({"videos": found, "notices": notices}), indent=2))
    return shown


def read(run: RunDirectory) -> Showcase | None:
    """Returns what `make` left in a run's folder, None where it was not asked for.

    Raises:
        RepresentError: its notes cannot be read.
    """
    path = run.videos / "videos.json"
    if not path.is_file():
        return None
    try:
        stored = json.loads(path.read_text())
        videos = tuple(
            Video(**one | {"panels": tuple(Panel(**panel) for panel in one["panels"])})
            for one in stored["videos"]
        )
        return Showcase(videos, tuple(stored["notices"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RepresentError(f"{path}: cannot be read ({error})") from error


def _demonstrated(
    env: Environment, demonstrations: Demonstrations, group_names: Sequence[str]
) -> tuple[dict[str, tuple[Panel, np.ndarray]], list[str]]:
    """The first demonstration of each group, with positions `[T + 1, nq]`, and what is missing."""
    found = {}
    for i, name in enumerate(group_names):
        trajectory = demonstrations.of_strategy(i)[0]
        qpos = env.task.qpos_of(env.engine.model, trajectory.obs, env.engine.dt)
        if qpos is None:
            reason = "which positions its observations stand for (Task.qpos_of)"
            return {}, [f"Policies alone are shown: {env.name} does not say {reason}."]
        title = "Demonstrator" if name == "merged" else f"Demonstrator of {display_name(name)}"
        true_return = None if trajectory.rewards is None else trajectory.total_reward
        found[name] = (Panel(title, true_return), qpos)
    return found, []


def _render(env: Environment, motions: Sequence[np.ndarray], path: Path) -> int:
    """Renders motions [T + 1, nq] in `_SECONDS`, and returns how many times as fast they are."""
    stride = max(1, round(1.0 / (env.engine.dt * _FPS)))
    fps = 1.0 / (env.engine.dt * stride)
    num_frames = round(_SECONDS * fps)
    frames = [qpos[::stride] for qpos in motions]
    speed = _speed(frames, num_frames)
    model = env.engine.model
    video.render_beside(
        model,
        [qpos[::speed][: num_frames + 1] for qpos in frames],
        path,
        fps=fps,
        camera=offscreen.default_camera(model),
        size=_PANEL_SIZE,
    )
    return speed


def _speed(frames: Sequence[np.ndarray], num_frames: int) -> int:
    """How many times as fast the longest motion has to be to end after some frames.

    It is 1, and the end is not shown, where the frames left out would hide how the first motion
    goes. That one is a demonstrator's, if any is shown: samples of a policy may jitter.

    Args:
        frames: positions [n, nq] of each motion.
        num_frames: the most steps from frame to frame that are shown.
    """
    speed = max(1, math.ceil((max(map(len, frames)) - 1) / num_frames))
    way, shown = (np.abs(np.diff(frames[0][::n], axis=0)).sum() for n in (1, speed))
    return speed if shown >= _LEAST_SHOWN * way else 1
