"""Server in this process: places, turns, and outputs that are switched off."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import socket
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from typing import Any

import numpy as np

from analogrig_instruments.simulator.acquisition_buffer import AcquisitionFaults
from analogrig_instruments.simulator.scpi import Call, Command, Response
from analogrig_instruments.simulator.served import InstrumentDescription, ServedRedPitaya
from analogrig_instruments.simulator.server import Servable, Server
from analogrig_instruments.simulator.tcp_server import BUFFERED_BYTES, MOST_CLIENTS
from tests.harness.processes import LONG_S
from tests.served.talk import SEQUENCE, front

DRIVE = "OUTPUT1:STATE ON"
LIVE = "OUTPUT1:STATE?"
LARGE_BYTES = 1_000_000


class Counter:
    """Instrument that counts its commands."""

    def __init__(self) -> None:
        self.count = 0
        self.live = False

    @property
    def commands(self) -> Mapping[str, tuple[int, Command]]:
        return {
            "COUNT": (0, self._raise),
            "COUNT?": (0, lambda _: str(self.count)),
            "LARGE?": (0, lambda _: bytes(LARGE_BYTES)),
        }

    def _raise(self, _: Call) -> Response:
        self.count += 1
        return None

    def silence(self) -> None:
        self.live = False


class Client:
    """Well-behaved client."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    def say(self, *lines: str) -> None:
        self.writer.write("".join(f"{line}\n" for line in lines).encode())

    async def ask(self, line: str) -> str:
        self.say(line)
        return (await self.reader.readline()).decode().removesuffix("\r\n")

    async def leave(self) -> None:
        self.writer.close()
        with contextlib.suppress(ConnectionError):
            await self.writer.wait_closed()


