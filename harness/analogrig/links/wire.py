"""Wires: what carries bytes to a device and back, as they are, and nothing else."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import select
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

import serial

from analogrig.errors import ConfigurationError, LinkClosed, LinkError
from analogrig.protocol.catalogue import CATALOGUE_HASH, FirmwareId

DEFAULT_BAUD = 115_200
WRITE_TIMEOUT_S = 2.0

LIBRARY = Path(__file__).parents[1] / "_device.so"

_READ_BYTES = 65_536
_POLL_S = 1e-3
"""The resolution of poll(); a message of samples in real time lasts less."""
_ALWAYS_ROOM = 255
"""Blocks that may wait in the input of a device that works while it is told."""

Clock = Callable[[], float]
"""Seconds from any beginning, never backwards."""


class VirtualClock:
    """Time that goes by only when it is told to: what waits in vain costs nothing, and is the same every time."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def __call__(self) -> float:
        return self._now_s

    def advance(self, by_s: float) -> None:
        self._now_s += by_s


class Wire(Protocol):
    """A line of bytes to one device."""

    @property
    def name(self) -> str:
        """What it is, for errors and records."""

    @property
    def clock(self) -> Clock:
        """The time in which its time-outs are meant."""

    def write(self, sent: bytes) -> None:
        """Send all of it.

        :raises LinkError: it cannot be sent.
        """

    def read(self, timeout_s: float) -> bytes:
        """What has come, at least one byte unless the time is over, or nearly over.

        :raises LinkClosed: the other end is gone.
        """

    def close(self) -> None:
        """Let go of the line. May be called twice."""


class DescriptorWire:
    """A file descriptor: a terminal, or one end of a pair of sockets."""

    def __init__(self, fd: int, name: str) -> None:
        """Take over ``fd``."""
        self.name = name
        self.clock: Clock = time.monotonic
        self._fd = fd
        os.set_blocking(fd, False)
        self._readable = select.poll()
        self._readable.register(fd, select.POLLIN)
        self._writable = select.poll()
        self._writable.register(fd, select.POLLOUT)

    def write(self, sent: bytes) -> None:
        try:
            sent = sent[self._take(sent) :]
            if sent:
                self._write_slowly(sent, self.clock() + WRITE_TIMEOUT_S)
        except OSError as error:
            raise LinkClosed(f"{self.name}: {_reason(error)}") from error

    def _write_slowly(self, sent: bytes, deadline_s: float) -> None:
        """As the other end takes it."""
        while sent:
            if not self._writable.poll(math.ceil(max(0.0, deadline_s - self.clock()) * 1000.0)):
                raise LinkError(f"{self.name}: nothing can be sent, the other end takes nothing")
            sent = sent[self._take(sent) :]

    def _take(self, sent: bytes) -> int:
        """How much of it the line takes at once."""
        try:
            return os.write(self._fd, sent)
        except BlockingIOError:
            return 0

    def read(self, timeout_s: float) -> bytes:
        try:
            if not self._readable.poll(int(timeout_s * 1000.0)):
                if timeout_s >= _POLL_S:
                    return b""  # the rest of the time is for the next call
                time.sleep(timeout_s)
                if not self._readable.poll(0):
                    return b""
            received = os.read(self._fd, _READ_BYTES)
        except OSError as error:
            raise LinkClosed(f"{self.name}: {_reason(error)}") from error
        if not received:
            raise LinkClosed(f"{self.name}: the other end has hung up")
        return received

    def close(self) -> None:
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with contextlib.suppress(OSError):
                os.close(fd)


