"""The instrument on a TCP port: many clients, one instrument; whatever they send or fail to take, it goes on.

A client may cost so much and no more:

    memory   a line of MOST_LINE_BYTES, one answer that it has not taken, and what the system buffers, BUFFERED_BYTES
    time     one command, then whoever else waits has a turn
    a place  of MOST_CLIENTS; when all are taken, a newcomer gets that of the client that has been silent for longest,
             IDLE_S at least, and is turned away if there is none. Who has the generator running keeps its place.

A client that takes nothing of an answer for SLOW_S is dropped, and one whose machine does not answer any more after
half a minute (TCP keepalive). Whoever switched the generator on is responsible for it: when that client is gone, for
whatever reason, the generator is off.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import socket
from collections.abc import Mapping
from typing import Protocol

from analogrig.errors import ConfigurationError
from analogrig.hardware.simulator.scpi import MOST_LINE_BYTES, Command, DropOut, Interpreter, ScpiError

MOST_CLIENTS = 16
IDLE_S = 10.0
SLOW_S = 10.0
BUFFERED_BYTES = 65_536
_KEEPALIVE = ((socket.TCP_KEEPIDLE, 15), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))
"""Seconds of silence, seconds between questions, questions."""

_log = logging.getLogger(__name__)


class Servable(Protocol):
    """What can be served."""

    @property
    def commands(self) -> Mapping[str, tuple[int, Command]]:
        """As an Interpreter takes them."""

    @property
    def live(self) -> bool:
        """Whether it drives the bench."""

    def silence(self) -> None:
        """Leave the bench safe."""


class _Client:
    """A connection."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer
        self.heard_s = asyncio.get_running_loop().time()
        """When it last said a whole line."""

    def hang_up(self) -> None:
        """At once; what it has not taken is lost."""
        self.writer.transport.abort()

    def note(self) -> None:
        self.heard_s = asyncio.get_running_loop().time()


class Server:
    """Serves one instrument; every connection has its own queue of errors."""

    def __init__(self, instrument: Servable, *, slow_s: float = SLOW_S, idle_s: float = IDLE_S) -> None:
        self._instrument = instrument
        self._slow_s = slow_s
        self._idle_s = idle_s
        self._clients: dict[asyncio.Task[None], _Client] = {}
        self._responsible: _Client | None = None
        self._server: asyncio.Server | None = None

    async def listen(self, host: str, port: int) -> tuple[str, int]:
        """Begin to listen; returns where. Port 0: any that is free.

        :raises ConfigurationError: there one cannot listen; nowhere is not everywhere.
        """
        if not host:
            raise ConfigurationError("cannot listen: the host is empty; say 0.0.0.0 for every network of this machine")
        try:
            self._server = await asyncio.start_server(self._accept, host, port, limit=MOST_LINE_BYTES)
        except OSError as error:
            raise ConfigurationError(f"cannot listen at {host}:{port}: {error.strerror or error}") from error
        for listening in self._server.sockets:  # what it accepts inherits them
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFERED_BYTES)
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFERED_BYTES)
        address = self._server.sockets[0].getsockname()
        return str(address[0]), int(address[1])

    async def close(self) -> None:
        """Listen no more, hang up, and leave the bench safe."""
        if self._server is not None:
            self._server.close()
        for task in self._clients:
            task.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)
        self._instrument.silence()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client, task = _Client(reader, writer), asyncio.current_task()
        if task is None or not self._has_place():
            client.hang_up()
            return
        self._clients[task] = client
        try:
            _keep_alive(writer)
            await self._serve(client)
        except (OSError, TimeoutError, asyncio.CancelledError) as error:
            _log.info("a client is gone: %r", error)
        finally:
            del self._clients[task]
            client.hang_up()
            self._release(client)

    def _release(self, client: _Client) -> None:
        """It is gone."""
        if client is self._responsible:
            self._responsible = None
            self._instrument.silence()

    def _has_place(self) -> bool:
        """Whether there is one for a newcomer, perhaps by hanging up on somebody else."""
        if len(self._clients) < MOST_CLIENTS:
            return True
        silent = min(
            (client for client in self._clients.values() if client is not self._responsible),
            key=lambda client: client.heard_s,
        )
        if asyncio.get_running_loop().time() - silent.heard_s < self._idle_s:
            return False
        silent.hang_up()
        return True

    async def _serve(self, client: _Client) -> None:
        interpreter = Interpreter(self._instrument.commands)
        while (line := await _line(client.reader, interpreter)) is not None:
            client.note()
            try:
                await self._obey(client, interpreter, line)
            except DropOut as drop_out:
                if not drop_out.hangs_up:
                    await _ignore(client.reader)
                break
        self._release(client)
        client.writer.close()
        async with asyncio.timeout(self._slow_s):
            await client.writer.wait_closed()

    async def _obey(self, client: _Client, interpreter: Interpreter, line: bytes) -> None:
        """One command after the other; between two of them others have their turn."""
        was_live = self._instrument.live
        for part in interpreter.enter(line):
            if self._instrument.live and not was_live:
                self._responsible = client
            if part:
                client.writer.write(part)
                await self._taken(client)
            await asyncio.sleep(0)
            was_live = self._instrument.live

    async def _taken(self, client: _Client) -> None:
        """Wait until the client has taken its answer, or most of it.

        :raises TimeoutError: it takes nothing.
        """
        transport = client.writer.transport
        while True:
            left = transport.get_write_buffer_size()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._slow_s):
                    await client.writer.drain()
                return
            if transport.get_write_buffer_size() >= left:
                raise TimeoutError("it takes nothing")


async def _line(reader: asyncio.StreamReader, interpreter: Interpreter) -> bytes | None:
    """The next line without its end; None when there is none. One that is too long is refused."""
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


async def _ignore(reader: asyncio.StreamReader) -> None:
    """Until the client is gone."""
    while await reader.read(MOST_LINE_BYTES):
        pass


def _keep_alive(writer: asyncio.StreamWriter) -> None:
    connection = writer.get_extra_info("socket")
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
