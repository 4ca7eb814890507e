"""SCPI server of one instrument; a line has at most MOST_LINE_BYTES, and after a command waiting clients have a turn.

When the client that switched the generator on disconnects, the server switches it off.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Protocol

from analogrig_instruments.simulator.scpi import MOST_LINE_BYTES, Command, DropOut, Interpreter, ScpiError
from analogrig_instruments.simulator.tcp_server import IDLE_S, SLOW_S, Client, TcpServer, now_s


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
    what = "an emulated Red Pitaya of analogrig serve, which speaks SCPI"

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
        while (line := await _read_line(client.reader)) is not None:
            if not line.strip():
                continue
            if not self.admit(client, line):
                break
            client.heard_s = now_s()
            if len(line) > MOST_LINE_BYTES:
                interpreter.refuse(ScpiError(-363))
                continue
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


async def _read_line(reader: asyncio.StreamReader) -> bytes | None:
    """Next line without its end; None at the end of input. Of a line that is too long, a start that is too long."""
    start = b""
    while True:
        try:
            line = await reader.readuntil(b"\n")
        except asyncio.IncompleteReadError:
            return None
        except asyncio.LimitOverrunError as error:
            part = await reader.readexactly(error.consumed)
            start = start if len(start) > MOST_LINE_BYTES else start + part
        else:
            return start + line if start else line.rstrip(b"\r\n")


async def _discard(reader: asyncio.StreamReader) -> None:
    """Discard input until the client disconnects."""
    while await reader.read(MOST_LINE_BYTES):
        pass
