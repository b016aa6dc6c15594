"""Videos of a motion, rendered off-screen."""

import contextlib
import copy
import importlib
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from represent_jax.data.atomic import replacing
from represent_jax.errors import RepresentError, unknown

_LIBRARIES = ("egl", "osmesa", "glfw")


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
    camera = _camera_id(model, camera)
    ffmpeg = _ffmpeg()
    path = Path(path)
    width, height = size
    with _renderer(model, size) as draw, replacing(path) as temporary:
        with _encoder(ffmpeg, temporary, fps, (width * len(motions), height)) as send:
            data = mujoco.MjData(model)
            frame = np.empty((height, width * len(motions), 3), np.uint8)
            for step in range(max(len(qpos) for qpos in motions)):
                for panel, qpos in enumerate(motions):
                    data.qpos[:] = qpos[min(step, len(qpos) - 1)]
                    mujoco.mj_forward(model, data)
                    frame[:, panel * width : (panel + 1) * width] = draw(data, camera)
                send(frame)
    return path


def check_available() -> None:
    """Checks that videos can be made here, before anything is computed for them.

    Raises:
        RepresentError: ffmpeg or a GL library is missing.
    """
    _ffmpeg()
    _gl_context(64, 64).free()


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


def _camera_id(model: mujoco.MjModel, camera: str | int) -> int:
    if isinstance(camera, str):
        names = [model.camera(i).name for i in range(model.ncam)]
        if camera not in names:
            raise unknown("camera", camera, names or ["-1 (free)"])
        return names.index(camera)
    if not -1 <= camera < model.ncam:
        raise unknown("camera", str(camera), [str(i) for i in range(-1, model.ncam)])
    return camera


@contextlib.contextmanager
def _renderer(model: mujoco.MjModel, size: tuple[int, int]) -> Iterator[Any]:
    """Yields a function from (data, camera) to a frame [height, width, 3], good until the next."""
    model = copy.copy(model)
    width, height = size
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    gl = _gl_context(width, height)
    try:
        gl.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        scene = mujoco.MjvScene(model, maxgeom=max(1000, 4 * model.ngeom))
        options, view = mujoco.MjvOption(), mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, view)
        frame, area = np.zeros((height, width, 3), np.uint8), mujoco.MjrRect(0, 0, width, height)

        def draw(data: mujoco.MjData, camera: int) -> np.ndarray:
            if camera >= 0:
                view.fixedcamid, view.type = camera, mujoco.mjtCamera.mjCAMERA_FIXED
            mujoco.mjv_updateScene(
                model, data, options, None, view, mujoco.mjtCatBit.mjCAT_ALL, scene
            )
            mujoco.mjr_render(area, scene, context)
            mujoco.mjr_readPixels(frame, None, area, context)
            return frame[::-1]

        yield draw
        context.free()
    finally:
        gl.free()


def _gl_context(width: int, height: int) -> Any:
    """Returns a context of the first GL library that works; MUJOCO_GL names the only one to try.

    MuJoCo's own choice is made on its import, and is a window where there may be no display.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    reasons = []
    for library in [asked] if asked in _LIBRARIES else _LIBRARIES:
        if library == "glfw" and sys.platform == "linux" and not os.environ.get("DISPLAY"):
            reasons.append("glfw: no display")
            continue
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return importlib.import_module(f"mujoco.{library}").GLContext(width, height)
        except Exception as error:  # Each library fails in its own way where it is not installed.
            reasons.append(f"{library}: {str(error).splitlines()[0] if str(error) else error!r}")
    raise RepresentError(
        "videos need an OpenGL library that draws off-screen, and none was found "
        f"({'; '.join(reasons)}); install EGL (Debian: libegl1) or OSMesa (libosmesa6), "
        "and set MUJOCO_GL=egl or MUJOCO_GL=osmesa to choose one"
    )
