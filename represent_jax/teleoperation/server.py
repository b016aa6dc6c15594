"""The page and what it talks to: one driver, any number of watchers.

GET /          the page, with page.js and page.css beside it
GET /recorded  the episodes of the file, as JSON
GET /live      a websocket. The server sends JSON (`hello`, `role`, `status`, `problem`) and JPEG
               files; the page sends commands (see `Live.obey`), and `drive` to take a free seat.
"""

import asyncio
import json
import math
import signal
import socket
from collections.abc import Callable
from importlib import resources
from typing import Any
from urllib.parse import urlsplit

from represent_jax.errors import RepresentError, UsageError
from represent_jax.teleoperation.live import Live
from represent_jax.teleoperation.painter import Painter
from represent_jax.teleoperation.session import Session

try:
    import aiohttp
    from aiohttp import web
except ImportError as error:
    raise UsageError(
        f"aiohttp is not installed: pip install 'represent_jax[teleop]' ({error})"
    ) from error

LOOPBACK = ("localhost", "127.0.0.1", "::1")
SERVER = web.AppKey("server", "Server")

_PAGE = {
    "/": ("index.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
}
# A connection that answers no ping for half as long is dropped.
_HEARTBEAT_SECONDS = 8.0
_MAX_MESSAGE_BYTES = 16_384


def serve(
    session: Session,
    painter: Painter,
    host: str = "localhost",
    port: int = 8080,
    fps: float = 20.0,
    announce: Callable[[str], None] = print,
) -> None:
    """Serves the page until the process is interrupted or told to end.

    Args:
        session: what is driven.
        painter: what draws it.
        host: address to listen on; "localhost" keeps other machines out.
        port: port to listen on; 0 picks a free one.
        fps: pictures a second, at most.
        announce: is told the page's address once it is served.

    Raises:
        UsageError: the address cannot be listened on.
    """
    asyncio.run(_serve(session, painter, host, port, fps, announce))


def make_app(session: Session, painter: Painter, host: str, fps: float = 20.0) -> web.Application:
    """Makes the web application; `serve` runs it."""
    app = web.Application(middlewares=[_same_site(host)])
    server = Server(session, painter, fps)
    app[SERVER] = server
    for path, (name, content_type) in _PAGE.items():
        app.router.add_get(path, _file_handler(name, content_type))
    app.router.add_get("/recorded", server.recorded)
    app.router.add_get("/live", server.connect)
    app.cleanup_ctx.append(server.lifetime)
    app.on_shutdown.append(server.disconnect_all)
    return app


class Server:
    """Connections to one live session, of which at most one drives.

    Attributes:
        live: the session in real time.
    """

    def __init__(self, session: Session, painter: Painter, fps: float):
        self.live = Live(session, painter, self._tell_status, self._tell_picture, fps)
        self._connections: list[_Connection] = []
        self._driver: _Connection | None = None
        self._running: asyncio.Task | None = None

    async def lifetime(self, app: web.Application):
        """Runs the session as long as the application."""
        del app
        await self.live.open()
        self._running = asyncio.create_task(self.live.run())
        yield
        self._running.cancel()
        try:
            await self._running
        except asyncio.CancelledError:
            pass
        finally:
            await self.live.close()

    async def wait(self) -> None:
        """Returns never; raises what ended the session, should anything do so."""
        await asyncio.shield(self._running)

    async def disconnect_all(self, app: web.Application) -> None:
        """Says goodbye to every page."""
        del app
        for connection in list(self._connections):
            await connection.page.close(code=aiohttp.WSCloseCode.GOING_AWAY)

    async def recorded(self, request: web.Request) -> web.Response:
        """Lists the episodes of the file."""
        del request
        return web.json_response(await self.live.recorded())

    async def connect(self, request: web.Request) -> web.WebSocketResponse:
        """Talks to one page until its connection ends."""
        page = web.WebSocketResponse(
            heartbeat=_HEARTBEAT_SECONDS, max_msg_size=_MAX_MESSAGE_BYTES, compress=False
        )
        await page.prepare(request)
        connection = _Connection(page)
        connection.put("hello", self._hello())
        self._connections.append(connection)
        if self._driver is None:
            self._driver = connection
        self._tell_roles()
        sending = asyncio.create_task(connection.send())
        try:
            async for message in page:
                if message.type == aiohttp.WSMsgType.TEXT:
                    await self._hear(connection, message.data)
        finally:
            sending.cancel()
            self._connections.remove(connection)
            if self._driver is connection:
                self._driver = None
                self.live.leave()
            self._tell_roles()
        return page

    async def _hear(self, connection: "_Connection", text: str) -> None:
        try:
            message = _parse(text)
            if message.get("do") == "drive":
                if self._driver is None:
                    self._driver = connection
                self._tell_roles()
                return
            if self._driver is not connection:
                raise UsageError("another page is driving; this one can only watch")
            await self.live.obey(message)
        except RepresentError as error:
            connection.put("problem", {"text": str(error)})

    def _hello(self) -> dict[str, Any]:
        session = self.live.session
        keyboard = session.keyboard
        return {
            "env": session.env.name,
            "path": str(session.path),
            "keys": dict(keyboard.keys) if keyboard else {},
            "watched": session.watched,
            "cameras": self.live.cameras,
            "no_pictures": self.live.no_pictures,
        }

    def _tell_roles(self) -> None:
        self.live.refresh()
        for connection in self._connections:
            drives = connection is self._driver
            connection.put("role", {"drives": drives, "free": self._driver is None})

    def _tell_status(self, status) -> None:
        for connection in self._connections:
            connection.put("status", status)

    def _tell_picture(self, picture: bytes) -> None:
        for connection in self._connections:
            connection.put("picture", picture)


class _Connection:
    """One page. Of each kind of message only the last waits: a slow page skips pictures."""

    def __init__(self, page: web.WebSocketResponse):
        self.page = page
        self._waiting: dict[str, Any] = {}
        self._any = asyncio.Event()

    def put(self, kind: str, content: Any) -> None:
        self._waiting[kind] = content
        self._any.set()

    async def send(self) -> None:
        try:
            while True:
                await self._any.wait()
                self._any.clear()
                waiting, self._waiting = self._waiting, {}
                for kind, content in waiting.items():
                    if isinstance(content, bytes):
                        await self.page.send_bytes(content)
                    else:
                        await self.page.send_json({"kind": kind, **content}, dumps=_dumps)
        except ConnectionError:
            return  # The page is gone, as the loop that reads from it is about to find out.


def _dumps(content: dict[str, Any]) -> str:
    """JSON knows no NaN or infinity, and physics may; a page shows them as unknown."""
    return json.dumps(_finite(content), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _parse(text: str) -> dict[str, Any]:
    try:
        message = json.loads(text)
    except ValueError as error:
        raise UsageError(f"message: expected JSON, found {text[:40]!r}") from error
    if not isinstance(message, dict):
        raise UsageError(f"message: expected a JSON object, found {text[:40]!r}")
    return message


def _same_site(host: str):
    """Refuses pages of other sites, which a browser would let talk to this machine."""

    @web.middleware
    async def check(request: web.Request, handler):
        origin = request.headers.get("Origin")
        foreign = origin is not None and urlsplit(origin).netloc != request.host
        # A name of another site may be made to point here: then its pages pass for ours.
        name = urlsplit(f"//{request.host}").hostname
        if foreign or (host in LOOPBACK and name not in LOOPBACK):
            raise web.HTTPForbidden(text="This page is served to its own address only.")
        return await handler(request)

    return check


def _file_handler(name: str, content_type: str):
    text = (resources.files(__package__) / "page" / name).read_text(encoding="utf-8")

    async def handle(request: web.Request) -> web.Response:
        del request
        headers = {"Cache-Control": "no-store"}
        return web.Response(text=text, content_type=content_type, headers=headers)

    return handle


async def _serve(session, painter, host, port, fps, announce) -> None:
    app = make_app(session, painter, host, fps)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        try:
            await web.TCPSite(runner, host, port).start()
        except socket.gaierror as error:
            raise UsageError(
                f"host: expected an address of this machine, found {host!r} ({error.strerror})"
            ) from error
        except OSError as error:
            raise UsageError(
                f"cannot listen on {host}:{port} ({error.strerror}); choose another --port"
            ) from error
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop.set)
        shown = f"[{host}]" if ":" in host else host
        announce(f"http://{shown}:{runner.addresses[0][1]}")
        tasks = [asyncio.create_task(stop.wait()), asyncio.create_task(app[SERVER].wait())]
        done, pending = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in pending:
            task.cancel()
        for task in done:
            task.result()
    finally:
        await runner.cleanup()
