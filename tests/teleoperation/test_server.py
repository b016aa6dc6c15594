"""The server behind the page: one driver, connections that break, a process that is killed."""

import asyncio
import contextlib
import json
import signal
import sys

import pytest
from browser import launched

from represent_jax.data import load_demonstrations
from represent_jax.envs import make_env
from represent_jax.errors import RepresentError, UsageError
from represent_jax.physics import offscreen
from represent_jax.teleoperation.painter import Painter
from represent_jax.teleoperation.session import Phase, Session

aiohttp = pytest.importorskip("aiohttp", reason="needs the extra 'teleop'")

from aiohttp import test_utils  # noqa: E402

from represent_jax.teleoperation import live, server  # noqa: E402

SECONDS = 20.0


class Page:
    """What a page does, without a browser."""

    def __init__(self, socket):
        self.socket = socket
        self.heard = {}
        self.pictures = []

    async def send(self, do, **arguments):
        await self.socket.send_json({"do": do, **arguments})

    async def until(self, found):
        """Listens until `found(heard)`, which is a dictionary of the last message of each kind."""
        async with asyncio.timeout(SECONDS):
            while not found(self.heard):
                message = await self.socket.receive()
                if message.type == aiohttp.WSMsgType.BINARY:
                    self.pictures.append(message.data)
                elif message.type == aiohttp.WSMsgType.TEXT:
                    content = json.loads(message.data)
                    self.heard[content.pop("kind")] = content
                else:
                    raise ConnectionError(f"closed: {message}")

    async def until_phase(self, phase):
        await self.until(lambda heard: heard.get("status", {}).get("phase") == phase)

    async def until_driven(self):
        await self.until(lambda heard: heard.get("status", {}).get("step", 0) >= 1)

    async def until_problem(self):
        self.heard.pop("problem", None)
        await self.until(lambda heard: "problem" in heard)
        return self.heard["problem"]["text"]


@pytest.fixture(scope="module")
def lasting_env():
    """An environment whose episodes only the horizon ends, however slow the machine is."""
    return make_env("inverted_double_pendulum", backend="mujoco", terminates=False)


@pytest.fixture
def serve(lasting_env, tmp_path):
    """Starts a server in the event loop, and gives a client of it."""

    @contextlib.asynccontextmanager
    async def start(horizon=10_000):
        session = Session(lasting_env, tmp_path / "mine.npz", horizon, seed=0)
        painter = Painter(lasting_env.engine.model, (96, 64))
        app = server.make_app(session, painter, "localhost")
        async with test_utils.TestClient(test_utils.TestServer(app)) as client:
            client.session_under_test = session
            yield client

    return start


@contextlib.asynccontextmanager
async def page(client):
    async with client.ws_connect("/live") as socket:
        yield Page(socket)


def test_a_page_drives_and_saves(serve):
    async def scenario():
        async with serve(horizon=5) as client, page(client) as driver:
            await driver.until(lambda heard: heard.keys() >= {"hello", "role", "status"})
            assert driver.heard["role"] == {"drives": True, "free": False}
            assert driver.heard["hello"]["env"] == "inverted_double_pendulum"
            assert set(driver.heard["hello"]["keys"]) == {"arrowleft", "arrowright"}
            await driver.send("keys", held=["arrowleft"])
            await driver.send("start")
            await driver.until_phase("over")
            await driver.send("save", strategy=1)
            await driver.until_phase("ready")
            assert driver.heard["status"]["num_recorded"] == 1
            (line,) = await (await client.get("/recorded")).json()
            (trajectory,) = load_demonstrations(client.session_under_test.path).trajectories
            assert line["steps"] == trajectory.length
            assert (trajectory.actions == -0.5).all()
            await driver.send("play", episode=1)
            await driver.until(
                lambda heard: heard["status"]["notice"].startswith("Played to its end")
            )
            assert driver.heard["status"]["notice"] == "Played to its end."

    asyncio.run(scenario())


def test_a_second_page_watches_until_the_seat_is_free(serve):
    async def scenario():
        async with serve() as client:
            async with page(client) as driver:
                await driver.until(lambda heard: "role" in heard)
                async with page(client) as watcher:
                    await watcher.until(lambda heard: "role" in heard)
                    assert watcher.heard["role"] == {"drives": False, "free": False}
                    await watcher.send("start")
                    assert "another page is driving" in await watcher.until_problem()
                    await watcher.send("drive")
                    await driver.send("start")
                    await watcher.until_phase("driving")
                    await driver.socket.close()
                    await watcher.until(lambda heard: heard["role"]["free"])
                    await watcher.send("drive")
                    await watcher.until(lambda heard: heard["role"]["drives"])
                    await watcher.send("discard")
                    await watcher.until_phase("ready")

    asyncio.run(scenario())


def test_a_dropped_connection_releases_the_keys_and_pauses(serve):
    async def scenario():
        async with serve() as client:
            session = client.session_under_test
            async with page(client) as driver:
                await driver.send("keys", held=["arrowright"])
                await driver.send("start")
                await driver.until_driven()
                driver.socket._response.connection.transport.abort()
            async with page(client) as other:
                await other.until_phase("paused")
                steps = session.num_steps
                await asyncio.sleep(0.2)
                assert session.num_steps == steps
                await other.until(lambda heard: heard["role"]["free"] or heard["role"]["drives"])
                if not other.heard["role"]["drives"]:
                    await other.send("drive")
                await other.send("save", strategy=1)
                await other.until_phase("ready")
            assert load_demonstrations(session.path).trajectories[0].length == steps
            assert session.phase is Phase.READY

    asyncio.run(scenario())


