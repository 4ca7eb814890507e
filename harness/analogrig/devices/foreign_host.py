"""Host of foreign code: records one after another, and the child process that serves them."""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import select
import socket
import time
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.devices.child import START_TIMEOUT_S, Child
from analogrig.devices.foreign_memory import (
    GUARD,
    MOST_MESSAGE,
    NO_SOCKET,
    REPLY,
    REQUEST,
    SLOTS,
    SharedLayout,
    Slot,
    StepFailed,
)
from analogrig.errors import DeviceCrashed, DeviceError, TimeLimitReached

_POLLS = 2
"""Looks at the foreign code in one time-out. If none finds progress, it hangs."""


class ForeignCall(NamedTuple):
    """A call of a function of the foreign code."""

    function: str
    slot: Slot | None = None
    n: int = 0
    """Samples of the block."""
    first: int = 0
    """First of them."""

    @property
    def done_n(self) -> int:
        return 0 if self.slot is None else self.slot.done_n(self.n)

    @property
    def place(self) -> str:
        """The function, with the sample that it is at."""
        if self.slot is None:
            return self.function
        return f"sample {self.first + min(self.done_n, self.n - 1)}: {self.function}"

    @property
    def places(self) -> str:
        """The function, with all its samples."""
        if self.slot is None:
            return self.function
        return f"samples {self.first} to {self.first + self.n - 1}: {self.function}"


