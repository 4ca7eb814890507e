"""Framers: mark where a message begins and ends in a stream of bytes.

A framer knows nothing of the content. ``feed`` takes pieces of any length, because a line delivers bytes in pieces of
its own. Bytes that belong to no frame are dropped and counted.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from cobs import cobs

MOST_FRAME = 4096
"""Most bytes of a frame or a line."""

Framing = Literal["lines", "cobs", "slip", "length", "delimiter", "none"]

LENGTHS = {"u8": "B", "u16": "<H", "u16be": ">H", "u32": "<I", "u32be": ">I"}
"""Layout of each type of a length field, for ``struct``."""


class Framer(ABC):
    """Framer of one direction of a line."""

    is_bare = False
    """True if a frame is its content and nothing else."""

    def __init__(self) -> None:
        self.dropped = 0
        """Number of dropped stretches of bytes."""
        self.tail = b""
        """Bytes of a frame that is not complete."""

    @abstractmethod
    def frame(self, content: bytes) -> bytes:
        """Return the frame of ``content``."""

    def feed(self, received: bytes) -> list[bytes]:
        """Return the contents of the frames that ``received`` completes, in order."""
        self.tail += received
        return list(self._cut())

    def _cut(self) -> Iterator[bytes]:
        """Cut complete frames off the tail."""
        raise NotImplementedError

    def prefix(self, content_n: int) -> tuple[bytes, bytes]:  # noqa: ARG002 - only some framings have any
        """Return header and length field in front of ``content_n`` bytes."""
        return b"", b""

    def forget(self) -> None:
        """Discard the bytes of an incomplete frame."""
        self.tail = b""


class LineFramer(Framer):
    """Lines of text that end with CR, LF or both. The content that is sent includes its line end."""

    is_bare = True

    def __init__(self) -> None:
        super().__init__()
        self._is_after_cr = False

    def frame(self, content: bytes) -> bytes:
        return content

    def feed(self, received: bytes) -> list[bytes]:
        if self._is_after_cr and received:  # CR and LF came in two reads
            received = received.removeprefix(b"\n")
            self._is_after_cr = False
        if b"\r" in received:
            self._is_after_cr = received.endswith(b"\r")
            received = received.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        *lines, self.tail = (self.tail + received).split(b"\n")
        return lines

    def forget(self) -> None:
        super().forget()
        self._is_after_cr = False


class EscapedFramer(Framer):
    """Frames that end with a byte which an encoding keeps out of the content: COBS and SLIP."""

    def __init__(self, end: bytes, encode: Callable[[bytes], bytes], decode: Callable[[bytes], bytes]) -> None:
        super().__init__()
        self._end, self._encode, self._decode = end, encode, decode

    def frame(self, content: bytes) -> bytes:
        return self._encode(content) + self._end

    def _cut(self) -> Iterator[bytes]:
        *frames, self.tail = self.tail.split(self._end)
        for each in filter(None, frames):
            try:
                yield self._decode(each)
            except (ValueError, cobs.DecodeError):
                self.dropped += 1


def _encode_slip(content: bytes) -> bytes:
    return content.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc")


def _decode_slip(frame: bytes) -> bytes:
    """:raises ValueError: an escape byte is followed by another byte than the two that RFC 1055 defines."""
    first, *pieces = frame.split(b"\xdb")
    if not all(piece[:1] in (b"\xdc", b"\xdd") for piece in pieces):
        raise ValueError("wrong escape sequence")
    return first + b"".join((b"\xc0" if piece[0] == 0xDC else b"\xdb") + piece[1:] for piece in pieces)


class HeaderFramer(Framer):
    """Base of framings in which the content is not encoded. Each frame begins with ``header``, which may be empty."""

    def __init__(self, header: bytes) -> None:
        super().__init__()
        self._header = header

    def frame(self, content: bytes) -> bytes:
        return b"".join(self.prefix(len(content))) + content

    def prefix(self, content_n: int) -> tuple[bytes, bytes]:  # noqa: ARG002
        return self._header, b""

    def _is_at_header(self) -> bool:
        """Drop what precedes the next header. True if the tail begins with one."""
        if self.tail.startswith(self._header):
            return True
        at = self.tail.find(self._header)
        is_part = next((n for n in range(len(self._header) - 1, 0, -1) if self.tail.endswith(self._header[:n])), 0)
        cut = len(self.tail) - is_part if at < 0 else at
        self.dropped += cut > 0
        self.tail = self.tail[cut:]
        return at >= 0


class RecordFramer(HeaderFramer):
    """Contents of a fixed number of bytes, one behind the other."""

    def __init__(self, header: bytes, content_n: int) -> None:
        super().__init__(header)
        self._content_n = content_n
        self.is_bare = not header

    def _cut(self) -> Iterator[bytes]:
        begin, end = len(self._header), len(self._header) + self._content_n
        if not begin:
            at, data = len(self.tail) // end * end, self.tail
            self.tail = data[at:]
            yield from (data[i : i + end] for i in range(0, at, end))
            return
        while self._is_at_header() and len(self.tail) >= end:
            content, self.tail = self.tail[begin:end], self.tail[end:]
            yield content


class LengthFramer(HeaderFramer):
    """Contents behind a length field."""

    def __init__(self, header: bytes, layout: str, extra: int) -> None:
        """``extra`` is the value of the length field minus the number of bytes of the content."""
        super().__init__(header)
        self._layout, self._extra = struct.Struct(layout), extra

    def prefix(self, content_n: int) -> tuple[bytes, bytes]:
        return self._header, self._layout.pack(content_n + self._extra)

    def _cut(self) -> Iterator[bytes]:
        begin = len(self._header) + self._layout.size
        while self._is_at_header() and len(self.tail) >= begin:
            (length,) = self._layout.unpack_from(self.tail, len(self._header))
            end = begin + length - self._extra
            if not begin < end <= begin + MOST_FRAME:  # no length: look for the next header, or at the next byte
                self.tail = self.tail[max(1, len(self._header)) :]
                self.dropped += 1
            elif len(self.tail) < end:
                return
            else:
                content, self.tail = self.tail[begin:end], self.tail[end:]
                yield content


class DelimiterFramer(HeaderFramer):
    """Contents that end with a delimiter. A content of ``content_n`` bytes may contain it; others may not."""

    def __init__(self, header: bytes, delimiter: bytes, content_n: int | None) -> None:
        super().__init__(header)
        self._delimiter, self._content_n = delimiter, content_n

    def frame(self, content: bytes) -> bytes:
        return super().frame(content) + self._delimiter

    def _cut(self) -> Iterator[bytes]:
        begin, delimiter = len(self._header), self._delimiter
        while self.tail and self._is_at_header():
            at = self.tail.find(delimiter, begin)
            if self._content_n is not None and 0 <= at < begin + self._content_n:
                full = begin + self._content_n
                if len(self.tail) < full + len(delimiter):
                    return
                if self.tail.startswith(delimiter, full):
                    at = full
            if at < 0:
                return
            content, self.tail = self.tail[begin:at], self.tail[at + len(delimiter) :]
            if content:
                yield content


@dataclass(frozen=True)
class FrameLayout:
    """Where a message begins and ends on a line, in both directions."""

    framing: Framing
    header: bytes = b""
    delimiter: bytes = b""
    length: str = "u8"
    length_extra: int = 0

    def framer(self, content_n: int | None) -> Framer:
        """Framer of contents of ``content_n`` bytes; None for contents of any length."""
        match self.framing:
            case "cobs":
                return EscapedFramer(b"\0", cobs.encode, cobs.decode)
            case "slip":
                return EscapedFramer(b"\xc0", _encode_slip, _decode_slip)
            case "length":
                return LengthFramer(self.header, LENGTHS[self.length], self.length_extra)
            case "delimiter":
                return DelimiterFramer(self.header, self.delimiter, content_n)
            case "none" if content_n is not None:
                return RecordFramer(self.header, content_n)
        return LineFramer()
