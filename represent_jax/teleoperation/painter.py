"""Live pictures of a scene as JPEG files."""

import contextlib
import io
import time
from collections.abc import Callable

import mujoco
import numpy as np

from represent_jax.physics import offscreen

_QUALITY = 85
# A machine that is quicker than this with a plain picture can afford shadows.
_QUICK_SECONDS = 0.01


class Painter:
    """Draws one scene; all its methods belong to one thread, as its OpenGL context does.

    Attributes:
        size: width and height of a picture, in pixels.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int], camera: str | int = -1):
        """Chooses a view; draws nothing yet.

        Raises:
            UsageError: the model has no such camera.
        """
        self.size = size
        self.cameras = [
            "free",
            *(model.camera(i).name or f"camera {i}" for i in range(model.ncam)),
        ]
        self._model, self._data = model, mujoco.MjData(model)
        self._free = offscreen.find_camera(model)
        self.choose(offscreen.find_camera(model, camera).fixedcamid + 1)
        self._draw: Callable[[mujoco.MjData, mujoco.MjvCamera], np.ndarray] | None = None
        self._resources = contextlib.ExitStack()

    def open(self) -> None:
        """Finds an OpenGL library, and out how well it can draw.

        Raises:
            RepresentError: none works.
        """
        self._open(plain=True)
        if min(self._seconds() for _ in range(3)) < _QUICK_SECONDS:
            self.close()
            self._open(plain=False)

    def close(self) -> None:
        """Frees what `open` has taken."""
        self._draw = None
        self._resources.close()

    def paint(self, qpos: np.ndarray) -> bytes:
        """Returns a JPEG file of the scene at positions `[nq]`."""
        from PIL import Image

        self._data.qpos[:] = qpos
        mujoco.mj_forward(self._model, self._data)
        file = io.BytesIO()
        frame = self._draw(self._data, self._camera)
        Image.fromarray(frame).save(file, "jpeg", quality=_QUALITY)
        return file.getvalue()

    def choose(self, camera: int) -> None:
        """Looks through another camera, by its index in `cameras`."""
        self._camera = offscreen.find_camera(self._model, camera - 1) if camera else self._free
        self.camera = camera

    def orbit(self, right: float, down: float, closer: float) -> None:
        """Moves the free camera around what it looks at; chooses it first.

        Args:
            right, down: how far the scene seems to turn, in degrees.
            closer: natural logarithm by which the distance shrinks.
        """
        self.choose(0)
        self._free.azimuth -= right
        self._free.elevation = np.clip(self._free.elevation - down, -89.0, 89.0)
        self._free.distance *= np.exp(-np.clip(closer, -1.0, 1.0))

    def _open(self, plain: bool) -> None:
        renderer = offscreen.renderer(self._model, self.size, plain)
        self._draw = self._resources.enter_context(renderer)

    def _seconds(self) -> float:
        """Time that a picture takes."""
        start = time.perf_counter()
        self.paint(self._model.qpos0)
        return time.perf_counter() - start
