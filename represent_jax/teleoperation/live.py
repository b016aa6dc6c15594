"""A session in real time: it steps, it is drawn, it obeys commands; nothing here knows the web."""

import asyncio
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from represent_jax.errors import RepresentError, UsageError, unknown
from represent_jax.teleoperation.keys import HeldKeys
from represent_jax.teleoperation.pace import Pace
from represent_jax.teleoperation.painter import Painter
from represent_jax.teleoperation.session import Session

_MAX_HELD = 32
_STATUS_SECONDS = 0.05
# A page that drives says so four times a second. Whoever was not heard of for so long has lost the
# connection, and the episode should not go on without them.
_GONE_SECONDS = 3.0
_GONE = "Paused: the page that drives has fallen silent."


class Live:
    """Runs a session on the event loop.

    The session has a thread of its own, so has the painter: a slow picture delays no step, and a
    step delays no message. What others hear is the last of each, never a queue.

    Attributes:
        session: the session.
        cameras: names of the views; empty where nothing can be drawn.
        no_pictures: why nothing can be drawn, empty where it can.
    """

    def __init__(
        self,
        session: Session,
        painter: Painter,
        on_status: Callable[[Mapping[str, Any]], None],
        on_picture: Callable[[bytes], None],
        fps: float = 20.0,
    ):
        """Takes over a session and a painter.

        Args:
            session: the session.
            painter: the painter, not yet opened.
            on_status: hears live figures, ready for JSON.
            on_picture: hears JPEG files.
            fps: pictures a second, at most; independent of the control rate.
        """
        self.session = session
        self.cameras: list[str] = []
        self.no_pictures = ""
        self._painter = painter
        self._on_status, self._on_picture = on_status, on_picture
        self._picture_seconds = 1.0 / fps
        self._keys = HeldKeys()
        self._pace = Pace(session.env.engine.dt)
        self._stepping, self._painting = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._moving, self._untold, self._unpainted = (asyncio.Event() for _ in range(3))

    async def open(self) -> None:
        """Finds out whether pictures can be drawn."""
        try:
            await self._on_thread(self._painting, self._painter.open)
            self.cameras = self._painter.cameras
        except RepresentError as error:
            self.no_pictures = str(error)
        self.refresh()

    async def run(self) -> None:
        """Steps and draws until it is cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._drive())
            tasks.create_task(self._tell())
            tasks.create_task(self._paint())

    async def close(self) -> None:
        """Frees the threads and what they hold."""
        await self._on_thread(self._painting, self._painter.close)
        self._stepping.shutdown()
        self._painting.shutdown()

    def refresh(self) -> None:
        """Has status and picture told once more."""
        self._untold.set()
        self._unpainted.set()

    def leave(self) -> None:
        """Releases all keys and pauses the episode: nobody drives any more.

        Waits for nothing, since whoever calls it may be about to be cancelled.
        """
        self._keys.release()
        loop = asyncio.get_running_loop()
        self._stepping.submit(self.session.pause).add_done_callback(
            lambda _: loop.call_soon_threadsafe(self.refresh)
        )

    async def obey(self, message: Mapping[str, Any]) -> None:
        """Carries out what a driver wants.

        Args:
            message: `do` names the command; beside it are the command's arguments.

        Raises:
            UsageError: no such command, an argument is not as it has to be, or the command does not
                fit what the session is doing.
            RepresentError: an episode could not be saved; it is kept.
        """
        do = message.get("do")
        self._keys.hear(time.monotonic())
        if do == "keys":
            held = _argument(message, "held", list)[:_MAX_HELD]
            self._keys.update([str(key) for key in held], time.monotonic())
        elif do in ("start", "resume"):
            self._keys.take(time.monotonic())
            await self._command(getattr(self.session, do))
        elif do in ("pause", "discard", "stop"):
            await self._command(getattr(self.session, do))
        elif do == "save":
            await self._command(self.session.save, _argument(message, "strategy", int))
        elif do == "play":
            await self._command(self.session.play, _argument(message, "episode", int))
        elif do == "choose":
            await self._view(self._painter.choose, _argument(message, "camera", int))
        elif do == "orbit":
            names = ("right", "down", "closer")
            await self._view(
                self._painter.orbit, *(_argument(message, name, (int, float)) for name in names)
            )
        else:
            known = ("keys", "start", "pause", "resume", "discard", "save", "play", "stop")
            raise unknown("command", str(do), (*known, "choose", "orbit"))

    async def recorded(self) -> list[dict[str, Any]]:
        """Returns a line for each recorded episode."""
        return await self._on_thread(self._stepping, self.session.recorded)

    async def _command(self, command: Callable[..., None], *arguments: Any) -> None:
        try:
            await self._on_thread(self._stepping, command, *arguments)
        finally:
            if self.session.moving:
                self._moving.set()
            self.refresh()

    async def _view(self, change: Callable[..., None], *arguments: Any) -> None:
        if not self.no_pictures:
            await self._on_thread(self._painting, change, *arguments)
            self.refresh()

    async def _drive(self) -> None:
        while True:
            await self._moving.wait()
            self._moving.clear()
            self._pace.restart(time.monotonic())
            while self.session.moving:
                now = time.monotonic()
                held_at_steps = [self._keys.take(now) for _ in range(self._pace.due(now))]
                if held_at_steps:
                    await self._on_thread(self._stepping, self._advance, held_at_steps)
                    self.refresh()
                if self._keys.silence(now) > _GONE_SECONDS:
                    await self._on_thread(self._stepping, self.session.pause, _GONE)
                await asyncio.sleep(self._pace.wait(time.monotonic()))

    def _advance(self, held_at_steps: Sequence[frozenset[str]]) -> None:
        for held in held_at_steps:
            self.session.step(held)

    async def _tell(self) -> None:
        while True:
            started = await self._next(self._untold)
            figures = await self._on_thread(self._stepping, self.session.figures)
            view = {"camera": self._painter.camera, "speed": self._pace.speed}
            self._on_status(figures | view)
            await self._until(started + _STATUS_SECONDS)

    async def _paint(self) -> None:
        while not self.no_pictures:
            started = await self._next(self._unpainted)
            qpos = await self._on_thread(self._stepping, lambda: self.session.qpos)
            self._on_picture(await self._on_thread(self._painting, self._painter.paint, qpos))
            await self._until(started + self._picture_seconds)

    async def _next(self, event: asyncio.Event) -> float:
        """Waits for news, and returns when they came."""
        await event.wait()
        event.clear()
        return time.monotonic()

    async def _until(self, then: float) -> None:
        await asyncio.sleep(max(0.0, then - time.monotonic()))

    async def _on_thread(
        self, thread: ThreadPoolExecutor, call: Callable[..., Any], *arguments: Any
    ) -> Any:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(thread, functools.partial(call, *arguments))


def _argument(message: Mapping[str, Any], name: str, kinds: type | tuple[type, ...]) -> Any:
    value = message.get(name)
    if not isinstance(value, kinds) or isinstance(value, bool):
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise UsageError(f"{message.get('do')}: {name}: expected {wanted}, found {value!r}")
    return value
