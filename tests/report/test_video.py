"""Off-screen videos, where there is a GL library, and the messages where there is none."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from represent_jax.errors import RepresentError, UsageError
from represent_jax.physics import offscreen
from represent_jax.report import video

MODEL = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="side" pos="0 -3 1" xyaxes="1 0 0 0 0 1"/>
    <body pos="0 0 1"><joint type="slide" axis="1 0 0"/><geom size=".3" rgba="1 0 0 1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture
def gl():
    """Skips where nothing can draw."""
    pytest.importorskip("imageio_ffmpeg")
    try:
        offscreen.check_available()
    except RepresentError as error:
        pytest.skip(str(error))


def test_a_video_has_one_frame_a_position(model, gl, tmp_path):
    import imageio_ffmpeg

    qpos = np.linspace(-1.0, 1.0, 12)[:, None]
    path = video.render(model, qpos, tmp_path / "new" / "ball.mp4", fps=24, camera="side")
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == 12
    assert seconds == pytest.approx(0.5, abs=0.05)
    assert [file.name for file in path.parent.iterdir()] == ["ball.mp4"]


def test_motions_stand_side_by_side_and_the_shorter_one_waits(model, gl, tmp_path):
    import imageio_ffmpeg

    motions = [np.zeros((3, 1)), np.linspace(-1.0, 1.0, 7)[:, None]]
    path = video.render_beside(model, motions, tmp_path / "two.mp4", fps=24, size=(64, 48))
    raw = ["-loglevel", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    read = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *raw], capture_output=True, check=True)
    last = np.frombuffer(read.stdout, np.uint8).reshape(7, 48, 128, 3)[-1].astype(int)
    assert np.abs(last[:, :64] - last[:, 64:]).max() > 40


def test_the_drawing_follows_the_position(model, gl):
    data = mujoco.MjData(model)
    columns = []
    with offscreen.renderer(model, (160, 128)) as draw:
        for x in (-0.5, 0.5):
            data.qpos[:] = x
            mujoco.mj_forward(model, data)
            frame = draw(data, offscreen.find_camera(model, 0))
            assert frame.shape == (128, 160, 3)
            red = frame[..., 0].astype(int) > frame[..., 1].astype(int) + 40
            columns.append(np.argwhere(red)[:, 1].mean())
    assert columns[0] < 70 < 90 < columns[1]


def test_what_ffmpeg_complains_of_is_passed_on(model, gl, tmp_path):
    with pytest.raises(RepresentError, match="ffmpeg failed"):
        video.render(model, np.zeros((2, 1)), tmp_path / "a.mp4", fps=24, size=(161, 129))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(0, 1), (5, 2), (5,)])
def test_positions_of_another_model_are_refused(model, shape, tmp_path):
    with pytest.raises(RepresentError, match=r"qpos \[T, 1\]"):
        video.render(model, np.zeros(shape), tmp_path / "a.mp4", fps=24)


def test_positions_that_are_not_finite_are_refused(model, tmp_path):
    with pytest.raises(RepresentError, match="NaN"):
        video.render(model, np.full((2, 1), np.nan), tmp_path / "a.mp4", fps=24)


def test_an_unknown_camera_is_refused(model, tmp_path):
    with pytest.raises(UsageError, match="did you mean side"):
        video.render(model, np.zeros((2, 1)), tmp_path / "a.mp4", fps=24, camera="sid")
    with pytest.raises(UsageError, match="camera '3'"):
        video.render(model, np.zeros((2, 1)), tmp_path / "a.mp4", fps=24, camera=3)


def test_without_the_video_packages_the_message_says_what_to_install(model, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(RepresentError, match=r"represent_jax\[video\]"):
        video.render(model, np.zeros((2, 1)), tmp_path / "a.mp4", fps=24)


def test_without_gl_the_message_says_what_to_install(model, monkeypatch, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    for library in ("egl", "osmesa"):
        monkeypatch.setitem(sys.modules, f"mujoco.{library}", None)
    with pytest.raises(RepresentError, match=r"glfw: no display.*libegl1"):
        video.render(model, np.zeros((2, 1)), tmp_path / "a.mp4", fps=24)
    assert not list(tmp_path.iterdir())
