"""Links to a device: wires that carry bytes, frames in the bytes, and messages in the frames.

Serial framing of a packet is ``0x00 | COBS(packet, CRC-32C) | 0x00``; see estimator_c/device/frame.h. The checksum
starts from the hash of the message catalogue. Messages that must be readable without it start from 0.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import anycrc
import serial
from cobs import cobs
from serial.urlhandler import protocol_socket

from analogrig.catalogue import (
    CATALOGUE_HASH,
    LAYOUTS,
    Message,
    pack,
    unpack_all,
)
from analogrig.errors import ConfigurationError, LinkClosed, LinkError
from analogrig.wording import number_of

if TYPE_CHECKING:
    import can

    from analogrig.links.line import Line, SerialLine
    from analogrig.links.wire_faults import FaultyLine

__all__ = ["CanListener", "DescriptorWire", "Identifier", "Wire", "identifier_text"]
"""Names for packages beside the core."""

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
            deadline_s = self.clock() + WRITE_TIMEOUT_S if sent else 0.0
            while sent:  # in pieces, each when the other end has room for it
                if not self._writable.poll(math.ceil(max(0.0, deadline_s - self.clock()) * 1000.0)):
                    raise LinkError(f"{self.name}: nothing can be sent: the other end does not read")
                sent = sent[self._take(sent) :]
        except OSError as error:
            raise LinkClosed(f"{self.name}: {_reason(error)}") from error

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
            # Send small messages without waiting for the acknowledgement of earlier ones, which takes up to 40 ms.
            with socket.socket(fileno=os.dup(self._port.fileno())) as line:
                line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

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


def _reason(error: OSError) -> str:
    """Message of the operating system, without the text that pyserial adds."""
    if error.errno is None and isinstance(error.__context__, OSError):
        error = error.__context__  # a handler of URLs hides it
    if error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return error.strerror or str(error)


_CRC_BYTES = 4
_LENGTHS = {layout.id: 1 + layout.length + _CRC_BYTES for layout in LAYOUTS.values()}
"""Bytes of the content before COBS, by identifier."""
_UNSEEDED = frozenset(layout.id for layout in LAYOUTS.values() if not layout.seeded)

MAX_ENCODED = max(_LENGTHS.values()) + 1
"""Most bytes between two zeros: COBS adds one byte to a content of less than 254."""

_RESIDUE = 0x48674BC7
"""CRC-32C of any message followed by its own CRC-32C, for every seed."""

_crc = anycrc.Model("CRC32C").calc


def frame_size(message_type: type[Message]) -> int:
    """Number of bytes in the frame of a message."""
    return _LENGTHS[LAYOUTS[message_type.__name__].id] + 3  # one byte of COBS, two zeros


def encode_frame(packet: bytes, catalogue_hash: int = CATALOGUE_HASH) -> bytes:
    """Frame of a packet."""
    crc = _crc(packet, 0 if packet[0] in _UNSEEDED else catalogue_hash)
    content: bytes = packet + crc.to_bytes(_CRC_BYTES, "little")
    return b"".join((b"\0", cobs.encode(content), b"\0"))


class FrameDecoder:
    """Decoder of a byte stream, fed in pieces of any size.

    Bytes between two zeros that are no valid frame are dropped as a whole and counted once. The decoder buffers at most
    one frame.
    """

    def __init__(self, catalogue_hash: int = CATALOGUE_HASH) -> None:
        self.dropped = 0
        """Number of dropped frames."""
        self._hash = catalogue_hash
        self._begun = b""

    def feed(self, received: bytes) -> list[bytes]:
        """Packets that ``received`` completes, in order."""
        chunks = (self._begun + received).split(b"\0")
        self._begun = chunks.pop()[: MAX_ENCODED + 1]  # one byte more shows that it is too long
        packets = []
        for chunk in chunks:
            if not chunk:
                continue
            packet = self._decode(chunk)
            if packet is None:
                self.dropped += 1
            else:
                packets.append(packet)
        return packets

    def _decode(self, chunk: bytes) -> bytes | None:
        try:
            content = cobs.decode(chunk)
        except cobs.DecodeError:
            return None
        if not content or len(content) != _LENGTHS.get(content[0]):
            return None
        if _crc(content, 0 if content[0] in _UNSEEDED else self._hash) != _RESIDUE:
            return None
        return bytes(content[:-_CRC_BYTES])


CanListener = Callable[["can.Message"], object]
"""Callback for every frame on a CAN bus, such as a log writer of python-can. ``is_rx`` is False for frames of the
harness; ``timestamp`` is the link's clock."""