class PortWire:
    """Anything pyserial can open: ``/dev/ttyUSB0``, a pseudo-terminal, ``socket://host:port``, ``loop://``."""

    def __init__(self, url: str, baud: int = DEFAULT_BAUD, *, name: str | None = None) -> None:
        """Open ``url``; where the system can, nobody else may open it meanwhile.

        :raises ConfigurationError: pyserial knows no such kind of URL.
        :raises LinkError: it cannot be opened.
        """
        self.name = url if name is None else name
        self.clock: Clock = time.monotonic
        try:
            self._port = serial.serial_for_url(url, baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
        except OSError as error:
            raise LinkError(f"cannot open {url}: {_reason(error)}") from error
        except Exception as error:  # the handlers of pyserial's URLs raise whatever a wrong URL makes them
            raise ConfigurationError(f"{url}: not a serial port or URL that pyserial understands: {error}") from error
        # A plain file descriptor is used as one: pyserial's read() and write() cost as much as a whole exchange.
        is_plain = type(self._port) is serial.Serial
        self._wire = DescriptorWire(self._port.fileno(), self.name) if is_plain else _UrlWire(self._port, self.name)

    def write(self, sent: bytes) -> None:
        self._wire.write(sent)

    def read(self, timeout_s: float) -> bytes:
        return self._wire.read(timeout_s)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()


class _UrlWire:
    """What pyserial has opened and is no file descriptor."""

    def __init__(self, port: serial.Serial, name: str) -> None:
        self._port = port
        self._name = name

    def write(self, sent: bytes) -> None:
        try:
            self._port.write(sent)
        except serial.SerialTimeoutException as error:
            raise LinkError(f"{self._name}: nothing can be sent, the other end takes nothing") from error
        except OSError as error:
            raise LinkClosed(f"{self._name}: {_reason(error)}") from error

    def read(self, timeout_s: float) -> bytes:
        try:
            self._port.timeout = timeout_s
            received: bytes = self._port.read(1)
            return received + self._port.read(self._port.in_waiting) if received else received
        except OSError as error:
            raise LinkClosed(f"{self._name}: {_reason(error)}") from error


def _reason(error: OSError) -> str:
    """What the system says, without what pyserial wraps around it."""
    return os.strerror(error.errno) if error.errno else str(error)


class Progress(ctypes.Structure):
    """As device_progress_t of estimator_c/device/device.h."""

    _fields_ = (("taken", ctypes.c_size_t), ("given", ctypes.c_size_t))


class Identity(ctypes.Structure):
    """As device_identity_t of estimator_c/device/device.h."""

    _fields_ = (
        ("catalogue_hash", ctypes.c_uint32),
        ("boot_nonce", ctypes.c_uint32),
        ("input_blocks", ctypes.c_uint8),
        ("firmware_id", ctypes.c_uint8),
    )


def load_library(library: Path, functions: Iterable[str]) -> ctypes.CDLL:
    """The project's library of the device, or a user's own, with these functions in it.

    :raises LinkError: the project's was not built.
    :raises ConfigurationError: the user's cannot be loaded, or lacks one of them.
    """
    try:
        c = ctypes.CDLL(str(library))
    except OSError as error:
        if library == LIBRARY:
            raise LinkError(f"{library} cannot be loaded: run `make setup` ({error})") from error
        reason = str(error).removeprefix(f"{library}: ")
        raise ConfigurationError(f"{library}: cannot be loaded as a library of a device: {reason}") from error
    lacking = [function for function in functions if not hasattr(c, function)]
    if lacking:
        raise ConfigurationError(
            f"{library}: is no library of a device: it lacks {', '.join(lacking)}"
            ' (harness/README.md, "Your own estimator", says what to compile)'
        )
    return c


class MemoryWire:
    """A device in this very process: the same C, the same frames, no operating system between, and no real time."""

    name = "memory"

    def __init__(
        self,
        boot_nonce: int,
        *,
        catalogue_hash: int = CATALOGUE_HASH,
        clock: VirtualClock | None = None,
        input_blocks: int = _ALWAYS_ROOM,
        library: Path = LIBRARY,
    ) -> None:
        """Boot a device; another ``catalogue_hash`` makes it a stranger.

        :raises LinkError: the device library was not built.
        :raises ConfigurationError: that of a user is none.
        """
        c = load_library(library, ("serial_device_size", "serial_device_init", "serial_device_run"))
        c.serial_device_run.restype = Progress
        c.serial_device_size.restype = ctypes.c_size_t
        self._run = c.serial_device_run
        self._init = c.serial_device_init
        self._catalogue_hash, self._input_blocks = catalogue_hash, input_blocks
        self._device = ctypes.create_string_buffer(c.serial_device_size())
        self._output = ctypes.create_string_buffer(_READ_BYTES)
        self._answers = b""
        self.clock = VirtualClock() if clock is None else clock
        self.boot(boot_nonce)

    def boot(self, boot_nonce: int) -> None:
        """As if it had been switched off and on: it begins anew, and what it was saying is lost."""
        self._answers = b""
        self._init(
            self._device,
            ctypes.byref(Identity(self._catalogue_hash, boot_nonce, self._input_blocks, FirmwareId.LIBRARY)),
        )

    def write(self, sent: bytes) -> None:
        while True:
            progress = self._run(
                self._device, sent, ctypes.c_size_t(len(sent)), self._output, ctypes.c_size_t(_READ_BYTES)
            )
            self._answers += ctypes.string_at(self._output, progress.given)
            sent = sent[progress.taken :]
            if not progress.given and not sent:
                return

    def read(self, timeout_s: float) -> bytes:
        """What the device has answered; if that is nothing, nothing will come, and the clock goes on."""
        answers, self._answers = self._answers, b""
        if not answers:
            self.clock.advance(timeout_s)
        return answers

    def close(self) -> None:
        """Nothing is held."""
