"""Base of the TCP servers of one instrument for many clients. It survives malformed input and slow clients.

Limits of a client:

    memory   a limited line or message, one unsent response, and the system's buffers of BUFFERED_BYTES
    place    one of MOST_CLIENTS from its first line or message on. It replaces the client that has been silent longest,
             at least IDLE_S, or is turned away. A client that the instrument works for keeps its place.
    wait     until then, one of MOST_WAITING; a newcomer replaces the one that has waited longest

A client that begins with a request line of HTTP is told what the port is, and disconnected: any web page can make a
browser send such a request, with commands in its body.

A client that reads nothing of a response for SLOW_S is dropped, and one whose machine does not respond after half a
minute (TCP keepalive).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import socket
from dataclasses import dataclass
from typing import Any

from analogrig import ConfigurationError
from analogrig_instruments.tcp_address import place_of

MOST_CLIENTS = 16
MOST_WAITING = 64
IDLE_S = 10.0
SLOW_S = 10.0
LINGER_S = 1.0
"""Time for a client of HTTP to take its answer, whose own data would otherwise reset the connection."""
BUFFERED_BYTES = 65_536
_METHODS = tuple(f"{name} ".encode() for name in "GET POST HEAD PUT DELETE OPTIONS PATCH CONNECT TRACE PRI".split())
_REQUEST = re.compile(rb"\S+\s+\S.*\sHTTP/\d", re.IGNORECASE | re.DOTALL)
_KEEPALIVE = ((socket.TCP_KEEPIDLE, 15), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))
"""Idle seconds, seconds between probes, probes."""

_log = logging.getLogger(__name__)


@dataclass(eq=False)
class Client:
    """Connection to a client."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    heard_s: float
    """Time of its last complete line or message."""

    is_admitted: bool = False
    """True once it has a place."""
    speaks_http: bool = False

    def hang_up(self) -> None:
        """Close the connection at once; unsent data is lost."""
        self.writer.transport.abort()


class TcpServer:
    """Base of the servers: places, time-outs and the end of connections."""

    most_read_bytes: int = BUFFERED_BYTES
    """Limit of the reader's buffer."""

    what: str = "an instrument"
    """Noun phrase that says what the port is."""

    def __init__(self, *, slow_s: float = SLOW_S, idle_s: float = IDLE_S) -> None:
        self.slow_s = slow_s
        self._idle_s = idle_s
        self._waiting: dict[asyncio.Task[None], Client] = {}
        """Clients that have not spoken yet, in order of their arrival."""
        self._clients: dict[asyncio.Task[None], Client] = {}
        self._server: asyncio.Server | None = None

    async def converse(self, client: Client) -> None:
        """Serve a client until it ends its input."""
        raise NotImplementedError

    def release(self, client: Client) -> None:
        """End what the instrument does for a client that is gone; may be called twice."""

    def keeps_place(self, client: Client) -> bool:
        """True if no newcomer may replace the client."""
        raise NotImplementedError

    def silence(self) -> None:
        """Leave the instrument safe: the server is closed."""

    async def listen(self, host: str, port: int) -> tuple[str, int]:
        """Listen. Return host and port; port 0 stands for any free one.

        :raises ConfigurationError: listening there failed, or the host is empty.
        """
        asyncio.get_running_loop().set_exception_handler(_note_failure)
        if not host:
            raise ConfigurationError("cannot listen: the host is empty: use 0.0.0.0 for all networks of this machine")
        try:
            self._server = await asyncio.start_server(self._accept, host, port, limit=self.most_read_bytes)
        except OSError as error:
            raise ConfigurationError(f"cannot listen at {place_of(host, port)}: {error.strerror or error}") from error
        for listening in self._server.sockets:  # accepted connections inherit the options
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFERED_BYTES)
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFERED_BYTES)
        address = self._server.sockets[0].getsockname()
        return str(address[0]), int(address[1])

    async def close(self) -> None:
        """Close all connections, and leave the instrument safe."""
        if self._server is not None:
            self._server.close()
        tasks = [*self._waiting, *self._clients]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self.silence()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client, task = Client(reader, writer, now_s()), asyncio.current_task()
        assert task is not None  # noqa: S101 - a coroutine runs in one
        if len(self._waiting) >= MOST_WAITING:
            self._waiting.pop(next(iter(self._waiting))).hang_up()
        self._waiting[task] = client
        try:
            _keep_alive(writer)
            await self.converse(client)
            self.release(client)
            if client.speaks_http:
                await _linger(client)
            client.writer.close()
            async with asyncio.timeout(self.slow_s):
                await client.writer.wait_closed()
        except (OSError, asyncio.CancelledError) as error:
            _log.info("client disconnected: %r", error)
        finally:
            self._waiting.pop(task, None)
            self._clients.pop(task, None)
            client.hang_up()
            self.release(client)

    def admit(self, client: Client, first: bytes) -> bool:
        """Give a client that has spoken a place. Return False if its conversation ends instead.

        :param first: its first line or message, or the start of it.
        """
        if client.is_admitted:
            return True
        task = asyncio.current_task()
        if is_http(first):
            client.speaks_http = True
            client.writer.write(f"HTTP/1.0 400 this port is {self.what}, not a web server\r\n".encode())
        elif task is not None and self._waiting.get(task) is client and self._make_place():
            self._clients[task] = self._waiting.pop(task)
            client.is_admitted = True
        return client.is_admitted

    def _make_place(self) -> bool:
        """Disconnect an idle client if all places are taken. Return True if there is a place for a newcomer."""
        if len(self._clients) < MOST_CLIENTS:
            return True
        silent = min(
            (task for task, client in self._clients.items() if not self.keeps_place(client)),
            key=lambda task: self._clients[task].heard_s,
        )
        if now_s() - self._clients[silent].heard_s < self._idle_s:
            return False
        self._clients.pop(silent).hang_up()  # at once, as its task ends only after other newcomers may have come
        return True

    async def drain(self, client: Client) -> None:
        """Wait until the client has read its response, or most of it.

        :raises TimeoutError: it reads nothing.
        """
        transport = client.writer.transport
        while True:
            left = transport.get_write_buffer_size()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self.slow_s):
                    await client.writer.drain()
                return
            if transport.get_write_buffer_size() >= left:
                raise TimeoutError("it reads nothing")


def is_http(first: bytes) -> bool:
    """True if a first line, or its start, is a request of HTTP."""
    return first.upper().startswith(_METHODS) or _REQUEST.match(first) is not None


def may_become_http(first: bytes) -> bool:
    """True if more bytes may make a request of HTTP of the first ones."""
    return any(method.startswith(first.upper()) for method in _METHODS)


def _note_failure(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Note the failure of a connection that nobody waits for any more; any other failure is shown as usual."""
    if isinstance(context.get("exception"), OSError):
        _log.info("client disconnected: %r", context["exception"])
    else:
        loop.default_exception_handler(context)


async def _linger(client: Client) -> None:
    """End the output, and discard the rest of a request: data left unread would reset the connection."""
    client.writer.write_eof()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LINGER_S):
            while await client.reader.read(BUFFERED_BYTES):
                pass


def now_s() -> float:
    """Time of the event loop."""
    return asyncio.get_running_loop().time()


def _keep_alive(writer: asyncio.StreamWriter) -> None:
    connection = writer.get_extra_info("socket")
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
