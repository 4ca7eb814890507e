"""TCP server of one instrument for many clients. Survives malformed input and slow clients.

Limits of a client:

    memory   a line of MOST_LINE_BYTES, one unsent response, and the system's buffers of BUFFERED_BYTES
    time     one command; then waiting clients have a turn
    place    one of MOST_CLIENTS. A newcomer replaces the client that has been silent longest, at least IDLE_S, or is
             turned away. The client that has switched the generator on keeps its place.

A client that reads nothing of a response for SLOW_S is dropped, and one whose machine does not respond after half a
minute (TCP keepalive). When the client that switched the generator on disconnects, the server switches it off.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from analogrig.errors import ConfigurationError
from analogrig.hardware.simulator.scpi import MOST_LINE_BYTES, Command, DropOut, Interpreter, ScpiError

MOST_CLIENTS = 16
IDLE_S = 10.0
SLOW_S = 10.0
BUFFERED_BYTES = 65_536
_KEEPALIVE = ((socket.TCP_KEEPIDLE, 15), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))
"""Idle seconds, seconds between probes, probes."""

_log = logging.getLogger(__name__)


class Servable(Protocol):
    """Instrument that can be served."""

    @property
    def commands(self) -> Mapping[str, tuple[int, Command]]:
        """Commands for an Interpreter."""

    @property
    def live(self) -> bool:
        """True if its output is on."""

    def silence(self) -> None:
        """Switch the output off."""


@dataclass
class _Client:
    """Connection to a client."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    heard_s: float
    """Time of its last complete line."""

    def hang_up(self) -> None:
        """Close the connection at once; unsent data is lost."""
        self.writer.transport.abort()


class Server:
    """Server of one instrument; every connection has its own error queue."""

    def __init__(self, instrument: Servable, *, slow_s: float = SLOW_S, idle_s: float = IDLE_S) -> None:
        self._instrument = instrument
        self._slow_s = slow_s
        self._idle_s = idle_s
        self._clients: dict[asyncio.Task[None], _Client] = {}
        self._responsible: _Client | None = None
        self._server: asyncio.Server | None = None

    async def listen(self, host: str, port: int) -> tuple[str, int]:
        """Listen. Return host and port; port 0 stands for any free one.

        :raises ConfigurationError: listening there failed, or the host is empty.
        """
        if not host:
            raise ConfigurationError("cannot listen: the host is empty: use 0.0.0.0 for all networks of this machine")
        try:
            self._server = await asyncio.start_server(self._accept, host, port, limit=MOST_LINE_BYTES)
        except OSError as error:
            raise ConfigurationError(f"cannot listen at {host}:{port}: {error.strerror or error}") from error
        for listening in self._server.sockets:  # accepted connections inherit the options
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFERED_BYTES)
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFERED_BYTES)
        address = self._server.sockets[0].getsockname()
        return str(address[0]), int(address[1])

    async def close(self) -> None:
        """Close all connections, and switch the output off."""
        if self._server is not None:
            self._server.close()
        for task in self._clients:
            task.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)
        self._instrument.silence()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client, task = _Client(reader, writer, _now_s()), asyncio.current_task()
        if task is None or not self._make_place():
            client.hang_up()
            return
        self._clients[task] = client
        try:
            _keep_alive(writer)
            await self._serve(client)
        except (OSError, TimeoutError, asyncio.CancelledError) as error:
            _log.info("client disconnected: %r", error)
        finally:
            del self._clients[task]
            client.hang_up()
            self._release(client)

    def _release(self, client: _Client) -> None:
        """Switch the output off if this client, which is gone, is responsible for it."""
        if client is self._responsible:
            self._responsible = None
            self._instrument.silence()

    def _make_place(self) -> bool:
        """Disconnect an idle client if all places are taken. Return True if there is a place for a newcomer."""
        if len(self._clients) < MOST_CLIENTS:
            return True
        silent = min(
            (client for client in self._clients.values() if client is not self._responsible),
            key=lambda client: client.heard_s,
        )
        if _now_s() - silent.heard_s < self._idle_s:
            return False
        silent.hang_up()
        return True

    async def _serve(self, client: _Client) -> None:
        interpreter = Interpreter(self._instrument.commands)
        while (line := await _read_line(client.reader, interpreter)) is not None:
            client.heard_s = _now_s()
            try:
                await self._execute(client, interpreter, line)
            except DropOut as drop_out:
                if not drop_out.hangs_up:
                    await _discard(client.reader)
                break
        self._release(client)
        client.writer.close()
        async with asyncio.timeout(self._slow_s):
            await client.writer.wait_closed()

    async def _execute(self, client: _Client, interpreter: Interpreter, line: bytes) -> None:
        """Execute the commands of a line; between two of them other clients have a turn."""
        was_live = self._instrument.live
        for part in interpreter.enter(line):
            if self._instrument.live and not was_live:
                self._responsible = client
            if part:
                client.writer.write(part)
                await self._drain(client)
            await asyncio.sleep(0)
            was_live = self._instrument.live

    async def _drain(self, client: _Client) -> None:
        """Wait until the client has read its response, or most of it.

        :raises TimeoutError: it reads nothing.
        """
        transport = client.writer.transport
        while True:
            left = transport.get_write_buffer_size()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._slow_s):
                    await client.writer.drain()
                return
            if transport.get_write_buffer_size() >= left:
                raise TimeoutError("it reads nothing")


def _now_s() -> float:
    return asyncio.get_running_loop().time()


async def _read_line(reader: asyncio.StreamReader, interpreter: Interpreter) -> bytes | None:
    """Next line without its end; None at the end of input. A line that is too long is refused."""
    for too_long in itertools.count():
        try:
            line = await reader.readuntil(b"\n")
        except asyncio.IncompleteReadError:
            return None
        except asyncio.LimitOverrunError as error:
            await reader.readexactly(error.consumed)
        else:
            if not too_long:
                return line.rstrip(b"\r\n")
            interpreter.refuse(ScpiError(-363))
            return b""
    return None


async def _discard(reader: asyncio.StreamReader) -> None:
    """Discard input until the client disconnects."""
    while await reader.read(MOST_LINE_BYTES):
        pass


def _keep_alive(writer: asyncio.StreamWriter) -> None:
    connection = writer.get_extra_info("socket")
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
