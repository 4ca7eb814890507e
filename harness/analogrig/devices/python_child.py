"""Process of a Python device: ``python -m analogrig.devices.python_child ORDER SOCKET MEMORY SLOTS BYTES BYTES``.

It imports the module of the device, and forks itself for each record: no memory of an earlier record is left. The child
that finds the request for the next record leaves it in the socket, gives the turn to the next child, and ends. That one
was forked while the record was played. The protocol is that of library_child.c, with texts in JSON behind requests and
replies.
"""

from __future__ import annotations

import _thread
import ctypes
import gc
import json
import mmap
import os
import resource
import select
import signal
import socket
import struct
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from analogrig.datasheet import Datasheet
from analogrig.devices.foreign_memory import MOST_MESSAGE, NO_SOCKET, REPLY, REQUEST, StepFailed
from analogrig.devices.python_object import ERRORS, LAYOUT, PythonObject

_FORKED = 5
"""Exit status of a process that the device forked, and that would take requests from it."""
_MOST_TEXT = 4000
_NOTE = struct.Struct("=II")
"""Note of a child at the end of its turn: 1, and the bytes of its data sheet, which follow."""
_NOTE_BYTES = 2 * mmap.PAGESIZE
_PR_SET_PDEATHSIG = 1
_C = ctypes.CDLL(None)


def main() -> None:
    """Serve records until the socket ends."""
    order = json.loads(sys.argv[1])
    their_socket, shared = map(int, sys.argv[2:4])
    # Standard input is empty. Standard output goes to standard error, whose end the parent quotes.
    os.dup2(os.open(os.devnull, os.O_RDWR), 0)
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.path[:] = order["path"]
    line = socket.socket(fileno=their_socket)
    memory, relay = LAYOUT.memory(shared), _Relay()
    own_pid, before = os.getpid(), _shared_things()
    try:
        loaded = PythonObject(order["device"], order["factory"], (BaseException,), order["states"])
    except tuple(ERRORS.values()) as error:
        _send(line, _as_table(error))
        os._exit(0)  # without the handlers of the device
    if os.getpid() != own_pid:
        os._exit(_FORKED)
    is_single = _shared_things() != before
    _send(line, {"origin": loaded.origin, "is_single": is_single})
    record = _Record(line, memory, loaded, order["stated"])
    if is_single:
        record.serve()
        os._exit(0)
    warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside the threads of a numerical library
    _C.prctl(_PR_SET_PDEATHSIG, 0)  # finds the function before the forks, each of which would do so
    gc.collect()
    gc.freeze()  # a collection in a child would copy all of this memory
    _serve_in_children(record, relay)


class _Record:
    """Server of one record."""

    def __init__(self, line: socket.socket, memory: mmap.mmap, loaded: PythonObject, stated: Mapping[str, Any]) -> None:
        self._line, self._memory, self._loaded, self._stated = line, memory, loaded, stated
        self._sheet: Datasheet | None = None
        self._use(Datasheet())

    def expect(self, sheet_text: str) -> None:
        """Prepare for a record with this data sheet. Each fork then has it, and copies fewer pages."""
        if sheet_text:
            self._use(self._loaded.read_sheet(sheet_text))

    def serve(self) -> str | None:
        """Answer requests until the next begins another record. Return the data sheet in JSON; at the end, None."""
        own_pid, is_begun = os.getpid(), False
        while len(head := self._line.recv(REQUEST.size, socket.MSG_PEEK)) == REQUEST.size:
            n, slot, _ = REQUEST.unpack(head)
            if is_begun and not n:
                return self._loaded.sheet_text
            settings = self._line.recv(MOST_MESSAGE)[REQUEST.size :]
            result, text = self._step(slot, n) if n else self._begin(json.loads(settings))
            is_begun = True
            if os.getpid() != own_pid:
                os._exit(_FORKED)
            _send(self._line, text, REPLY.pack(result, 0))
        return None

    def _use(self, sheet: Datasheet) -> None:
        if sheet is not self._sheet:
            self._sheet, self._reply = sheet, sheet.as_table()
            self._slots = LAYOUT.slots(self._memory, sheet.theta_n)

    def _begin(self, settings: Mapping[str, Any]) -> tuple[int, Mapping[str, Any]]:
        try:
            sheet = self._loaded.begin(settings, self._stated)
        except tuple(ERRORS.values()) as error:
            return 1, _as_table(error)
        self._use(sheet)
        return 0, self._reply

    def _step(self, slot: int, n: int) -> tuple[int, str]:
        try:
            self._loaded.step(self._slots[slot], n)
        except StepFailed as error:
            return 1, str(error)
        return 0, ""


