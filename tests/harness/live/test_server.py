"""Server of a live bench: who gets in, who drives, and what hostile or slow clients can do."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus
from websockets.http11 import USER_AGENT

from analogrig.errors import ConfigurationError
from analogrig.run import Run
from analogrig_live.bench_server import MOST_CLIENTS, MOST_MESSAGE_BYTES, MOST_SOCKETS, BenchServer
from analogrig_live.foxglove import SUBPROTOCOL
from analogrig_live.scope import unpacked
from tests.harness.live.benches import LiveBench

TIMEOUT_S = 600.0  # only if something is broken, also under a load of ten
TRIGGER = {"source": "force", "level": 5.0}


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[BenchServer]:
    with LiveBench(tmp_path) as server:
        yield server


def host_of(server: BenchServer) -> str:
    return urlsplit(server.address).netloc


class Client:
    """Client of the page's endpoint."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.state: dict[str, Any] = {}
        self._number = 0

    async def ask(self, name: str, /, **table: Any) -> str:
        """Send a message and return the error of its answer; empty if there is none."""
        self._number += 1
        await self.socket.send(json.dumps({"do": name, "id": self._number, **table}))
        async for message in self.socket:
            answer = json.loads(message) if isinstance(message, str) else {}
            self.state = answer.get("state", self.state)
            if answer.get("re") == self._number:
                return str(answer.get("error", ""))
        raise AssertionError("the connection has closed")

    async def until(self, holds: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """State for which something holds."""
        while not (self.state and holds(self.state)):
            message = await self.socket.recv()
            self.state = (json.loads(message) if isinstance(message, str) else {}).get("state", self.state)
        return self.state

    async def frame(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Next frame with a picture."""
        while True:
            message = await self.socket.recv()
            if isinstance(message, bytes):
                header, values = unpacked(message)
                if "waiting" not in header:
                    return header, dict(values)


def open_client(server: BenchServer, path: str = "/live", **more: Any) -> Any:
    """Connection to an endpoint, with the token and the origin of the page unless ``more`` has others."""
    token = more.pop("token", server.token)
    more.setdefault("subprotocols", [SUBPROTOCOL] if path == "/foxglove" else None)
    more.setdefault("origin", f"http://{host_of(server)}")
    if "named" in more:  # the host of the URL, as a browser that was led here by another name sends it
        address, _, port = host_of(server).rpartition(":")
        return connect(f"ws://{more.pop('named')}{path}?token={token}", host=address, port=int(port), **more)
    return connect(f"ws://{host_of(server)}{path}?token={token}", **more)


def played(work: Callable[[], Awaitable[Any]]) -> Any:
    async def bounded() -> Any:
        async with asyncio.timeout(TIMEOUT_S):
            return await work()

    return asyncio.run(bounded())


def status_of(url: str, **headers: str) -> int:
    try:
        request = urllib.request.Request(url, headers=headers)  # noqa: S310 - the address of our own server
        with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:  # noqa: S310
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_page_needs_the_token_and_a_host_of_this_server(bench: BenchServer) -> None:
    base = f"http://{host_of(bench)}"
    assert status_of(bench.address) == 200
    assert status_of(f"{base}/?token={bench.token}x") == 403
    assert status_of(base) == 403
    assert status_of(f"{base}/etc/passwd?token={bench.token}") == 404
    assert status_of(bench.address, Host="evil.example") == 403
    assert status_of(f"{base}//[") == 400


@pytest.mark.parametrize("path", ["/live", "/foxglove"])
@pytest.mark.parametrize(
    "wrong",
    [
        {"token": "no"},
        {"token": ""},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"named": "evil.example"},
    ],
    ids=str,
)
def test_socket_needs_token_host_and_origin(bench: BenchServer, path: str, wrong: dict[str, Any]) -> None:
    async def work() -> int:
        with pytest.raises(InvalidStatus) as refused:
            async with open_client(bench, path, **wrong):
                pass
        return int(refused.value.response.status_code)

    assert played(work) == 403
    assert not bench._clients


def test_endpoint_of_viewers_needs_their_subprotocol(bench: BenchServer) -> None:
    async def work() -> int:
        with pytest.raises(InvalidStatus) as refused:
            async with open_client(bench, "/foxglove", subprotocols=None):
                pass
        return int(refused.value.response.status_code)

    assert played(work) == 400


@pytest.mark.parametrize("origin", ["", "junk", "http://", "http://a/path", "http://a b", "//a"])
def test_origin_that_no_browser_sends_is_refused(bench: BenchServer, origin: str) -> None:
    with pytest.raises(ConfigurationError, match="expected one such as"):
        BenchServer(bench.session, origins=[origin])


def test_endpoint_of_the_page_needs_an_origin(bench: BenchServer) -> None:
    async def work() -> None:
        with pytest.raises(InvalidStatus):
            async with open_client(bench, origin=None, user_agent_header=USER_AGENT):
                pass

    played(work)


def test_first_client_drives_and_others_watch(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_client(bench) as one, open_client(bench) as two:
            driver, watcher = Client(one), Client(two)
            assert await driver.ask("turn", name="K", value=18000.0) == ""
            assert "watches" in await watcher.ask("turn", name="K", value=20000.0)
            assert "another client drives" in await watcher.ask("drive")
            assert "unknown key 'fast'" in await watcher.ask("drive", fast=True)
            assert await watcher.ask("view", signals=["U1"], trigger=TRIGGER, samples=100) == ""
            state = await watcher.until(lambda state: state["values"]["K"] == 18000.0)
            assert not state["drives"]
            header, _ = await watcher.frame()
            assert header["signals"] == ["U1"]

    played(work)


def test_generator_is_off_when_the_driver_is_gone_and_the_recording_is_saved(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_client(bench) as two:
            async with open_client(bench) as one:
                watcher = Client(one)
                await watcher.until(lambda state: not state["drives"])
            driver = Client(two)
            assert await driver.ask("record", on=True) == ""
            await driver.until(lambda state: state["take"] == 2 and state["samples"] > 2000)
        async with open_client(bench) as three:
            state = await Client(three).until(lambda state: not state["generator"]["on"] and state["saved"])
            assert state["drives"]
            assert Run.load(Path(state["saved"][0]["run"])).samples > 2000

    played(work)


def test_limits_of_the_rig_hold_whatever_a_client_sends(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_client(bench) as socket:
            client = Client(socket)
            assert "K must be" in await client.ask("turn", name="K", value=1e12)
            assert "must be a number" in await client.ask("turn", name="K", value="1")
            assert "high_v" in await client.ask("generate", low_v=20.0, high_v=10.0)
            assert "no signal is called" in await client.ask("view", signals=["secret"], trigger=TRIGGER)
            assert "samples must be" in await client.ask("view", signals=["U1"], trigger=TRIGGER, samples=10**9)
            assert "no command is called" in await client.ask("__class__")

    played(work)
    assert bench.session.values == bench.session.desk.scenario.plant.parameters()


HOSTILE = (
    b"\x00" * 100,
    "",
    "null",
    "[]",
    '"do"',
    "{",
    "[" * 5000,
    '{"do": {}}',
    '{"do": "turn", "name": [], "value": {}}',
    '{"do": "turn", "name": "K", "value": NaN}',
    '{"do": "view", "signals": [], "trigger": 1}',
    '{"do": "step", "samples": 1e99}',
    '{"do": "tempo", "factor": -1}',
    '{"id": {"a": [1]}, "do": "x"}',
)


def test_wrong_messages_are_answered_and_the_driver_is_unharmed(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_client(bench) as one:
            driver = Client(one)
            await driver.until(lambda state: state["drives"])
            async with open_client(bench) as two, open_client(bench, "/foxglove") as three:
                for message in HOSTILE:
                    await two.send(message)
                    await three.send(message)
                errors = 0
                while errors < len(HOSTILE):
                    answer = await two.recv()
                    errors += isinstance(answer, str) and "error" in json.loads(answer)
                statuses = 0
                while statuses < len(HOSTILE):
                    answer = await three.recv()
                    statuses += isinstance(answer, str) and json.loads(answer)["op"] == "status"
                for socket in (two, three):
                    await socket.send("x" * (MOST_MESSAGE_BYTES + 1))
                    await socket.wait_closed()
                    assert socket.close_code == 1009
            assert await driver.ask("turn", name="K", value=18000.0) == ""
            await driver.until(lambda state: state["values"]["K"] == 18000.0)

    played(work)


def test_client_that_takes_nothing_is_dropped_and_holds_up_nobody(tmp_path: Path) -> None:
    async def work(bench: BenchServer) -> None:
        async with open_client(bench) as one:
            driver = Client(one)
            await driver.ask("view", signals=["force"], trigger=TRIGGER)
            small = socket.socket()
            small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            small.connect(("127.0.0.1", int(host_of(bench).rpartition(":")[2])))
            async with open_client(bench, max_queue=1, sock=small) as two:
                view = {"signals": ["U1", "U2", "U3", "U4"], "trigger": TRIGGER, "columns": 4000, "samples": 60000}
                await two.send(json.dumps({"do": "view", **view}))
                two.transport.pause_reading()
                await driver.until(lambda state: state["clients"] == 1 and state["samples"] > 30_000)
                frames = [await driver.frame() for _ in range(3)]
                assert frames[-1][0]["end"] > frames[0][0]["end"]
                two.transport.abort()

    with LiveBench(tmp_path, slow_s=0.5) as bench:
        played(lambda: work(bench))


def test_driver_that_answers_no_ping_is_gone_and_the_generator_off(tmp_path: Path) -> None:
    async def work(bench: BenchServer) -> None:
        frozen = await open_client(bench).__aenter__()
        frozen.transport.pause_reading()
        async with open_client(bench) as second:
            client = Client(second)
            await client.until(lambda state: not state["driven"] and not state["generator"]["on"])
        frozen.transport.abort()

    with LiveBench(tmp_path, silent_s=0.5) as bench:
        played(lambda: work(bench))


def test_work_for_watchers_leaves_as_much_time_for_the_driver(bench: BenchServer) -> None:
    spans_s: list[tuple[float, float]] = []

    async def work() -> None:
        async with bench._share_work():
            began_s = time.monotonic()
            sum(range(100_000))
            spans_s.append((began_s, time.monotonic()))

    async def work_at_once() -> None:
        await asyncio.gather(*(work() for _ in range(4)))

    played(work_at_once)
    for (began_s, ended_s), (next_s, _) in itertools.pairwise(spans_s):
        assert next_s - ended_s >= 0.9 * (ended_s - began_s)  # the clock of the loop is coarser


def test_newcomers_are_turned_away_when_all_places_are_taken(bench: BenchServer) -> None:
    async def work() -> None:
        opening = [open_client(bench).__aenter__() for _ in range(MOST_CLIENTS + 4)]
        clients = await asyncio.gather(*opening, return_exceptions=True)
        refused = [each for each in clients if isinstance(each, InvalidStatus)]
        assert [each.response.status_code for each in refused] == [503] * 4
        await asyncio.gather(*(each.close() for each in clients if isinstance(each, ClientConnection)))
        while True:  # a place is free as soon as the server has seen the end
            with contextlib.suppress(InvalidStatus):
                async with open_client(bench) as newcomer:
                    await Client(newcomer).until(lambda state: state["drives"])
                    return

    played(work)


def test_sockets_without_a_request_are_limited_and_the_oldest_gives_way(bench: BenchServer) -> None:
    host, _, port = host_of(bench).rpartition(":")
    with contextlib.ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection((host, int(port)))) for _ in range(MOST_SOCKETS + 1)]
        with contextlib.suppress(ConnectionError):
            assert silent[0].recv(1) == b""
        silent[-1].settimeout(0.0)
        with pytest.raises(BlockingIOError):
            silent[-1].recv(1)
        assert status_of(bench.address) == 200


def test_token_of_any_characters_opens_the_printed_address(tmp_path: Path) -> None:
    with LiveBench(tmp_path, token="a+b%&# c") as server:  # noqa: S106
        assert status_of(server.address) == 200


@pytest.mark.parametrize(
    ("host", "words"),
    [("", "name the one"), ("0.0.0.0", "name the one"), ("::", "name the one"), ("x" * 300, "cannot listen")],  # noqa: S104
)
def test_address_that_cannot_be_opened_is_refused(host: str, words: str, bench: BenchServer) -> None:
    other = BenchServer(bench.session)
    with pytest.raises(ConfigurationError, match=words):
        asyncio.run(other.listen(host))


def test_frames_hold_what_the_card_has_seen(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_client(bench) as socket:
            client = Client(socket)
            await client.ask("view", signals=["force"], samples=400, trigger=TRIGGER | {"mode": "normal"})
            header, values = await client.frame()
            force = values["force"]
            trigger = header["trigger"] - header["first"]
            assert trigger == pytest.approx(100, abs=2)
            assert force[int(trigger)] < 5.0 < force[int(trigger) + 2]
            assert header["measures"]["force"]["frequency"] == pytest.approx(200.0, rel=0.01)
            assert np.ptp(force) == pytest.approx(9.8, abs=0.1)
            await client.ask("view", signals=["force"], trigger=TRIGGER, samples=20000, columns=100)
            header, values = await client.frame()
            while header["samples"] < 20000:
                header, values = await client.frame()
            assert len(values["force"]) == header["points"] == 200
            assert np.ptp(values["force"]) == pytest.approx(9.8, abs=0.1)

    played(work)


def test_single_trigger_shows_one_screen_until_it_is_armed_again(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_client(bench) as socket:
            client = Client(socket)
            trigger = TRIGGER | {"mode": "single"}
            await client.ask("view", signals=["force"], samples=100, trigger=trigger)
            header, _ = await client.frame()
            seen = client.state.get("samples", 0)
            frames = 0
            while client.state.get("samples", 0) < seen + 5000:
                message = await socket.recv()
                if isinstance(message, bytes):
                    frames += 1
                else:
                    client.state = json.loads(message).get("state", client.state)
            assert frames == 0
            await client.ask("view", signals=["force"], samples=100, trigger=trigger, arm=1)
            again, _ = await client.frame()
            assert again["trigger"] > header["trigger"]

    played(work)
