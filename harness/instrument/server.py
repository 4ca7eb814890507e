"""The instrument on a TCP port: many clients, one instrument; whatever they send or fail to take, it goes on.

What a client may cost is bounded: a line of MOST_LINE_BYTES, answers that it has not taken (a line is read only when those
before it have gone out, or the client is dropped after SLOW_S), and MOST_CLIENTS of them.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable

from harness.errors import ConfigurationError
from harness.instrument.scpi import MOST_LINE_BYTES, Command, Interpreter, ScpiError

MOST_CLIENTS = 16
SLOW_S = 10.0
"""A client that takes nothing of its answer for so long is dropped."""

_log = logging.getLogger(__name__)


class Server:
    """Serves one table of commands; every connection has its own queue of errors."""

    def __init__(self, commands: dict[str, Command], *, left: Callable[[], None], slow_s: float = SLOW_S) -> None:
        """``left`` is called when the last client has gone: nobody watches the bench any more."""
        self._commands = commands
        self._left = left
        self._slow_s = slow_s
        self._clients: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None

    async def listen(self, host: str, port: int) -> tuple[str, int]:
        """Begin to listen; returns where. Port 0: any that is free.

        :raises ConfigurationError: there one cannot listen.
        """
        try:
            self._server = await asyncio.start_server(self._accept, host, port, limit=MOST_LINE_BYTES)
        except OSError as error:
            raise ConfigurationError(f"cannot listen at {host}:{port}: {error.strerror or error}") from error
        address = self._server.sockets[0].getsockname()
        return str(address[0]), int(address[1])

    async def close(self) -> None:
        """Listen no more, and hang up."""
        if self._server is not None:
            self._server.close()
        for client in tuple(self._clients):
            client.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is None or len(self._clients) >= MOST_CLIENTS:
            writer.close()
            return
        self._clients.add(task)
        try:
            await self._serve(reader, writer)
        except (ConnectionError, TimeoutError, asyncio.CancelledError) as error:
            _log.info("a client is gone: %r", error)
        finally:
            self._clients.discard(task)
            writer.transport.abort()
            if not self._clients:
                self._left()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        interpreter = Interpreter(self._commands)
        while True:
            try:
                line = await reader.readuntil(b"\n")
            except asyncio.IncompleteReadError:
                return
            except asyncio.LimitOverrunError:
                await _skip_line(reader)
                interpreter.refuse(ScpiError(-363, "Input buffer overrun"))
                continue
            response = interpreter.enter(line.rstrip(b"\r\n"))
            if response:
                writer.write(response)
                async with asyncio.timeout(self._slow_s):
                    await writer.drain()


async def _skip_line(reader: asyncio.StreamReader) -> None:
    """To its end, however long it is."""
    while True:
        try:
            await reader.readuntil(b"\n")
        except asyncio.LimitOverrunError as error:
            with contextlib.suppress(asyncio.IncompleteReadError):
                await reader.readexactly(error.consumed or 1)
        else:
            return
