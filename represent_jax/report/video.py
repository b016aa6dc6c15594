"""Videos of a motion, rendered off-screen."""

import contextlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from represent_jax.data.atomic import replacing
from represent_jax.errors import RepresentError
from represent_jax.physics import offscreen


def render(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    path: str | os.PathLike,
    fps: float,
    camera: str | int = -1,
    size: tuple[int, int] = (640, 480),
) -> Path:
    """Renders a motion to an mp4 file, one frame a position, and returns its path.

    Args:
        model: the model.
        qpos: [T, nq] positions.
        path: the file; missing folders are made.
        fps: frames a second.
        camera: name or index of one of the model's cameras, -1 for the free camera.
        size: width and height in pixels, even numbers.

    Raises:
        RepresentError: ffmpeg or a GL library is missing, `qpos` does not fit the model, or the
            file cannot be written.
        UsageError: the model has no such camera.
    """
    return render_beside(model, [qpos], path, fps, camera, size)


def render_beside(
    model: mujoco.MjModel,
    motions: Sequence[np.ndarray],
    path: str | os.PathLike,
    fps: float,
    camera: str | int = -1,
    size: tuple[int, int] = (640, 480),
) -> Path:
    """Renders motions of one model side by side; those that end before the longest stand still.

    Args:
        model: the model.
        motions: positions [T, nq] of each motion, from left to right.
        path: the file; missing folders are made.
        fps: frames a second.
        camera: name or index of one of the model's cameras, -1 for the free camera.
        size: width and height of a panel in pixels, even numbers.

    Raises:
        RepresentError, UsageError: as `render`.
    """
    motions = [_checked(model, qpos) for qpos in motions]
    view = offscreen.find_camera(model, camera)
    ffmpeg = _ffmpeg()
    path = Path(path)
    width, height = size
    with offscreen.renderer(model, size) as draw, replacing(path) as temporary:
        with _encoder(ffmpeg, temporary, fps, (width * len(motions), height)) as send:
            data = mujoco.MjData(model)
            frame = np.empty((height, width * len(motions), 3), np.uint8)
            for step in range(max(len(qpos) for qpos in motions)):
                for panel, qpos in enumerate(motions):
                    data.qpos[:] = qpos[min(step, len(qpos) - 1)]
                    mujoco.mj_forward(model, data)
                    frame[:, panel * width : (panel + 1) * width] = draw(data, view)
                send(frame)
    return path


def check_available() -> None:
    """Checks that videos can be made here, before anything is computed for them.

    Raises:
        RepresentError: ffmpeg or a GL library is missing.
    """
    _ffmpeg()
    offscreen.check_available()


def _checked(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    qpos = np.asarray(qpos, np.float64)
    if qpos.ndim != 2 or qpos.shape[1] != model.nq or not len(qpos):
        raise RepresentError(f"video: expected qpos [T, {model.nq}], found shape {qpos.shape}")
    if not np.all(np.isfinite(qpos)):
        raise RepresentError("video: qpos holds NaN or infinity")
    return qpos


def _ffmpeg() -> str:
    """Returns the path of ffmpeg, that of imageio-ffmpeg or else the system's."""
    with contextlib.suppress(ImportError, RuntimeError):
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    found = shutil.which("ffmpeg")
    if found is None:
        raise RepresentError("videos need the extra packages: pip install 'represent_jax[video]'")
    return found


@contextlib.contextmanager
def _encoder(
    ffmpeg: str, path: Path, fps: float, size: tuple[int, int]
) -> Iterator[Callable[[np.ndarray], None]]:
    """Yields a function that adds a frame [height, width, 3] uint8 to an H.264 file."""
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{fps:g}"]
    coded = ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    command = [ffmpeg, "-y", "-loglevel", "error", *raw, "-i", "-", *coded, "-f", "mp4", str(path)]
    # imageio-ffmpeg's own writer forks with a Python function, which JAX warns may deadlock.
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log)
        try:
            with contextlib.suppress(BrokenPipeError), process.stdin as pipe:
                yield lambda frame: pipe.write(np.ascontiguousarray(frame).data)
        finally:
            status = process.wait()
        if status:
            log.seek(0)
            reason = log.read().decode(errors="replace").strip().rpartition("\n")[2]
            raise RepresentError(f"{path}: ffmpeg failed ({reason or f'exit status {status}'})")
