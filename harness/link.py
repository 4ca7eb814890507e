"""Links: what carries messages to a device and back, and nothing else."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import select
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

import serial

from harness import frame
from harness.catalogue import CATALOGUE_HASH, FirmwareId, Message, pack, unpack
from harness.errors import ConfigurationError, LinkClosed, LinkError

DEFAULT_BAUD = 115_200
WRITE_TIMEOUT_S = 2.0

_READ_BYTES = 65_536

Clock = Callable[[], float]
"""Seconds from any beginning, never backwards."""


class Link(Protocol):
    """A line to one device."""

    @property
    def name(self) -> str:
        """What it is, for errors and records."""

    @property
    def dropped(self) -> int:
        """How many frames from the device were no good."""

    def send(self, messages: Iterable[Message]) -> None:
        """Send the messages, in one go where the line can.

        :raises LinkError: they cannot be sent.
        """

    def receive(self, timeout_s: float) -> Message | None:
        """The next message, or None if none comes in time.

        :raises LinkClosed: the other end is gone.
        """

    def close(self) -> None:
        """Let go of the line. May be called twice."""


class _Inbox:
    """Received bytes to messages, in the order they came."""

    def __init__(self) -> None:
        self._decoder = frame.FrameDecoder()
        self._messages: deque[Message] = deque()

    @property
    def dropped(self) -> int:
        return self._decoder.dropped

    def put(self, received: bytes) -> None:
        for packet in self._decoder.feed(received):
            message = unpack(packet)
            if message is not None:
                self._messages.append(message)

    def take(self) -> Message | None:
        return self._messages.popleft() if self._messages else None


class SerialLink:
    """Frames over anything pyserial can open: ``/dev/ttyUSB0``, a pseudo-terminal, ``socket://host:port``, ``loop://``."""

    def __init__(
        self,
        url: str,
        baud: int = DEFAULT_BAUD,
        *,
        name: str | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        """Open ``url``; where the system can, nobody else may open it meanwhile.

        :raises ConfigurationError: pyserial knows no such kind of URL.
        :raises LinkError: it cannot be opened.
        """
        self.name = url if name is None else name
        self._clock = clock
        self._inbox = _Inbox()
        try:
            self._port = serial.serial_for_url(url, baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
        except OSError as error:
            raise LinkError(f"cannot open {url}: {_reason(error)}") from error
        except Exception as error:  # the handlers of pyserial's URLs raise whatever a wrong URL makes them
            raise ConfigurationError(f"{url}: not a serial port or URL that pyserial understands: {error}") from error
        # A plain file descriptor is used as one: pyserial's read() and write() cost as much as a whole exchange.
        self._fd = self._port.fileno() if type(self._port) is serial.Serial else None
        self._poll = select.poll()
        if self._fd is not None:
            self._poll.register(self._fd, select.POLLIN)

    @property
    def dropped(self) -> int:
        return self._inbox.dropped

    def send(self, messages: Iterable[Message]) -> None:
        frames = b"".join([frame.encode(pack(message)) for message in messages])
        try:
            self._write(frames)
        except serial.SerialTimeoutException as error:
            raise LinkError(f"{self.name}: nothing can be sent, the other end takes nothing") from error
        except OSError as error:
            raise LinkClosed(f"{self.name}: {_reason(error)}") from error

    def receive(self, timeout_s: float) -> Message | None:
        message = self._inbox.take()
        if message is not None:
            return message
        deadline_s = self._clock() + timeout_s
        while True:
            self._inbox.put(self._read(max(0.0, deadline_s - self._clock())))
            message = self._inbox.take()
            if message is not None or self._clock() >= deadline_s:
                return message

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()

    def _write(self, frames: bytes) -> None:
        if self._fd is not None:
            with contextlib.suppress(BlockingIOError):
                frames = frames[os.write(self._fd, frames) :]
        if frames:
            self._port.write(frames)

    def _read(self, timeout_s: float) -> bytes:
        """What has come, at least one byte unless the time is over."""
        try:
            return self._read_port(timeout_s) if self._fd is None else self._read_fd(self._fd, timeout_s)
        except OSError as error:
            raise LinkClosed(f"{self.name}: {_reason(error)}") from error

    def _read_fd(self, fd: int, timeout_s: float) -> bytes:
        if not self._poll.poll(math.ceil(timeout_s * 1000.0)):
            return b""
        received = os.read(fd, _READ_BYTES)
        if not received:
            raise LinkClosed(f"{self.name}: the other end has hung up")
        return received

    def _read_port(self, timeout_s: float) -> bytes:
        self._port.timeout = timeout_s
        received: bytes = self._port.read(1)
        return received + self._port.read(self._port.in_waiting) if received else received


def _reason(error: OSError) -> str:
    """What the system says, without what pyserial wraps around it."""
    return os.strerror(error.errno) if error.errno else str(error)


LIBRARY = Path(__file__).with_name("_device.so")


class _Progress(ctypes.Structure):
    """As device_progress_t of estimator_c/device/device.h."""

    _fields_ = (("taken", ctypes.c_size_t), ("given", ctypes.c_size_t))


class _Identity(ctypes.Structure):
    """As device_identity_t of estimator_c/device/device.h."""

    _fields_ = (
        ("catalogue_hash", ctypes.c_uint32),
        ("boot_nonce", ctypes.c_uint32),
        ("firmware_id", ctypes.c_uint8),
    )


class MemoryLink:
    """A device in this very process: the same C, the same frames, no operating system between."""

    name = "memory"

    def __init__(self, boot_nonce: int, *, catalogue_hash: int = CATALOGUE_HASH, library: Path = LIBRARY) -> None:
        """Boot a device; another ``catalogue_hash`` makes it a stranger.

        :raises LinkError: the device library was not built.
        """
        try:
            c = ctypes.CDLL(str(library))
        except OSError as error:
            raise LinkError(f"{library} cannot be loaded: run `make setup` ({error})") from error
        c.device_run.restype = _Progress
        c.device_size.restype = ctypes.c_size_t
        self._run = c.device_run
        self._device = ctypes.create_string_buffer(c.device_size())
        self._output = ctypes.create_string_buffer(_READ_BYTES)
        self._inbox = _Inbox()
        identity = _Identity(catalogue_hash, boot_nonce, FirmwareId.LIBRARY)
        c.device_init(self._device, ctypes.byref(identity))

    @property
    def dropped(self) -> int:
        return self._inbox.dropped

    def send(self, messages: Iterable[Message]) -> None:
        self.send_bytes(b"".join([frame.encode(pack(message)) for message in messages]))

    def send_bytes(self, received: bytes) -> None:
        """What the device receives, good frames or not; its answers wait for receive()."""
        while True:
            progress = self._run(
                self._device, received, ctypes.c_size_t(len(received)), self._output, ctypes.c_size_t(_READ_BYTES)
            )
            self._inbox.put(ctypes.string_at(self._output, progress.given))
            received = received[progress.taken :]
            if not progress.given and not received:
                return

    def receive(self, timeout_s: float) -> Message | None:  # noqa: ARG002 - what is not there now will never come
        return self._inbox.take()

    def close(self) -> None:
        """Nothing is held."""
