"""Hosts of a library of analogrig_estimator.h: a child process, or this process."""

from __future__ import annotations

import contextlib
import ctypes
import enum
import fcntl
import math
import mmap
import os
import select
import socket
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.datasheet import MOST_THETA
from analogrig.devices.child import PROGRAMS, START_TIMEOUT_S, Child
from analogrig.devices.library import load_library
from analogrig.errors import ConfigurationError, DeviceCrashed, DeviceError, DeviceRefused, TimeLimitReached

PROGRAM = PROGRAMS / "analogrig-library"

ABI = 1
"""ANALOGRIG_ABI."""

MOST_STATE_BYTES = 1 << 28

SLOTS = 2
"""Blocks that a host takes before it answers: while the library works on one, the next is filled."""
SLOT_SAMPLES = 16_384

SAMPLE = np.dtype([("u", "<f4"), ("y", "<f4"), ("valid", "<u4")])
"""analogrig_in_t."""

_GUARD = 0xA5C3_5A3C
"""Value behind each record, which a library that writes beyond it destroys."""
_CANARY = np.full(64, 0xA5, np.uint8)
"""Bytes behind the last record of a block, and behind the state."""

_MOST_MESSAGE = 2048
_HELLO = struct.Struct("=IIQI1024s4x")
_REQUEST = struct.Struct("=QII")
_REPLY = struct.Struct("=qq")

_NO_SOCKET = 4
"""Exit status of analogrig-library without its socket."""

_POLLS = 2
"""Looks at a library in one time-out. If none finds progress, it hangs."""

_ENVIRONMENT_BYTES = 64
"""At least the size of fenv_t."""
_STATE_ALIGNMENT = 64


def _is_broken(canary: NDArray[np.uint8]) -> bool:
    return canary.tobytes() != _CANARY.tobytes()  # in a third of the time of a comparison of arrays


class Reports(enum.IntFlag):
    """Flags of analogrig_about_t.reports."""

    STATISTIC = 1
    INNOVATION = 2
    ARMED = 4


def record_type(theta_n: int) -> np.dtype[Any]:
    """analogrig_out_t with ``theta_n`` elements of theta and a guard."""
    flags = [(name, "u1") for name in ("alarm", "armed", "refused", "done")]
    numbers = [("statistic", "<f4"), ("innovation", "<f4"), ("theta", "<f4", (theta_n,))]
    return np.dtype([*flags, *numbers, ("guard", "<u4")])


SAMPLES_BYTES = SLOT_SAMPLES * SAMPLE.itemsize
RECORDS_BYTES = SLOT_SAMPLES * record_type(MOST_THETA).itemsize + mmap.PAGESIZE
"""The last page holds the canary of a full slot."""


@dataclass(frozen=True)
class About:
    """Facts that a library states about itself: analogrig_about_t."""

    abi: int
    theta_n: int
    state_bytes: int
    reports: int
    name: str
    """Name and version; any characters."""

    def check(self) -> None:
        """:raises ConfigurationError: the facts contradict analogrig_estimator.h."""
        if self.abi != ABI:
            raise ConfigurationError(
                f"was built for ABI {self.abi} of analogrig_estimator.h, and this analogrig has {ABI}: compile it again"
            )
        limits = (("theta_n", MOST_THETA), ("state_bytes", MOST_STATE_BYTES), ("reports", sum(Reports)))
        for name, most in limits:
            if getattr(self, name) > most:
                raise ConfigurationError(
                    f"analogrig_about gives {name} = {getattr(self, name)}, and the largest is {most}"
                )