class ForeignHost:
    """Foreign code in a child process, whose crash is an error here. Nothing of it is loaded in this process.

    The process loads the code, and forks itself for each record: no memory of an earlier record is left. Begin a record
    by ``start``; then each ``post`` has one ``take``, in order. Every error names the device, and the sample if there
    is one.
    """

    layout: ClassVar[SharedLayout]
    step_name: ClassVar[str]
    """Function that takes samples, in messages."""
    what: ClassVar[str]
    """Noun for the foreign code."""
    start_name: ClassVar[str]
    """Function that begins a record, in messages."""
    facts: object
    """Facts that the code states about itself; another object after it was loaded, or has begun with other settings."""

    def __init__(self, device: str, command: Sequence[str | Path], timeout_s: float) -> None:
        """Start the process ``command``. The numbers of its socket, and of the shared memory and its sizes, follow.

        :param timeout_s: longest time for one sample.
        :raises LinkError: the program was not built.
        """
        self._timeout_s = timeout_s
        self._unanswered = 1
        self._has_failed = self._is_single = self._has_begun = False
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        with theirs, os.fdopen(os.memfd_create("analogrig-device", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)) as shared:
            self._use(device, self.layout.memory(shared.fileno()))
            fds = (theirs.fileno(), shared.fileno())
            numbers = map(str, (*fds, SLOTS, self.layout.samples_bytes, self.layout.records_bytes))
            self._child = Child([*command, *numbers], f"the process of the {self.what}", inherited=fds)
        self._release = weakref.finalize(self, _release, self._socket, self._child)  # also of a device left open

    def _use(self, device: str, memory: mmap.mmap) -> None:
        """Exchange samples and records with the foreign code of a device in this memory."""
        self._device, self._memory = device, memory
        self._until_s = math.inf
        self._posted = self._taken = 0
        """Blocks since the start of the record."""
        self._settings: Mapping[str, Any] | None = None
        """Settings of the record, until its first sample."""

    @property
    def is_ready(self) -> bool:
        """False if the foreign code must be loaded anew before it can begin another record."""
        return not (self._unanswered or self._has_failed or (self._is_single and self._has_begun))

    def limit(self, until_s: float) -> None:
        """Set the end of all waits, on the monotonic clock."""
        self._until_s = until_s

    def close(self) -> None:
        """Release the foreign code. May be called twice."""
        self._release()

    def lay_out(self, theta_n: int) -> None:
        """Divide the memory into records with ``theta_n`` elements of theta."""
        self._theta_n = theta_n
        self._slots = self.layout.slots(self._memory, theta_n)

    # ------------------------------------------------------------------------------------------------------- one record

    def start(self, settings: Mapping[str, Any]) -> None:
        """Begin a record. One that has begun with these settings and has no sample yet is used.

        :raises DeviceRefused: names the setting that the foreign code refuses.
        :raises DeviceError: the foreign code cannot start.
        """
        if settings == self._settings:
            return
        self._settings = None
        self._posted = self._taken = 0
        self._start(settings)
        self._settings = dict(settings)

    def _start(self, settings: Mapping[str, Any]) -> None:
        """Begin a record; errors as ``start``."""
        raise NotImplementedError

    def post(self, u: NDArray[Any], y: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Give the foreign code at most SLOT_SAMPLES samples. At most SLOTS blocks may await ``take``."""
        self._settings = None
        slot = self._posted % SLOTS
        self._slots[slot].fill(u, y, valid)
        self._posted += 1
        self._post(slot, len(u))

    def take(self, n: int, first: int) -> NDArray[Any]:
        """Records (n,) of the oldest block, whose first sample is ``first``; valid until the next ``post``.

        :raises DeviceError: the foreign code failed; names the sample.
        :raises TimeLimitReached: the time limit is over; ``answered`` counts the records until then.
        """
        slot = self._slots[self._taken % SLOTS]
        call = ForeignCall(self.step_name, slot, n, first)
        self._await(call)
        self._taken += 1
        where = f"device {self._device}: sample"
        if (done_n := slot.done_n(n)) < n:
            raise DeviceError(f"{where} {first + done_n}: {self.step_name} returned without an answer (done = 0)")
        if (broken := slot.guard[:n] != GUARD).any():
            raise DeviceError(
                f"{where} {first + int(np.argmax(broken))}: {self.step_name} wrote beyond the end of its record, which"
                f" holds theta_n = {self._theta_n} elements of theta"
            )
        if slot.is_overrun(n):
            raise self.overrun(call, f"the last of {n} records")
        return slot.records[:n]

    def answered(self, n: int) -> NDArray[Any]:
        """Records of the oldest block of n samples that are complete by now."""
        slot = self._slots[self._taken % SLOTS]
        return slot.records[: slot.done_n(n)]

    def overrun(self, call: ForeignCall, what: str) -> DeviceError:
        """Error of a call that wrote behind something."""
        return DeviceError(f"device {self._device}: {call.places} wrote beyond the end of {what}")

    # ---------------------------------------------------------------------------------------------- with the child

    def hello(self) -> bytes:
        """First message of the process."""
        return self._reply(ForeignCall(f"loading the {self.what}"), START_TIMEOUT_S)

    def begin(self, settings: bytes, timeout_s: float) -> tuple[int, bytes]:
        """Request a new record; return the result and the text of the reply."""
        self._request(0, settings=settings)
        self._has_begun = True
        return self._result(ForeignCall(self.start_name), timeout_s)

    def _post(self, slot: int, n: int) -> None:
        """Begin the step of the samples of the slot."""
        self._request(n, slot)

    def _await(self, call: ForeignCall) -> None:
        """Wait for the end of the oldest step; errors as ``take``."""
        result, text = self._result(call, self._timeout_s)
        if result:
            raise StepFailed(text.decode())

    def _result(self, call: ForeignCall, timeout_s: float) -> tuple[int, bytes]:
        """Result and text of a call; errors as ``_reply``, and code that wrote behind its state."""
        reply = self._reply(call, timeout_s)
        result, is_overrun = REPLY.unpack_from(reply)
        if is_overrun:
            raise self.overrun(call, "its state")
        return int(result), reply[REPLY.size :]

    def _request(self, n: int, slot: int = 0, settings: bytes = b"") -> None:
        self._unanswered += 1
        with contextlib.suppress(OSError):  # the process has ended: its missing reply names the sample
            self._socket.send(REQUEST.pack(n, slot, self._slots[0].records.itemsize if n else 0) + settings)

    def _reply(self, call: ForeignCall, timeout_s: float) -> bytes:
        """Next message of the process.

        :raises DeviceCrashed: the process has ended, or the call makes no progress.
        :raises TimeLimitReached: the time limit is over.
        """
        done_n = stalls = 0
        while True:
            left_s = max(0.0, self._until_s - time.monotonic())
            if self._readable.poll(math.ceil(1000.0 * min(timeout_s / _POLLS, left_s))):
                break
            if time.monotonic() >= self._until_s:
                raise TimeLimitReached("the time limit of the run is over")
            stalls = 0 if call.done_n > done_n else stalls + 1
            done_n = call.done_n
            if stalls == _POLLS:
                raise DeviceCrashed(f"device {self._device}: {call.place} has not returned for {timeout_s:g} s")
        try:
            message = self._socket.recv(MOST_MESSAGE)
        except OSError:
            message = b""
        if not message:
            self._has_failed = True
            report = self._child.exit_report()
            closed = f": the {self.what} closed a descriptor that it did not open"
            cause = closed if self._child.status == NO_SOCKET else ""
            raise DeviceCrashed(f"device {self._device}: {call.place}: {report}{cause}")
        self._unanswered -= 1
        return message


def _release(line: socket.socket, child: Child) -> None:
    line.close()
    child.end()
