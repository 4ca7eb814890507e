"""SCPI client over TCP."""

from __future__ import annotations

import time
from collections.abc import Callable

from analogrig import RigError
from analogrig.errors import RigRefused, RigTimeout
from analogrig.links import Clock
from analogrig_instruments.tcp_address import InstrumentSocket

_MOST_ANSWER_BYTES = 1 << 20


class ScpiConnection:
    """TCP connection that exchanges lines and blocks, each answer within a time-out."""

    def __init__(self, host: str, port: int, timeout_s: float, clock: Clock = time.monotonic) -> None:
        """:raises RigError: the connection failed."""
        self._clock = clock
        self._timeout_s = timeout_s
        self._input = bytearray()
        self._socket = InstrumentSocket(host, port, timeout_s)
        self.name = self._socket.name

    def send(self, *commands: str) -> None:
        """Send commands that have no answer, one a line."""
        lines = "".join(f"{command}\r\n" for command in commands)
        self._socket.send(lines.encode("ascii"), commands[0], self._timeout_s)

    def ask(self, query: str) -> str:
        """Send a query. Return the line of its answer, without its end."""
        self.send(query)
        return self.next_line(query)

    def next_line(self, query: str) -> str:
        """Next line of the answer to ``query``, without its end."""
        line = self._receive(lambda: self._input.find(b"\n") + 1 or None, query).rstrip(b"\r\n")
        return "".join(character if character.isprintable() else "?" for character in line.decode("ascii", "replace"))

    def ask_block(self, query: str) -> bytes:
        """Send a query. Return the content of the definite-length block (IEEE 488.2, 8.7.9) that answers it."""
        self.send(query)
        head = self._take(2, query)
        if head[:1] != b"#" or not head[1:].isdigit() or head == b"#0":
            raise RigError(f"instrument {self.name}: {query}: expected a block, received {head!r}")
        length = self._take(int(head[1:]), query)
        if not length.isdigit() or int(length) > _MOST_ANSWER_BYTES:
            raise RigError(f"instrument {self.name}: {query}: invalid block length {length!r}")
        content = self._take(int(length), query)
        self.next_line(query)
        return content

    def check(self, what: str) -> None:
        """:raises RigRefused: the error queue of the instrument is not empty."""
        answer = self.ask("SYST:ERR?")
        if not answer.startswith(("0,", "+0,", "0 ")) and answer != "0":
            self.send("*CLS")
            raise RigRefused(f"instrument {self.name}: {what}: error {answer[:120]}")

    def close(self) -> None:
        self._socket.close()

    def _take(self, count: int, query: str) -> bytes:
        return self._receive(lambda: count if len(self._input) >= count else None, query)

    def _receive(self, available: Callable[[], int | None], query: str) -> bytes:
        """Receive until ``available`` returns a number of bytes, at most for the time-out. Return and forget these."""
        deadline_s = self._clock() + self._timeout_s
        while (count := available()) is None:
            if len(self._input) > 2 * _MOST_ANSWER_BYTES:
                raise RigError(f"instrument {self.name}: {query}: the answer has no end")
            left_s = deadline_s - self._clock()
            if left_s <= 0.0:
                raise RigTimeout(f"instrument {self.name}: {query}: no whole answer within {self._timeout_s:g} s")
            try:
                self._input += self._socket.receive(65536, query, left_s)
            except TimeoutError as error:
                raise RigTimeout(f"instrument {self.name}: {query}: no answer within {self._timeout_s:g} s") from error
        taken = bytes(self._input[:count])
        del self._input[:count]
        return taken
