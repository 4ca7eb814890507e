"""Wires: lines that carry bytes to a device and back, unchanged."""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import time
from collections.abc import Callable
from typing import Protocol

import serial
from serial.urlhandler import protocol_socket

from analogrig.errors import ConfigurationError, LinkClosed, LinkError

DEFAULT_BAUD = 115_200
WRITE_TIMEOUT_S = 10.0

_READ_BYTES = 65_536
_POLL_S = 1e-3
"""Resolution of poll(). In real time, messages of samples are shorter."""

Clock = Callable[[], float]
"""Monotonic time [s] from an arbitrary origin."""


class VirtualClock:
    """A clock that stands still until it is advanced. Time-outs cost no time and are reproducible."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def __call__(self) -> float:
        return self._now_s

    def advance(self, by_s: float) -> None:
        self._now_s += by_s


class Connection(Protocol):
    """Common part of wires, CAN buses and links."""

    @property
    def name(self) -> str:
        """Name for errors and records."""

    @property
    def clock(self) -> Clock:
        """Clock of its time-outs."""

    def close(self) -> None:
        """Release the line. May be called twice."""


class Wire(Connection, Protocol):
    """A line that carries bytes to one device."""

    def write(self, sent: bytes) -> None:
        """Send all bytes.

        :raises LinkError: they cannot be sent.
        """

    def read(self, timeout_s: float) -> bytes:
        """Received bytes; at least one, unless the time-out has passed or is about to.

        :raises LinkClosed: the other end has hung up.
        """


class DescriptorWire:
    """A wire on a file descriptor: a terminal, one end of a socket pair; or on two: pipes."""

    def __init__(self, fd: int, name: str, *, write_fd: int = -1) -> None:
        """Take over ``fd``, and ``write_fd`` if another descriptor is written to."""
        self.name = name
        self.clock: Clock = time.monotonic
        self._fd = fd
        self._write_fd = fd if write_fd < 0 else write_fd
        os.set_blocking(fd, False)
        os.set_blocking(self._write_fd, False)
        self._readable = select.poll()
        self._readable.register(fd, select.POLLIN)
        self._writable = select.poll()
        self._writable.register(self._write_fd, select.POLLOUT)

    def write(self, sent: bytes) -> None:
        try:
            sent = sent[self._take(sent) :]
            if sent:
                self._write_rest(sent, self.clock() + WRITE_TIMEOUT_S)
        except OSError as error:
            raise LinkClosed(f"{self.name}: {_reason(error)}") from error

    def _write_rest(self, sent: bytes, deadline_s: float) -> None:
        """Write in pieces, each when the other end has room for it."""
        while sent:
            if not self._writable.poll(math.ceil(max(0.0, deadline_s - self.clock()) * 1000.0)):
                raise LinkError(f"{self.name}: nothing can be sent: the other end does not read")
            sent = sent[self._take(sent) :]

    def _take(self, sent: bytes) -> int:
        """Number of bytes that the line accepts without waiting."""
        try:
            return os.write(self._write_fd, sent)
        except BlockingIOError:
            return 0

    def read(self, timeout_s: float) -> bytes:
        try:
            if not self._readable.poll(int(timeout_s * 1000.0)):
                if timeout_s >= _POLL_S:
                    return b""  # the caller asks again for the remaining fraction
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
        descriptors, self._fd, self._write_fd = {self._fd, self._write_fd} - {-1}, -1, -1
        for fd in descriptors:
            with contextlib.suppress(OSError):
                os.close(fd)


class PortWire:
    """A wire that pyserial opens: ``/dev/ttyUSB0``, a pseudo-terminal, ``socket://host:port``, ``loop://``."""

    def __init__(self, url: str, baud: int = DEFAULT_BAUD, *, name: str | None = None) -> None:
        """Open ``url``, exclusively where the system supports that.

        :raises ConfigurationError: pyserial has no handler for the URL.
        :raises LinkError: it cannot be opened.
        """
        self.name = url if name is None else name
        self.clock: Clock = time.monotonic
        try:
            self._port = serial.serial_for_url(url, baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
        except OSError as error:
            raise LinkError(f"cannot open {url}: {_reason(error)}") from error
        except Exception as error:  # pyserial's URL handlers raise exceptions of any type
            raise ConfigurationError(f"{url}: not a serial port or URL that pyserial understands: {error}") from error
        # Bypass pyserial on a descriptor: its read() and write() cost as much as a whole exchange, or ten on a socket.
        handler: type = type(self._port)
        has_descriptor = handler in (serial.Serial, protocol_socket.Serial)
        self._descriptor = DescriptorWire(self._port.fileno(), self.name) if has_descriptor else None
        if handler is protocol_socket.Serial:
            _send_at_once(self._port.fileno())

    def write(self, sent: bytes) -> None:
        if self._descriptor is not None:
            self._descriptor.write(sent)
            return
        try:
            self._port.write(sent)
        except serial.SerialTimeoutException as error:
            raise LinkError(f"{self.name}: nothing can be sent: the other end does not read") from error
        except OSError as error:
            raise LinkClosed(f"{self.name}: {_reason(error)}") from error

    def read(self, timeout_s: float) -> bytes:
        if self._descriptor is not None:
            return self._descriptor.read(timeout_s)
        try:
            self._port.timeout = timeout_s
            received: bytes = self._port.read(1)
            return received + self._port.read(self._port.in_waiting) if received else received
        except OSError as error:
            raise LinkClosed(f"{self.name}: {_reason(error)}") from error

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()


def _send_at_once(fd: int) -> None:
    """Send small messages without waiting for the acknowledgement of earlier ones, which takes up to 40 ms."""
    with socket.socket(fileno=os.dup(fd)) as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _reason(error: OSError) -> str:
    """Message of the operating system, without the text that pyserial adds."""
    if error.errno is None and isinstance(error.__context__, OSError):
        error = error.__context__  # a handler of URLs hides it
    if error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return error.strerror or str(error)