Identifier = tuple[int, bool]
"""Arbitration identifier, and True if it is one of 29 bits."""


def identifier_text(identifier: Identifier) -> str:
    """Identifier as candump writes it: three digits for one of 11 bits, eight for one of 29."""
    number, is_extended = identifier
    return f"{number:0{8 if is_extended else 3}X}"


class Link(Connection, Protocol):
    """A line that carries messages to one device."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Counts, by name, of input that was no message of the device. ``frames_dropped`` counts damaged frames."""

    @property
    def trouble(self) -> str:
        """Known problems of the line, which may explain a silent device; may be empty."""

    @property
    def line(self) -> Line | None:
        """Speed of the line, if it is known."""

    @property
    def line_s(self) -> float:
        """Time that all traffic so far would take at that speed [s]; 0.0 if the speed is unknown."""

    @property
    def carries_blocks(self) -> bool:
        """True if a SampleBlock fits into a message; False if only messages of 8 bytes do."""

    @property
    def unread_n(self) -> int | None:
        """Largest number of received messages that the system buffers; None if it is unlimited."""

    @property
    def faulty(self) -> FaultyLine[Any, Any] | None:
        """Line that applies faults to its frames; None if it was opened without faults."""

    @property
    def unread(self) -> deque[Message]:
        """Messages that have come and are not yet received."""

    def listen(self, listener: CanListener) -> None:
        """Report all CAN frames to the listener from now on; a link without any ignores it."""

    def send(self, messages: Iterable[Message]) -> None:
        """Send the messages, in one write where the line allows it.

        :raises LinkError: they cannot be sent.
        """

    def receive(self, timeout_s: float) -> Message | None:
        """The next message, or None after the time-out.

        :raises LinkClosed: the other end has hung up.
        """


class FramedLink:
    """Link that carries messages in frames over a wire, in order."""

    carries_blocks = True
    unread_n = None

    def __init__(
        self, wire: Wire, line: SerialLine | None = None, *, faulty: FaultyLine[Any, Any] | None = None
    ) -> None:
        """Take over ``wire``.

        :param line: its speed, or that of the serial line that it stands for.
        :param faulty: the wire itself, if it applies faults.
        """
        self.wire = wire
        self.name = wire.name
        self.clock = wire.clock
        self.line_s = 0.0
        self.line = line
        self.faulty = faulty
        self._decoder = FrameDecoder()
        self.unread: deque[Message] = deque()
        self._unknown_n = self._received_n = self._valid_n = 0

    @property
    def trouble(self) -> str:
        if self._valid_n:
            return ""
        if not self._received_n:
            return "no byte came"
        return f"{number_of(self._received_n, 'byte')} came without a valid frame: another speed, or another protocol"

    @property
    def counters(self) -> Mapping[str, int]:
        return {"frames_dropped": self._decoder.dropped + self._unknown_n}

    def listen(self, listener: CanListener) -> None:
        """Do nothing: a wire carries no CAN frames."""

    def send(self, messages: Iterable[Message]) -> None:
        sent = b"".join([encode_frame(pack(message)) for message in messages])
        if self.line is not None:  # both directions add up, since lock-step uses one at a time
            self.line_s += self.line.bytes_s(len(sent))
        self.wire.write(sent)

    def receive(self, timeout_s: float) -> Message | None:
        if self.unread:
            return self.unread.popleft()
        deadline_s, left_s = self.clock() + timeout_s, timeout_s
        while True:
            self._enter(self.wire.read(left_s))
            if self.unread:
                return self.unread.popleft()
            left_s = deadline_s - self.clock()
            if left_s <= 0.0:
                return None

    def close(self) -> None:
        self.wire.close()

    def _enter(self, received: bytes) -> None:
        if self.line is not None:
            self.line_s += self.line.bytes_s(len(received))
        self._received_n += len(received)
        packets = self._decoder.feed(received)
        messages = unpack_all(packets)
        self.unread += messages
        self._valid_n += len(messages)
        self._unknown_n += len(packets) - len(messages)
