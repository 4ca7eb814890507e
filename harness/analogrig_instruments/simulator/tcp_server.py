"""Base of the TCP servers of one instrument for many clients. It survives malformed input and slow clients.

Limits of a client:

    memory   a limited line or message, one unsent response, and the system's buffers of BUFFERED_BYTES
    place    one of MOST_CLIENTS. A newcomer replaces the client that has been silent longest, at least IDLE_S, or is
             turned away. A client that the instrument works for keeps its place.

A client that reads nothing of a response for SLOW_S is dropped, and one whose machine does not respond after half a
minute (TCP keepalive).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from dataclasses import dataclass

from analogrig.errors import ConfigurationError
from analogrig.hardware.tcp_address import place_of

MOST_CLIENTS = 16
IDLE_S = 10.0
SLOW_S = 10.0
BUFFERED_BYTES = 65_536
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

    def hang_up(self) -> None:
        """Close the connection at once; unsent data is lost."""
        self.writer.transport.abort()


class TcpServer:
    """Base of the servers: places, time-outs and the end of connections."""

    most_read_bytes: int = BUFFERED_BYTES
    """Limit of the reader's buffer."""

    def __init__(self, *, slow_s: float = SLOW_S, idle_s: float = IDLE_S) -> None:
        self.slow_s = slow_s
        self._idle_s = idle_s
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
        for task in self._clients:
            task.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)
        self.silence()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client, task = Client(reader, writer, now_s()), asyncio.current_task()
        if task is None or not self._make_place():
            client.hang_up()
            return
        self._clients[task] = client
        try:
            _keep_alive(writer)
            await self.converse(client)
            self.release(client)
            client.writer.close()
            async with asyncio.timeout(self.slow_s):
                await client.writer.wait_closed()
        except (OSError, asyncio.CancelledError) as error:
            _log.info("client disconnected: %r", error)
        finally:
            self._clients.pop(task, None)
            client.hang_up()
            self.release(client)

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


def now_s() -> float:
    """Time of the event loop."""
    return asyncio.get_running_loop().time()


def _keep_alive(writer: asyncio.StreamWriter) -> None:
    connection = writer.get_extra_info("socket")
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
