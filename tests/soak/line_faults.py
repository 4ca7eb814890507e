"""Faults of a line of text, each at each step, against a scripted firmware on a real pseudo-terminal.

python -m tests.soak.line_faults enumerates all of them and prints a table.

The firmware runs when the harness reads or writes, in the same thread, and the clock stands still but for time-outs.
So nothing depends on the speed of the machine. The estimate a1 is the sample's own u, which shows to which sample an
answer was assigned.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import tty
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from analogrig.answers import Answers, Samples
from analogrig.catalogue import SteppedFlag
from analogrig.errors import DeviceError, LinkError
from analogrig.links.link import PortWire, VirtualClock, Wire
from analogrig.run import LOST
from analogrig_lines.line_device import LineDevice
from analogrig_lines.lines import LinesDevice

N = 8
"""Samples of a record."""
BLOCK = 3

Outcome = Literal["ignored", "row", "run", "silent"]
"""Nothing is wrong; the sample is marked as lost; the record is not valid; a wrong value is not noticed."""

_ECHO = {"send": "{index:d},{u:d},{y:d}\n", "receive": "{index:d},{a1:g},{alarm:d}\n", "echo": "index"}

PROTOCOLS: dict[str, dict[str, Any]] = {
    "plain": {"send": "{u:d},{y:d}\n", "receive": "{a1:g},{alarm:d}\n"},
    "count": {"send": "{u:d},{y:d}\n", "receive": "{index:d},{a1:g},{alarm:d}\n"},
    "echo": _ECHO,
    "echo, window 8": {**_ECHO, "window": 8},
    "checksum": {
        **_ECHO,
        "send": "{index:d},{u:d},{y:d}*{checksum:x}\n",
        "receive": "{index:d},{a1:g},{alarm:d}*{checksum:x}\n",
        "checksum": "crc32",
    },
}
COMMON: dict[str, Any] = {"reset": "R\n", "reset_answer": "OK", "banner": "READY", "ignore": ("#",)}

TO = ("lost to", "garbled to", "twice to")
FROM = (
    *("lost back", "garbled back", "cut back", "split back", "twice back", "late back", "debug line", "wrong digit"),
    *("wrong index", "nan", "huge", "flood", "flood of lines", "silence", "reset", "hang-up", "lost and twice"),
)

FLOODS = {"flood": b"x" * 1000, "flood of lines": 300 * b"debug\n"}

_LOCK_STEP: dict[str, Outcome] = {
    **dict.fromkeys(("lost to", "garbled to", "lost back", "garbled back", "cut back", "split back"), "row"),
    **dict.fromkeys(("twice to", "twice back", "late back"), "run"),
    **dict.fromkeys(("nan", "huge", "flood", "flood of lines", "silence", "reset", "hang-up", "lost and twice"), "run"),
    "debug line": "ignored",
    "wrong digit": "silent",
}
_WITH_ECHO: dict[str, Outcome] = {**_LOCK_STEP, "twice back": "ignored", "late back": "row", "wrong index": "row"}

EXPECTED: dict[str, dict[str, Outcome]] = {
    "plain": _LOCK_STEP,
    "count": {**_LOCK_STEP, "wrong index": "run"},
    "echo": _WITH_ECHO,
    "echo, window 8": _WITH_ECHO,
    "checksum": {**_WITH_ECHO, "wrong digit": "row"},
}


@dataclass
class Firmware:
    """Scripted firmware with one fault at one sample of the first record."""

    fd: int
    clock: VirtualClock
    protocol: str
    fault: str = ""
    step: int = 0
    _tail: bytes = b""
    _received: int = 0
    _count: int = 0
    _previous: int = 0
    _late: list[bytes] = field(default_factory=list)
    _flood: bytes = b""
    _is_silent: bool = False
    is_closed: bool = False

    def run(self) -> None:
        """Answer everything that has arrived."""
        with contextlib.suppress(OSError):  # nothing has arrived, or the line is full
            while self._flood:
                self._write(self._flood)
            while not self.is_closed:
                *lines, self._tail = (self._tail + os.read(self.fd, 65536)).split(b"\n")
                for line in lines:
                    self._receive(line)

    def run_late(self) -> None:
        """Send what is late; the time-out has passed."""
        late, self._late = self._late, []
        for text in late:
            self._write(text)

    def _receive(self, line: bytes) -> None:
        if self._is_silent:
            return
        if line == b"R":
            self._count = self._received = 0
            if self.fault == "late start":
                self.fault = ""
                self._late.append(b"OK\n")
                return
            self._write(b"OK\n")
            return
        k, self._received = self._received, self._received + 1
        is_faulty = self.fault and k == self.step
        if is_faulty and self.fault == "garbled to":
            line = line.replace(b",", b"?", 1)
        if not (is_faulty and self.fault in ("lost to", "lost and twice")):
            self._process(line, is_faulty=bool(is_faulty))
        if is_faulty and self.fault == "twice to":
            self._process(line, is_faulty=False)
        if is_faulty:
            self.fault, self.step = ("twice to", k + 1) if self.fault == "lost and twice" else ("", 0)

    def _process(self, line: bytes, *, is_faulty: bool) -> None:
        text = line.decode()
        if self.protocol == "checksum":
            text, _, check = text.partition("*")
            if f"{zlib.crc32(f'{text}*'.encode()):08x}" != check:
                self._write(b"ERROR\n")
                return
        *index, u, y = text.split(",") if "?" not in text else ["", "", ""]
        if not (u.isdigit() and y.isdigit()):
            self._write(b"ERROR\n")
            return
        # A firmware that takes a repeated sample as a new one has another state then.
        a1 = int(u) + (0.5 if index and self._count and self._previous == int(u) else 0)
        self._previous, self._count = int(u), self._count + 1
        first = {"plain": []}.get(self.protocol, index or [str(self._count)])
        self._answer(first, f"{a1:g}", is_faulty=is_faulty)

    def _answer(self, first: list[str], a1: str, *, is_faulty: bool) -> None:
        fault = self.fault if is_faulty else ""
        a1 = {"nan": "nan", "huge": "1e999"}.get(fault, a1)
        text = self._signed(",".join([*first, a1, "0"]))
        if fault == "wrong digit":
            text = text.replace(f"{a1},".encode(), f"{a1[:-1]}{9 - int(a1[-1])},".encode(), 1)
        if fault == "wrong index":
            text = b"7" + text
        self._is_silent = fault == "silence"
        self._flood = self._flood or FLOODS.get(fault, b"")
        if self._is_silent or self._flood or fault == "lost back":
            return
        if fault == "late back":
            self._late.append(text)
            return
        half = len(text) // 2
        text = {
            "garbled back": text[:half] + b"\xff" + text[half + 1 :],
            "cut back": text[:half] + b"\n",
            "split back": text[:half] + b"\n" + text[half:],
            "twice back": text + text,
            "debug line": b"temperature 25\n" + text,
            "reset": b"READY\n",
        }.get(fault, text)
        if fault == "hang-up":
            os.close(self.fd)
            self.is_closed = True
            return
        self._write(text)

    def _signed(self, text: str) -> bytes:
        if self.protocol != "checksum":
            return f"{text}\r\n".encode()
        return f"{text}*{zlib.crc32(f'{text}*'.encode()):08x}\r\n".encode()

    def _write(self, text: bytes) -> None:
        os.write(self.fd, text)


class ScriptedWire:
    """Wire to a scripted firmware, over a pseudo-terminal. Time passes only while nothing is received."""

    def __init__(self, protocol: str, fault: str, step: int) -> None:
        ours, theirs = os.openpty()
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        self._wire = PortWire(os.ttyname(theirs), name="pty")
        os.close(theirs)
        clock = VirtualClock()
        self.name = "pty"
        self.clock = clock
        self._clock = clock
        self._firmware = Firmware(ours, clock, protocol, fault, step)

    def write(self, sent: bytes) -> None:
        self._wire.write(sent)
        self._firmware.run()

    def read(self, timeout_s: float) -> bytes:
        self._firmware.run()
        received = self._wire.read(0.0)
        if not received and timeout_s:
            self._clock.advance(timeout_s)
            self._firmware.run_late()
        return received

    def close(self) -> None:
        self._wire.close()
        if not self._firmware.is_closed:
            os.close(self._firmware.fd)


@dataclass(frozen=True, kw_only=True)
class Scripted(LinesDevice):
    """Device with a scripted firmware. When it is opened again, the firmware has no fault."""

    url: str = "scripted"
    wires: Iterator[ScriptedWire] = field(default=iter(()), compare=False)

    def wire(self) -> Wire:
        return next(self.wires)

    @classmethod
    def with_fault(cls, protocol: str, fault: str = "", step: int = 0) -> LineDevice:
        """Device whose first firmware has the fault."""
        faults = itertools.chain([(fault, step)], itertools.repeat(("", 0)))
        wires = (ScriptedWire(protocol, *each) for each in faults)
        return LineDevice(cls(name="bob", wires=wires, **COMMON, **PROTOCOLS[protocol]))


def record(device: LineDevice, n: int = N) -> Iterator[Answers]:
    """Play one record; the u of each sample is its own."""
    u, y, valid = 100 + np.arange(n, dtype=np.uint16), np.arange(n, dtype=np.uint16), np.ones(n, np.bool_)
    device.start()
    cuts = [slice(first, first + BLOCK) for first in range(0, n, BLOCK)]
    yield from device.play(Samples(cut.start, u[cut], y[cut], valid[cut]) for cut in cuts)
    device.stop()


def outcome(protocol: str, fault: str, step: int) -> tuple[Outcome, str]:
    """Outcome of a record with a fault, and the message.

    :raises AssertionError: a sample has the answer to another without a notice, or the record after it is not clean.
    """
    device = Scripted.with_fault(protocol, fault, step)
    answers: list[Answers] = []
    message = ""
    try:
        device.recover()
        answers.extend(record(device))
    except (LinkError, DeviceError) as error:
        message = str(error)
    flags = np.concatenate([each.flags for each in answers] or [np.zeros(0, np.uint8)])
    a1 = np.concatenate([np.zeros(0), *(np.ravel(each.theta) for each in answers if each.theta is not None)])
    is_right = (a1 == 100 + np.arange(len(a1))) | ((flags & LOST) != 0)
    check_clean(device)
    device.close()
    if message:
        return "run", message
    assert len(flags) == N
    lost = np.flatnonzero(flags & LOST).tolist()
    assert lost in ([], [step])
    assert all(flags[lost] == LOST | SteppedFlag.MISSING)
    if not is_right.all():
        return "silent", ""
    return ("row" if lost else "ignored"), ""


def check_clean(device: LineDevice) -> None:
    """:raises AssertionError: something from before reaches the next record."""
    device.recover()
    answers = list(record(device))
    assert np.concatenate([each.theta for each in answers if each.theta is not None]).ravel().tolist() == [
        100.0 + k for k in range(N)
    ]
    assert not any(each.flags.any() for each in answers)


def cases() -> list[tuple[str, str]]:
    """Protocols and faults."""
    return [
        (protocol, fault)
        for protocol in PROTOCOLS
        for fault in (*TO, *FROM)
        if protocol != "plain" or fault != "wrong index"
    ]


def steps(fault: str) -> range:
    """Samples at which a fault can happen."""
    return range(N - 1 if fault == "lost and twice" else N)


if __name__ == "__main__":
    unexpected = 0
    for a_protocol, a_fault in cases():
        found = {outcome(a_protocol, a_fault, step) for step in steps(a_fault)}
        kinds = {each for each, _ in found}
        unexpected += kinds != {EXPECTED[a_protocol][a_fault]}
        state = "" if kinds == {EXPECTED[a_protocol][a_fault]} else "   NOT AS EXPECTED"
        sys.stdout.write(f"{a_protocol:<16}{a_fault:<16}{'/'.join(sorted(kinds)):<12}{min(found)[1]}{state}\n")
    sys.exit(1 if unexpected else 0)
