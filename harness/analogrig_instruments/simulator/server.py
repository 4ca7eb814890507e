"""SCPI server of one instrument; a line has at most MOST_LINE_BYTES, and after a command waiting clients have a turn.

When the client that switched the generator on disconnects, the server switches it off.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Mapping
from typing import Protocol

from analogrig.hardware.simulator.scpi import MOST_LINE_BYTES, Command, DropOut, Interpreter, ScpiError
from analogrig.hardware.simulator.tcp_server import IDLE_S, SLOW_S, Client, TcpServer, now_s


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


class Server(TcpServer):
    """Server of one instrument; every connection has its own error queue."""

    most_read_bytes = MOST_LINE_BYTES

    def __init__(self, instrument: Servable, *, slow_s: float = SLOW_S, idle_s: float = IDLE_S) -> None:
        super().__init__(slow_s=slow_s, idle_s=idle_s)
        self._instrument = instrument
        self._responsible: Client | None = None

    def silence(self) -> None:
        self._instrument.silence()

    def release(self, client: Client) -> None:
        """Switch the output off if this client, which is gone, is responsible for it."""
        if client is self._responsible:
            self._responsible = None
            self._instrument.silence()

    def keeps_place(self, client: Client) -> bool:
        return client is self._responsible

    async def converse(self, client: Client) -> None:
        interpreter = Interpreter(self._instrument.commands)
        while (line := await _read_line(client.reader, interpreter)) is not None:
            client.heard_s = now_s()
            try:
                await self._execute(client, interpreter, line)
            except DropOut as drop_out:
                if not drop_out.hangs_up:
                    await _discard(client.reader)
                break

    async def _execute(self, client: Client, interpreter: Interpreter, line: bytes) -> None:
        """Execute the commands of a line; between two of them other clients have a turn."""
        was_live = self._instrument.live
        for part in interpreter.enter(line):
            if self._instrument.live and not was_live:
                self._responsible = client
            if part:
                client.writer.write(part)
                await self.drain(client)
            await asyncio.sleep(0)
            was_live = self._instrument.live


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