def test_an_episode_does_not_go_on_without_a_driver_who_has_fallen_silent(serve, monkeypatch):
    monkeypatch.setattr(live, "_GONE_SECONDS", 1.0)

    async def scenario():
        async with serve() as client, page(client) as driver:
            await driver.send("start")
            for _ in range(15):
                await driver.send("keys", held=[])
                await asyncio.sleep(0.1)
            assert client.session_under_test.phase is Phase.DRIVING
            await driver.until_phase("paused")
            assert "fallen silent" in driver.heard["status"]["notice"]

    asyncio.run(scenario())


def test_figures_are_told_often_however_few_pictures_are_wanted(lasting_env, tmp_path):
    session = Session(lasting_env, tmp_path / "mine.npz", horizon=3)
    app = server.make_app(session, Painter(lasting_env.engine.model, (96, 64)), "localhost", 0.01)

    async def scenario():
        async with test_utils.TestClient(test_utils.TestServer(app)) as client:
            async with page(client) as driver:
                await driver.until_phase("ready")
                await driver.send("start")
                await driver.until_phase("over")

    asyncio.run(scenario())


def test_pictures_are_sent_and_the_view_turns(serve):
    try:
        offscreen.check_available()
    except RepresentError as error:
        pytest.skip(str(error))

    async def scenario():
        async with serve() as client, page(client) as driver:
            await driver.until(lambda _: driver.pictures)
            assert driver.pictures[0].startswith(b"\xff\xd8")
            await driver.send("orbit", right=90, down=20, closer=0.5)
            await driver.until(lambda _: driver.pictures[-1] != driver.pictures[0])

    asyncio.run(scenario())


def test_without_gl_the_page_says_so_and_driving_goes_on(serve, monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    for library in ("egl", "osmesa"):
        monkeypatch.setitem(sys.modules, f"mujoco.{library}", None)

    async def scenario():
        async with serve(horizon=3) as client, page(client) as driver:
            await driver.until(lambda heard: "hello" in heard)
            assert "libegl1" in driver.heard["hello"]["no_pictures"]
            await driver.send("start")
            await driver.until_phase("over")
            assert not driver.pictures

    asyncio.run(scenario())


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        ("no json", "expected JSON"),
        ("[]", "expected a JSON object"),
        ('{"do": "strat"}', "did you mean start"),
        ('{"do": "save"}', "save: strategy: expected int, found None"),
        ('{"do": "keys", "held": "w"}', "held: expected list"),
        ('{"do": "play", "episode": 7}', "episode: expected 1 to 0, found 7"),
        ('{"do": "resume"}', "expected to be paused, found ready"),
    ],
)
def test_messages_that_make_no_sense_are_answered(serve, message, problem):
    async def scenario():
        async with serve() as client, page(client) as driver:
            await driver.socket.send_str(message)
            assert problem in await driver.until_problem()

    asyncio.run(scenario())


def test_pages_of_other_sites_are_refused(serve):
    async def scenario():
        async with serve() as client:
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await client.ws_connect("/live", headers={"Origin": "http://evil.example"})
            rebound = await client.get("/", headers={"Host": "evil.example"})
            assert rebound.status == 403
            assert (await client.get("/")).status == 200

    asyncio.run(scenario())


def test_a_port_that_is_taken_is_refused(env, tmp_path):
    session, painter = Session(env, tmp_path / "a.npz"), Painter(env.engine.model, (96, 64))

    async def scenario():
        async with test_utils.RawTestServer(None, host="127.0.0.1") as other:
            with pytest.raises(UsageError, match=f"cannot listen on 127.0.0.1:{other.port}"):
                await server._serve(session, painter, "127.0.0.1", other.port, 20.0, print)

    asyncio.run(scenario())


def test_an_address_that_is_not_of_this_machine_is_named(env, tmp_path):
    session, painter = Session(env, tmp_path / "a.npz"), Painter(env.engine.model, (96, 64))
    with pytest.raises(UsageError, match="host: expected an address of this machine, found 'no"):
        server.serve(session, painter, "no.such.host.invalid", 0)


async def _save_one(address):
    async with aiohttp.ClientSession() as client:
        async with client.ws_connect(f"{address}/live") as socket:
            driver = Page(socket)
            await driver.send("start")
            await driver.until_driven()
            await driver.send("save", strategy=1)
            await driver.until_phase("ready")
            await driver.send("start")
            await driver.until_driven()
            yield driver


def test_a_killed_server_loses_no_saved_episode(tmp_path):
    path = tmp_path / "demonstrations" / "inverted_double_pendulum.npz"

    async def scenario(process, address):
        async for _ in _save_one(address):
            process.send_signal(signal.SIGKILL)
            process.wait(SECONDS)

    with launched("inverted_double_pendulum", tmp_path) as (process, address):
        asyncio.run(scenario(process, address))
        assert process.returncode == -signal.SIGKILL
    assert len(load_demonstrations(path).trajectories) == 1


def test_an_interrupt_ends_the_server_cleanly(tmp_path):
    async def scenario(process, address):
        async for driver in _save_one(address):
            process.send_signal(signal.SIGINT)
            with pytest.raises(ConnectionError, match="1001"):
                await driver.until(lambda heard: False)

    with launched("inverted_double_pendulum", tmp_path) as (process, address):
        asyncio.run(scenario(process, address))
        assert process.wait(SECONDS) == 0