class _Slot:
    """Memory of one block: views of its samples and records, made once because that takes longer than to fill them."""

    def __init__(self, samples: NDArray[Any], room: NDArray[np.uint8], record: np.dtype[Any]) -> None:
        """``room`` holds the records and the canary behind them."""
        self.u, self.y, self.valid = (samples[name] for name in ("u", "y", "valid"))
        self.records = room[: SLOT_SAMPLES * record.itemsize].view(record)
        self._room = room
        self.done, self.guard = self.records["done"], self.records["guard"]
        self.addresses = samples.ctypes.data, room.ctypes.data

    def fill(self, u: NDArray[Any], y: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Set the samples, and prepare their records."""
        n = len(u)
        self.u[:n], self.y[:n], self.valid[:n] = u, y, valid
        self._room[: n * self.records.itemsize] = 0
        self.guard[:n] = _GUARD
        self._behind(n)[:] = _CANARY

    def is_overrun(self, n: int) -> bool:
        """True if something was written behind the last of ``n`` records."""
        return _is_broken(self._behind(n))

    def _behind(self, n: int) -> NDArray[np.uint8]:
        end = n * self.records.itemsize
        return self._room[end : end + len(_CANARY)]

    def done_n(self, n: int) -> int:
        """Number of complete records before the first incomplete one, of ``n``."""
        done = self.done[:n]
        return n if done.all() else int(np.argmin(done))


class LibraryHost(ABC):
    """Loaded library and its memory. Begin a record by ``start``; then each ``post`` has one ``take``, in order.

    Every error names the device, and the sample if there is one.
    """

    def __init__(self, device: str, library: Path, about: About, memory: mmap.mmap) -> None:
        """:raises ConfigurationError: the library contradicts the header."""
        self._device = device
        try:
            about.check()
        except ConfigurationError as error:
            raise ConfigurationError(f"device {device}: {library}: {error}") from error
        self.about = about
        self._type = record_type(about.theta_n)
        sizes = [SAMPLES_BYTES] * SLOTS + [RECORDS_BYTES] * SLOTS
        starts = [sum(sizes[:i]) for i in range(len(sizes))]
        self._slots = [
            _Slot(
                np.frombuffer(memory, SAMPLE, SLOT_SAMPLES, samples),
                np.frombuffer(memory, np.uint8, RECORDS_BYTES, records),
                self._type,
            )
            for samples, records in zip(starts[:SLOTS], starts[SLOTS:], strict=True)
        ]
        self._posted = self._taken = 0
        """Blocks since the start of the record."""

    @staticmethod
    def memory(fd: int = -1) -> mmap.mmap:
        """Memory of all slots, and room behind it for one full analogrig_out_t; ``fd`` is a file for it."""
        size = SLOTS * (SAMPLES_BYTES + RECORDS_BYTES) + mmap.PAGESIZE
        if fd >= 0:
            os.ftruncate(fd, size)
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)  # by the library: SIGBUS here
        return mmap.mmap(fd, size)

    def post(self, u: NDArray[Any], y: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Give the library at most SLOT_SAMPLES samples. At most SLOTS blocks may await ``take``."""
        slot = self._posted % SLOTS
        self._slots[slot].fill(u, y, valid)
        self._posted += 1
        self._post(slot, len(u))

    def take(self, n: int, first: int) -> NDArray[Any]:
        """Records (n,) of the oldest block, whose first sample is ``first``; valid until the next ``post``.

        :raises DeviceError: the library failed; names the sample.
        :raises TimeLimitReached: the time limit is over; ``answered`` counts the records until then.
        """
        slot = self._slots[self._taken % SLOTS]
        call = _Call("analogrig_step", slot, n, first)
        self._await(call)
        self._taken += 1
        if (done_n := slot.done_n(n)) < n:
            raise DeviceError(
                f"device {self._device}: sample {first + done_n}: analogrig_step returned without an answer (done = 0)"
            )
        if (broken := slot.guard[:n] != _GUARD).any():
            raise DeviceError(
                f"device {self._device}: sample {first + int(np.argmax(broken))}: analogrig_step wrote beyond the end"
                f" of its record, which holds theta_n = {self.about.theta_n} elements of theta"
            )
        if slot.is_overrun(n):
            raise self._overrun(call, f"the last of {n} records")
        return slot.records[:n]

    def answered(self, n: int) -> NDArray[Any]:
        """Records of the oldest block of n samples that are complete by now."""
        slot = self._slots[self._taken % SLOTS]
        return slot.records[: slot.done_n(n)]

    def _overrun(self, call: _Call, what: str) -> DeviceError:
        return DeviceError(f"device {self._device}: {call.places} wrote beyond the end of {what}")

    def _check_state(self, call: _Call, *, is_overrun: bool) -> None:
        """:raises DeviceError: the call wrote behind the state."""
        if is_overrun:
            raise self._overrun(call, f"its state, which has state_bytes = {self.about.state_bytes}")

    def start(self, settings: Mapping[str, float]) -> None:
        """Begin a record.

        :raises DeviceRefused: names the setting that the library refuses.
        :raises DeviceError: the library cannot start.
        """
        self._posted = self._taken = 0
        result = self._init(settings)
        if 0 < result <= len(settings):
            name, value = list(settings.items())[result - 1]
            raise DeviceRefused(f"device {self._device}: the library refuses the setting {name} = {value:g}")
        if result:
            raise DeviceError(f"device {self._device}: cannot start: analogrig_init returned {result}")

    @property
    def is_idle(self) -> bool:
        """False if the library still works on an abandoned record, and cannot start another."""
        return True

    def limit(self, until_s: float) -> None:  # noqa: B027 - in this process nothing can be interrupted
        """Set the end of all waits, on the monotonic clock."""

    def close(self) -> None:  # noqa: B027 - a library in this process stays loaded
        """Release the library. May be called twice."""

    @abstractmethod
    def _init(self, settings: Mapping[str, float]) -> int:
        """Result of analogrig_init with a new state."""

    @abstractmethod
    def _post(self, slot: int, n: int) -> None:
        """Begin analogrig_step for the samples of the slot."""

    @abstractmethod
    def _await(self, call: _Call) -> None:
        """Wait for the end of the oldest analogrig_step; errors as ``take``."""


class _Call(NamedTuple):
    """A call of a function of the library."""

    function: str
    slot: _Slot | None = None
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


class ChildHost(LibraryHost):
    """A library in a child process, whose crash is an error here. Nothing of the library is loaded in this process."""

    def __init__(self, device: str, library: Path, settings: Mapping[str, float], timeout_s: float) -> None:
        """Start the process.

        :param settings: those of every ``start``.
        :param timeout_s: longest time for one sample.
        :raises ConfigurationError: the file is no library of analogrig_estimator.h.
        :raises DeviceCrashed: the library crashes or hangs while it is loaded.
        :raises LinkError: analogrig-library was not built.
        """
        self._device = device
        self._timeout_s = timeout_s
        self._until_s = math.inf
        self._unanswered = 1
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        with theirs, os.fdopen(os.memfd_create("analogrig-library", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)) as shared:
            memory = self.memory(shared.fileno())
            fds = (theirs.fileno(), shared.fileno())
            words = [f"{name}={float(value).hex()}" for name, value in settings.items()]
            numbers = map(str, (*fds, SLOTS, SAMPLES_BYTES, RECORDS_BYTES))
            command: list[str | Path] = [PROGRAM, library, *numbers, *words]
            self._child = Child(command, "the process of the library", inherited=fds)
        try:
            super().__init__(device, library, self._about(library), memory)
        except BaseException:
            self.close()
            raise

    @property
    def is_idle(self) -> bool:
        return not self._unanswered

    def limit(self, until_s: float) -> None:
        self._until_s = until_s

    def close(self) -> None:
        self._socket.close()
        self._child.end()

    def _about(self, library: Path) -> About:
        hello = self._reply(_Call("loading the library"), START_TIMEOUT_S)
        if len(hello) != _HELLO.size:
            text = hello.decode(errors="replace").removeprefix(f"{library}: ")
            raise ConfigurationError(f"device {self._device}: {library}: is no library of an estimator: {text}")
        abi, theta_n, state_bytes, reports, name = _HELLO.unpack(hello)
        return About(abi, theta_n, state_bytes, reports, name.rstrip(b"\0").decode(errors="replace"))

    def _init(self, settings: Mapping[str, float]) -> int:  # noqa: ARG002 - the process has them
        self._request(0)
        return self._result(_Call("analogrig_init"))

    def _post(self, slot: int, n: int) -> None:
        self._request(n, slot)

    def _await(self, call: _Call) -> None:
        self._result(call)

    def _result(self, call: _Call) -> int:
        """Result of a call; errors as ``_reply``, and a library that wrote behind its state."""
        result, is_overrun = _REPLY.unpack(self._reply(call, self._timeout_s))
        self._check_state(call, is_overrun=bool(is_overrun))
        return int(result)

    def _request(self, n: int, slot: int = 0) -> None:
        self._unanswered += 1
        with contextlib.suppress(OSError):  # the process has ended: its lacking reply names the sample
            self._socket.send(_REQUEST.pack(n, slot, self._type.itemsize))

    def _reply(self, call: _Call, timeout_s: float) -> bytes:
        """Next message of the process.

        :raises DeviceCrashed: the process has ended, or the call makes no progress.
        :raises TimeLimitReached: the time limit is over.
        """
        done_n = stalls = 0
        while not self._readable.poll(self._wait_ms(timeout_s / _POLLS)):
            if time.monotonic() >= self._until_s:
                raise TimeLimitReached("the time limit of the run is over")
            stalls = 0 if call.done_n > done_n else stalls + 1
            done_n = call.done_n
            if stalls == _POLLS:
                raise DeviceCrashed(f"device {self._device}: {call.place} has not returned for {timeout_s:g} s")
        try:
            message = self._socket.recv(_MOST_MESSAGE)
        except OSError:
            message = b""
        if not message:
            report = self._child.exit_report()
            cause = ": the library closed a descriptor that it did not open" if self._child.status == _NO_SOCKET else ""
            raise DeviceCrashed(f"device {self._device}: {call.place}: {report}{cause}")
        self._unanswered -= 1
        return message

    def _wait_ms(self, longest_s: float) -> int:
        left_s = max(0.0, self._until_s - time.monotonic())
        return math.ceil(1000.0 * min(longest_s, left_s))


class _FloatEnvironment:
    """Floating-point environment of this thread, restored after each call of a library.

    A library built with -ffast-math turns off denormals when it is loaded, for all of Python.
    """

    def __init__(self) -> None:
        c = ctypes.CDLL(None)
        self._restore = c.fesetenv
        self._saved = ctypes.create_string_buffer(_ENVIRONMENT_BYTES)
        c.fegetenv(self._saved)

    def __enter__(self) -> None:
        return

    def __exit__(self, *_: object) -> None:
        self._restore(self._saved)


class InProcessHost(LibraryHost):
    """A library in this process, which its crash ends."""

    def __init__(self, device: str, library: Path) -> None:
        """Load the library.

        :raises ConfigurationError: the file is no library of analogrig_estimator.h.
        """
        self._environment = _FloatEnvironment()
        functions = [f"analogrig_{function}" for function in ("about", "init", "step")]
        with self._environment:
            try:
                self._c = load_library(library, functions, "harness/docs/howto/test-a-c-library.md")
            except ConfigurationError as error:
                raise ConfigurationError(f"device {device}: {error}") from error
            self._c.analogrig_about.restype = ctypes.POINTER(_About)
            about = self._c.analogrig_about()
        if not about:
            raise ConfigurationError(f"device {device}: {library}: analogrig_about returned a null pointer")
        self._memory = self.memory()
        super().__init__(device, library, about[0].facts(), self._memory)
        size = self.about.state_bytes
        self._room = np.zeros(size + _STATE_ALIGNMENT + len(_CANARY), np.uint8)
        self._state = -(-self._room.ctypes.data // _STATE_ALIGNMENT) * _STATE_ALIGNMENT
        behind = self._state - self._room.ctypes.data + size
        self._canary = self._room[behind : behind + len(_CANARY)]
        self._overruns = [False] * SLOTS
        """True for each slot behind whose block the state was overrun."""
        self._step = self._c.analogrig_step
        self._step.restype = None
        self._step.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t]

    def _init(self, settings: Mapping[str, float]) -> int:
        ctypes.memset(self._state, 0, self.about.state_bytes)
        self._canary[:] = _CANARY
        given = (_Setting * len(settings))(*(_Setting(name.encode(), value) for name, value in settings.items()))
        with self._environment:
            result = int(self._c.analogrig_init(ctypes.c_void_p(self._state), given, ctypes.c_size_t(len(settings))))
        self._check_state(_Call("analogrig_init"), is_overrun=self._is_overrun())
        return result

    def _post(self, slot: int, n: int) -> None:
        with self._environment:
            self._step(self._state, n, *self._slots[slot].addresses, self._type.itemsize)
        self._overruns[slot] = self._is_overrun()

    def _await(self, call: _Call) -> None:
        """Check the state as it was behind the call, which has ended."""
        self._check_state(call, is_overrun=self._overruns[self._taken % SLOTS])

    def _is_overrun(self) -> bool:
        return _is_broken(self._canary)


class _About(ctypes.Structure):
    _fields_ = (
        ("abi", ctypes.c_uint32),
        ("theta_n", ctypes.c_uint32),
        ("state_bytes", ctypes.c_uint64),
        ("reports", ctypes.c_uint32),
        ("name", ctypes.c_char_p),
    )

    def facts(self) -> About:
        if self.abi != ABI:
            return About(self.abi, 0, 0, 0, "")
        name = (self.name or b"").decode(errors="replace")
        return About(self.abi, self.theta_n, self.state_bytes, self.reports, name)


class _Setting(ctypes.Structure):
    _fields_ = (("name", ctypes.c_char_p), ("value", ctypes.c_double))
