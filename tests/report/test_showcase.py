"""Videos on a run's page, or the line that says why there are none."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from test_html import read

import represent_jax as rj
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.envs import make_env
from represent_jax.errors import RepresentError
from represent_jax.report import html, showcase, video
from represent_jax.report.html import write_report
from represent_jax.runs import RunDirectory

HORIZON = 4


@pytest.fixture(scope="module")
def env():
    return make_env("inverted_double_pendulum", "mujoco")


@pytest.fixture
def demonstrations(env):
    """Two demonstrators, the second of whom nobody rewarded."""

    def trajectory(strategy):
        obs = np.zeros((HORIZON + 1, env.observation_size))
        obs[:, 3:5] = 1.0  # Cosines: both poles upright.
        return Trajectory(obs, np.zeros((HORIZON, 1)), np.full(HORIZON, 2.5), False, strategy)

    return Demonstrations("inverted_double_pendulum", (trajectory(0), trajectory(1)))


def make(run_path, env, demonstrations):
    return showcase.make(
        RunDirectory(run_path),
        env,
        HORIZON,
        demonstrations,
        ("strategy_1", "strategy_2"),
        lambda: dict.fromkeys(("task", "strategy_2"), lambda obs: jnp.zeros(1)),
    )


def test_demonstrators_stand_beside_the_policy(run_path, env, demonstrations):
    pytest.importorskip("imageio_ffmpeg")
    try:
        video.check_available()
    except RepresentError as error:
        pytest.skip(str(error))
    import imageio_ffmpeg

    shown = make(run_path, env, demonstrations)
    assert [one.target for one in shown.videos] == ["task", "strategy_2"]
    assert [len(one.panels) for one in shown.videos] == [3, 2]
    assert shown.videos[0].panels[0] == ("Demonstrator of Strategy 1", 10.0)
    for one in shown.videos:
        frames, _ = imageio_ffmpeg.count_frames_and_secs(str(run_path / one.file))
        assert frames == HORIZON + 1
    text, addresses = read(write_report(run_path))
    assert {"videos/task.mp4", "videos/strategy_2.mp4"} <= set(addresses)
    assert "Demonstrator of Strategy 2" in text and "Learned policy" in text


def test_the_page_says_why_there_are_no_videos(run_path, env, demonstrations, monkeypatch):
    def broken():
        raise RepresentError("no OpenGL library <here>")

    monkeypatch.setattr(video, "check_available", broken)
    assert "Side by side" not in read(write_report(run_path))[0]
    assert make(run_path, env, demonstrations).videos == ()
    text, addresses = read(write_report(run_path))
    assert "No videos: no OpenGL library <here>." in text
    assert not any("videos/" in address for address in addresses)


def test_a_task_that_tells_no_positions_is_named(env, demonstrations, monkeypatch):
    monkeypatch.setattr(type(env.task), "qpos_of", lambda self, model, obs, dt: None)
    found, notices = showcase._demonstrated(env, demonstrations, ("strategy_1", "strategy_2"))
    assert not found and "Task.qpos_of" in notices[0]


def test_a_motion_ends_where_the_episode_does(env):
    import jax

    qpos, rewards = showcase.motion(env, lambda obs: jnp.ones(1), jax.random.PRNGKey(0), 300)
    assert len(rewards) < 300 and qpos.shape == (len(rewards) + 1, 3)
    assert np.isfinite(qpos).all()


def arm(num_steps):
    """Positions [num_steps + 1, 1] of what moves slowly."""
    return np.linspace(0.0, 1.0, num_steps + 1)[:, None]


def gait(num_steps):
    """Positions [num_steps + 1, 1] of what goes to and fro in five frames."""
    return np.sin(2.0 * np.pi / 5.0 * np.arange(num_steps + 1))[:, None]


@pytest.mark.parametrize(
    ("motions", "speed"),
    [
        ([arm(100)], 1),
        ([arm(60), arm(101)], 2),
        ([arm(400), gait(400)], 4),
        ([gait(400), arm(400)], 1),
        ([np.zeros((401, 1))], 4),
    ],
)
def test_what_lasts_is_sped_up_unless_that_would_hide_how_it_moves(motions, speed):
    assert showcase._speed(motions, 100) == speed


@pytest.mark.parametrize(
    ("make_motion", "num_steps", "num_frames", "speed"),
    [(arm, 120, 121, 1), (arm, 200, 201, 1), (arm, 800, 201, 4), (gait, 800, 201, 1)],
)
def test_a_video_is_of_ten_seconds(env, monkeypatch, make_motion, num_steps, num_frames, speed):
    sent = {}
    monkeypatch.setattr(
        video,
        "render_beside",
        lambda model, motions, path, **how: sent.update(how, motions=motions),
    )
    qpos = make_motion(num_steps)
    assert showcase._render(env, [qpos, qpos[:3]], Path("v.mp4")) == speed
    assert [len(one) for one in sent["motions"]] == [num_frames, -(-3 // speed)]
    assert sent["fps"] == pytest.approx(20.0)  # Every step of 0.05 s is a frame.
    if make_motion is arm:
        np.testing.assert_array_equal(sent["motions"][0][[0, -1]], qpos[[0, -1]])


def test_the_page_says_how_fast_a_video_is(run_path):
    def text_of(**more):
        panels = [{"name": "Learned policy", "true_return": 1.0}]
        one = {"target": "task", "file": "videos/task.mp4", "panels": panels} | more
        notes = json.dumps({"videos": [one], "notices": []})
        (run_path / "videos" / "videos.json").write_text(notes)
        return html._videos(showcase.read(RunDirectory(run_path)))

    (run_path / "videos").mkdir()
    assert "4 times as fast" in text_of(speed=4)
    # As files of before have it, too.
    assert "as fast" not in text_of(speed=1) and "as fast" not in text_of()


def test_the_kitchens_demonstrations_are_shown_whole(monkeypatch):
    pytest.importorskip("gymnasium_robotics", reason="needs the extra 'kitchen'")
    env = make_env("franka_kitchen", "mujoco")
    given = rj.load_demonstrations("franka_kitchen")
    names = ("strategy_1", "strategy_2")
    shown = {}
    monkeypatch.setattr(
        video, "render_beside", lambda model, motions, path, **how: shown.update({path: motions})
    )
    demonstrated, _ = showcase._demonstrated(env, given, names)
    for name in names:
        qpos = demonstrated[name][1]
        assert showcase._render(env, [qpos, qpos], Path(name)) == 4
        # Where the kettle is moved from and to.
        np.testing.assert_array_equal(shown[Path(name)][0][[0, -1]], qpos[[0, -1]])


def test_notes_that_are_broken_are_named(run_path):
    (run_path / "videos").mkdir()
    (run_path / "videos" / "videos.json").write_text(json.dumps({"videos": [{}]}))
    with pytest.raises(RepresentError, match=r"videos\.json"):
        write_report(run_path)