class Bench:
    """Server and its address."""

    def __init__(self, server: Server, port: int) -> None:
        self.server = server
        self.port = port
        self.clients: list[Client] = []

    async def client(self) -> Client:
        return self.add(*await asyncio.open_connection("127.0.0.1", self.port, limit=LARGE_BYTES))

    def add(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Client:
        self.clients.append(Client(reader, writer))
        return self.clients[-1]


@contextlib.asynccontextmanager
async def bench(instrument: Servable, **patience_s: float) -> AsyncIterator[Bench]:
    server = Server(instrument, **patience_s)
    _, port = await server.listen("127.0.0.1", 0)
    served = Bench(server, port)
    try:
        yield served
    finally:
        await server.close()
        for client in served.clients:
            await client.leave()


def red_pitaya(faults: AcquisitionFaults | None = None) -> ServedRedPitaya:
    description = InstrumentDescription(acquisition=faults or AcquisitionFaults())
    return ServedRedPitaya(front, np.random.default_rng(1), description)


def in_time(course: Callable[[], Coroutine[Any, Any, None]]) -> Callable[[], None]:
    """Test that runs ``course`` in an event loop, for a limited time."""

    @functools.wraps(course)
    def test() -> None:
        async def bounded() -> None:
            async with asyncio.timeout(LONG_S):
                await course()

        asyncio.run(bounded())

    return test


async def until(holds: Callable[[], bool]) -> None:
    """Await a state of the server; time out if it never comes."""
    while not holds():  # noqa: ASYNC110 - each turn of the loop is one
        await asyncio.sleep(0)


# ---- safe


@in_time
async def test_output_is_off_after_its_client_is_gone() -> None:
    instrument = red_pitaya()
    async with bench(instrument) as served:
        for goes in ("closes", "closes one way", "resets"):
            client, watcher = await served.client(), await served.client()
            client.say(*SEQUENCE)
            assert await client.ask(LIVE) == "ON" and instrument.live
            if goes == "closes":
                client.writer.close()
            elif goes == "closes one way":
                client.writer.write_eof()
            else:
                client.writer.transport.abort()
            await until(lambda: not instrument.live)
            assert await watcher.ask(LIVE) == "OFF"
            watcher.say("ACQ:START", "ACQ:TRig NOW", "ACQ:SOUR1:GAIN HV")
            force = await watcher.ask("ACQ:SOUR1:DATA:STA:N? 16000,1")
            assert abs(float(force.strip("{}"))) < 1e-2


@in_time
async def test_client_that_did_not_switch_the_output_on_does_not_switch_it_off() -> None:
    instrument = red_pitaya()
    async with bench(instrument) as served:
        driver, watcher = await served.client(), await served.client()
        driver.say(DRIVE)
        assert await driver.ask(LIVE) == "ON" and await watcher.ask(LIVE) == "ON"
        await watcher.leave()
        await until(lambda: len(served.server._clients) == 1)
        assert instrument.live
        await driver.leave()
        await until(lambda: not served.server._clients)
        assert not instrument.live


@in_time
async def test_closed_server_switches_the_output_off() -> None:
    instrument = red_pitaya()
    async with bench(instrument) as served:
        client = await served.client()
        client.say(DRIVE)
        assert await client.ask(LIVE) == "ON"
    assert not instrument.live


@in_time
async def test_closed_server_switches_off_an_output_that_was_on_before() -> None:
    counter = Counter()
    counter.live = True
    async with bench(counter):
        assert counter.live
    assert not counter.live


# ---- drop-outs


@in_time
async def test_instrument_that_hangs_up_has_sent_half_and_answers_the_next_client() -> None:
    async with bench(red_pitaya(AcquisitionFaults(drop_out="hang up"))) as served:
        client = await served.client()
        client.say(*SEQUENCE, "ACQ:SOUR1:DATA?")
        heard = await client.reader.read()
        assert heard.startswith(b"{9.8") and not heard.endswith(b"}\r\n")
        another = await served.client()
        whole = await another.ask("ACQ:SOUR1:DATA?")
        assert whole.endswith("}") and whole.startswith(heard.decode())
        assert await another.ask(LIVE) == "OFF"


@in_time
async def test_silent_instrument_reads_on_and_answers_nothing() -> None:
    async with bench(red_pitaya(AcquisitionFaults(drop_out="silence"))) as served:
        client, another = await served.client(), await served.client()
        client.say(*SEQUENCE, "ACQ:DATA:FORMAT BIN", "ACQ:SOUR1:DATA?")
        half = (len("#565536") + 65536) // 2
        await client.reader.readexactly(half)
        client.say("*IDN?")
        assert (await another.ask("*IDN?")).startswith("analogrig")
        assert await another.ask(LIVE) == "ON", "it has not gone"
        client.writer.write_eof()
        assert await client.reader.read() == b""
        assert await another.ask(LIVE) == "OFF"


# ---- turns and places


@in_time
async def test_long_line_of_one_client_does_not_delay_another() -> None:
    """A query is answered after a few commands, and not after all thousand."""
    counter = Counter()
    async with bench(counter) as served:
        busy, other = await served.client(), await served.client()
        assert await other.ask("COUNT?") == "0"
        busy.say(";".join(["COUNT"] * 600), *["COUNT"] * 400)
        await until(lambda: counter.count > 0)
        assert int(await other.ask("COUNT?")) < 200
        await until(lambda: counter.count == 1000)


@in_time
async def test_client_that_reads_nothing_is_dropped() -> None:
    async with bench(Counter(), slow_s=0.1) as served:
        deaf = await served.client()
        deaf.say(";".join(["LARGE?"] * 20))
        await until(lambda: len(served.server._clients) == 1)
        await until(lambda: not served.server._clients)


@in_time
async def test_client_that_reads_slowly_gets_the_whole_response() -> None:
    """The answer takes a second and a half, longer than the server waits for a client that reads nothing."""
    async with bench(Counter(), slow_s=1.0) as served:
        connection = socket.socket()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect(("127.0.0.1", served.port))
        slow = served.add(*await asyncio.open_connection(sock=connection, limit=4096))
        slow.say(";".join(["LARGE?"] * 4))
        heard = 0
        for _ in range(20):
            heard += len(await slow.reader.readexactly(50_000))
            await asyncio.sleep(0.075)
        await slow.reader.readexactly(4 * (LARGE_BYTES + len("#71000000")) + len(";;;\r\n") - heard)
        assert await slow.ask("COUNT?") == "0"


@in_time
async def test_server_buffers_at_most_one_unread_response() -> None:
    async with bench(Counter()) as served:
        deaf = await served.client()
        deaf.say(*["LARGE?"] * 100)
        transports = [client.writer.transport for client in served.server._clients.values()]
        while not transports or not any(transport.get_write_buffer_size() for transport in transports):
            await asyncio.sleep(0)
            transports = [client.writer.transport for client in served.server._clients.values()]
        for _ in range(1000):
            await asyncio.sleep(0)
            assert transports[0].get_write_buffer_size() <= LARGE_BYTES + BUFFERED_BYTES


@in_time
async def test_newcomer_is_turned_away_when_all_places_are_taken() -> None:
    async with bench(Counter()) as served:
        clients = [await served.client() for _ in range(MOST_CLIENTS)]
        for client in clients:
            assert await client.ask("COUNT?") == "0"
        newcomer = await served.client()
        newcomer.say("COUNT?")
        with contextlib.suppress(ConnectionError):
            assert await newcomer.reader.read() == b""
        assert await clients[0].ask("COUNT?") == "0"


@in_time
async def test_newcomer_replaces_the_longest_silent_client_unless_its_output_is_on() -> None:
    instrument = red_pitaya()
    async with bench(instrument, idle_s=0.0) as served:
        driver = await served.client()
        driver.say(DRIVE)
        assert await driver.ask(LIVE) == "ON"
        clients = [await served.client() for _ in range(MOST_CLIENTS - 1)]
        for client in clients:
            assert await client.ask("*OPC?") == "1"
        assert await clients[0].ask("*OPC?") == "1"
        newcomer = await served.client()
        assert await newcomer.ask("*OPC?") == "1"
        with contextlib.suppress(ConnectionError):
            assert await clients[1].reader.read() == b""
        assert await clients[0].ask("*OPC?") == "1" and await driver.ask(LIVE) == "ON"


@in_time
async def test_newcomers_that_come_together_replace_a_client_each() -> None:
    async with bench(Counter(), idle_s=0.0) as served:
        for client in [await served.client() for _ in range(MOST_CLIENTS)]:
            assert await client.ask("COUNT?") == "0"
        held = await asyncio.gather(*(served.client() for _ in range(4 * MOST_CLIENTS)))
        assert len(served.server._clients) <= MOST_CLIENTS
        assert await held[-1].ask("COUNT?") == "0"
        assert len(served.server._clients) <= MOST_CLIENTS


@in_time
async def test_connections_have_keepalive() -> None:
    """Within half a minute: 15 s of silence, three questions of 5 s."""
    async with bench(Counter()) as served:
        client = await served.client()
        assert await client.ask("COUNT?") == "0"
        (accepted,) = served.server._clients.values()
        connection = accepted.writer.get_extra_info("socket")
        assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        idle_s, every_s, times = (
            connection.getsockopt(socket.IPPROTO_TCP, option)
            for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        )
        assert idle_s + every_s * times <= 30


# ---- lines


@in_time
async def test_line_that_is_too_long_is_refused_and_the_next_is_executed() -> None:
    async with bench(Counter()) as served:
        client = await served.client()
        for length in (4096, 5000, 100_000):
            client.writer.write(b"X" * length + b"\nCOUNT\n")
            assert await client.ask("SYST:ERR?") == (
                '-363,"Input buffer overrun"' if length > 4096 else f'-113,"Undefined header;{"X" * 40}"'
            )
        assert await client.ask("COUNT?") == "3"


@in_time
async def test_queries_before_a_half_close_are_answered() -> None:
    """A half-closed connection, as `printf '*IDN?' | nc` makes it; an unfinished line is ignored."""
    async with bench(Counter()) as served:
        client = await served.client()
        client.say("COUNT", "LARGE?", "COUNT?")
        client.writer.write(b"COUNT?")
        client.writer.write_eof()
        heard = await client.reader.read()
        assert heard == b"#71000000" + bytes(LARGE_BYTES) + b"\r\n1\r\n"


@in_time
async def test_connections_share_the_state_but_not_the_error_queue() -> None:
    async with bench(Counter()) as served:
        one, other = await served.client(), await served.client()
        one.say("FOO", "COUNT")
        assert await one.ask("COUNT?") == "1"
        assert await other.ask("SYST:ERR?;:COUNT?") == '0,"No error";1'
        assert await one.ask("SYST:ERR?") == '-113,"Undefined header;FOO"'