class _Relay:
    """Turn of a child to serve its record, which the child before hands on to it."""

    def __init__(self) -> None:
        self._taking, self._giving = os.pipe()
        self._taken, self._telling = os.pipe()
        self.child_handler: Any = None
        """Handler of SIGCHLD that the device has set; it is for the children, since this process waits for them."""
        self._notes = mmap.mmap(-1, 2 * _NOTE_BYTES)
        """Notes of two children: the next may write its own before that of the one before was read."""

    def take(self) -> None:
        """Wait for the turn."""
        os.read(self._taking, 1)
        os.write(self._telling, b"t")

    def await_take(self, child: int) -> None:
        """Wait until a child has taken its turn, or has ended: the next is forked then, and cannot take it first."""
        ended = os.pidfd_open(child)
        events = select.poll()
        for descriptor in (self._taken, ended):
            events.register(descriptor, select.POLLIN)
        if self._taken in dict(events.poll()):
            os.read(self._taken, 1)
        os.close(ended)

    def give(self, number: int = -1, sheet_text: str = "") -> None:
        """End the turn of the record ``number``."""
        at, text = number % 2 * _NOTE_BYTES, sheet_text.encode()
        if len(text) > _NOTE_BYTES - _NOTE.size:
            text = b""
        self._notes[at : at + _NOTE.size + len(text)] = _NOTE.pack(1, len(text)) + text
        os.write(self._giving, b"t")

    def pop(self, number: int) -> str | None:
        """Data sheet of the record ``number``; None if it did not end its turn."""
        at = number % 2 * _NOTE_BYTES
        is_given, size = _NOTE.unpack_from(self._notes, at)
        _NOTE.pack_into(self._notes, at, 0, 0)
        return self._notes[at + _NOTE.size :][:size].decode() if is_given else None


def _serve_in_children(record: _Record, relay: _Relay) -> NoReturn:
    """Serve each record in a child. The end of one by itself ends this process in the same way."""
    relay.child_handler = signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    number, child = 0, _fork(record, relay, 0)
    relay.give()
    while True:
        relay.await_take(child)
        spare = _fork(record, relay, number + 1)
        _, status = os.waitpid(child, 0)
        if (sheet_text := relay.pop(number)) is None:  # it did not end its turn: end as it did
            if (code := os.waitstatus_to_exitcode(status)) < 0:
                if -code != signal.SIGKILL:
                    signal.signal(-code, signal.SIG_DFL)
                os.kill(os.getpid(), -code)
            os._exit(code)
        record.expect(sheet_text)
        number, child = number + 1, spare


def _fork(record: _Record, relay: _Relay, number: int) -> int:
    """Fork the child of a record, which awaits its turn; return its number."""
    own_pid, generator = os.getpid(), sys.modules.get("random")
    drawn = generator.getstate() if generator else None
    if pid := os.fork():
        return pid
    status = 1
    try:
        if generator:
            generator.setstate(drawn)  # Python seeds it anew after a fork
        if relay.child_handler is not None:
            signal.signal(signal.SIGCHLD, relay.child_handler)
        _C.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() == own_pid:
            relay.take()
            if (sheet_text := record.serve()) is not None:
                relay.give(number, sheet_text)
        status = 0
    finally:
        os._exit(status)  # without the handlers of the device


def _shared_things() -> tuple[object, ...]:
    """Things of this process that its forked children share with it, in place of a copy, or lack."""
    mappings = [line for line in Path("/proc/self/maps").read_text().splitlines() if line.split()[1][3] == "s"]
    descriptors = sorted(path.name for path in Path("/proc/self/fd").iterdir())
    threads = _thread._count()  # noqa: SLF001 - after an import of threading, each fork copies 150 pages more
    return threads, descriptors, len(mappings)


def _as_table(error: Exception) -> dict[str, str]:
    kind = next(name for name, kind in reversed(ERRORS.items()) if isinstance(error, kind))
    return {"error": kind, "text": str(error)[:_MOST_TEXT]}


def _send(line: socket.socket, text: object, head: bytes = b"") -> None:
    """Send a message. If that fails, the parent has gone or the device has closed the socket."""
    body = text[:_MOST_TEXT].encode() if isinstance(text, str) else json.dumps(text).encode()
    try:
        line.send(head + body, socket.MSG_NOSIGNAL)
    except OSError:
        os._exit(NO_SOCKET)


if __name__ == "__main__":
    main()
