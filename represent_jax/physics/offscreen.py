"""Drawing a scene off-screen, with whichever OpenGL library of the machine works."""

import contextlib
import copy
import importlib
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

from represent_jax.errors import RepresentError, unknown

_LIBRARIES = ("egl", "osmesa", "glfw")


def find_camera(model: mujoco.MjModel, camera: str | int = -1) -> mujoco.MjvCamera:
    """Returns one of the model's cameras by name or index, or the free camera, "free" or -1.

    Raises:
        UsageError: the model has no such camera.
    """
    if isinstance(camera, str):
        names = ["free", *(model.camera(i).name for i in range(model.ncam))]
        if camera not in names:
            raise unknown("camera", camera, [name for name in names if name])
        camera = names.index(camera) - 1
    if not -1 <= camera < model.ncam:
        raise unknown("camera", str(camera), [str(i) for i in range(-1, model.ncam)])
    found = mujoco.MjvCamera()
    if camera < 0:
        mujoco.mjv_defaultFreeCamera(model, found)
    else:
        found.type, found.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
    return found


def default_camera(model: mujoco.MjModel) -> int:
    """Returns the index of the first camera that follows the robot, or -1, the free camera.

    Others, such as one in a hand, need not show the whole scene.
    """
    modes = (mujoco.mjtCamLight.mjCAMLIGHT_TRACK, mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
    following = np.flatnonzero(np.isin(model.cam_mode, [int(mode) for mode in modes]))
    return int(following[0]) if following.size else -1


@contextlib.contextmanager
def renderer(
    model: mujoco.MjModel, size: tuple[int, int], plain: bool = False
) -> Iterator[Callable[[mujoco.MjData, mujoco.MjvCamera], np.ndarray]]:
    """Yields a function from (data, camera) to a frame [height, width, 3], good until the next.

    It belongs to the thread that made it.

    Args:
        model: the model.
        size: width and height in pixels.
        plain: whether to leave out shadows, reflections and smoothing, which without a graphics
            card take most of the time.

    Raises:
        RepresentError: no OpenGL library works.
    """
    model = copy.copy(model)
    width, height = size
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    if plain:
        model.vis.quality.shadowsize = model.vis.quality.offsamples = 0
    gl, context = _open(model)
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        scene = mujoco.MjvScene(model, maxgeom=max(1000, 4 * model.ngeom))
        if plain:
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                scene.flags[flag] = 0
        options = mujoco.MjvOption()
        frame, area = np.zeros((height, width, 3), np.uint8), mujoco.MjrRect(0, 0, width, height)

        def draw(data: mujoco.MjData, camera: mujoco.MjvCamera) -> np.ndarray:
            mujoco.mjv_updateScene(
                model, data, options, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene
            )
            mujoco.mjr_render(area, scene, context)
            mujoco.mjr_readPixels(frame, None, area, context)
            return frame[::-1]

        yield draw
    finally:
        context.free()
        gl.free()


def check_available() -> None:
    """Checks that something can be drawn here.

    Raises:
        RepresentError: no OpenGL library works.
    """
    with renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), (64, 64)):
        pass


def _open(model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
    """Opens the first GL library that works; MUJOCO_GL names the only one to try.

    MuJoCo's own choice is made on its import, and is a window where there may be no display.

    Raises:
        RepresentError: none works.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    width, height = model.vis.global_.offwidth, model.vis.global_.offheight
    reasons = []
    for library in [asked] if asked in _LIBRARIES else _LIBRARIES:
        if library == "glfw" and sys.platform == "linux" and not os.environ.get("DISPLAY"):
            reasons.append("glfw: no display")
            continue
        gl = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                gl = importlib.import_module(f"mujoco.{library}").GLContext(width, height)
            gl.make_current()
            return gl, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # Each library fails in its own way where it is not installed.
            reasons.append(f"{library}: {str(error).splitlines()[0] if str(error) else error!r}")
            if gl is not None:
                gl.free()
    raise RepresentError(
        f"pictures of {width} x {height} pixels need an OpenGL library that draws off-screen, and "
        f"none works ({'; '.join(reasons)}); install EGL (Debian: libegl1) or OSMesa "
        "(libosmesa6), and set MUJOCO_GL=egl or MUJOCO_GL=osmesa to choose one"
    )
