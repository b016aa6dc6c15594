"""Videos of a motion, rendered off-screen."""

import contextlib
import copy
import importlib
import os
import sys
import warnings
from collections.abc import Iterator
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
        size: width and height in pixels, multiples of 16.

    Raises:
        RepresentError: the video packages or a GL library are missing, `qpos` does not fit the
            model, or the file cannot be written.
        UsageError: the model has no such camera.
    """
    qpos = np.asarray(qpos, np.float64)
    if qpos.ndim != 2 or qpos.shape[1] != model.nq or not len(qpos):
        raise RepresentError(f"video: expected qpos [T, {model.nq}], found shape {qpos.shape}")
    if not np.all(np.isfinite(qpos)):
        raise RepresentError("video: qpos holds NaN or infinity")
    camera = _camera_id(model, camera)
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise RepresentError(
            "videos need the extra packages: pip install 'represent_jax[video]'"
        ) from error

    path = Path(path)
    with contextlib.ExitStack() as stack:
        draw = stack.enter_context(_renderer(model, size))
        temporary = stack.enter_context(replacing(path))
        writer = imageio_ffmpeg.write_frames(
            str(temporary), size, fps=fps, codec="libx264", output_params=["-f", "mp4"]
        )
        stack.callback(writer.close)
        writer.send(None)
        data = mujoco.MjData(model)
        for position in qpos:
            data.qpos[:] = position
            mujoco.mj_forward(model, data)
            writer.send(draw(data, camera))
    return path


def _camera_id(model: mujoco.MjModel, camera: str | int) -> int:
    if isinstance(camera, str):
        names = [model.camera(i).name for i in range(model.ncam)]
        if camera not in names:
            raise unknown("camera", camera, names)
        return names.index(camera)
    if not -1 <= camera < model.ncam:
        raise unknown("camera", str(camera), [str(i) for i in range(-1, model.ncam)])
    return camera


@contextlib.contextmanager
def _renderer(model: mujoco.MjModel, size: tuple[int, int]) -> Iterator[Any]:
    """Yields a function from (data, camera) to a frame [height, width, 3] uint8."""
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
            return np.ascontiguousarray(frame[::-1])

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
