"""Messages of a LUCIDAC: protobuf envelopes, each behind its length as a varint.

The classes come from the package pybrid-computing (extra ``lucidac``), which is imported on first use.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any

from analogrig import ConfigurationError

PORT = 5732
MOST_FRAME_BYTES = 262_084
"""Longest frame that the manufacturer's client takes."""

_MOST_VARINT_BYTES = 10


class FrameError(Exception):
    """Bytes that are no frame, or too long a one: what follows cannot be read either."""


@functools.cache
def protocol() -> Any:
    """Module with the message classes.

    :raises ConfigurationError: the package is not installed.
    """
    try:
        return importlib.import_module("pybrid.base.proto.main_pb2")
    except ImportError as error:
        raise ConfigurationError(
            f"LUCIDAC: needs pybrid-computing: pip install 'analogrig[lucidac]' ({error})"
        ) from error


def enum_name(kind: Any, value: int) -> str:
    """Name of an enumerated value; empty for one that the protocol does not define."""
    return str(kind.Name(value)) if value in kind.values() else ""


def parse_envelope(content: bytes) -> Any:
    """Envelope of a frame's content; None if it is malformed, such as nested too deeply."""
    malformed: type[Exception] = importlib.import_module("google.protobuf.message").DecodeError
    try:
        return protocol().Envelope.FromString(content)
    except malformed:
        return None


def frame(message: Any, envelope_version: Any = None) -> bytes:
    """Frame with a MessageV1."""
    envelope = protocol().Envelope(message_v1=message)
    if envelope_version is not None:
        envelope.version.CopyFrom(envelope_version)
    return framed(envelope)


def framed(envelope: Any) -> bytes:
    """Frame with an envelope."""
    content: bytes = envelope.SerializeToString()
    length, head = len(content), bytearray()
    while length >= 0x80:
        head.append(length & 0x7F | 0x80)
        length >>= 7
    return bytes((*head, length)) + content


class FrameReader:
    """Cuts a stream of bytes into the contents of frames."""

    def __init__(self, most_bytes: int = MOST_FRAME_BYTES) -> None:
        self._most_bytes = most_bytes
        self._input = bytearray()

    def feed(self, data: bytes) -> None:
        """Add bytes of the stream."""
        self._input += data

    def next(self) -> bytes | None:
        """Content of the next frame, or None if more bytes are needed.

        :raises FrameError: the stream cannot be read on.
        """
        length = 0
        for i, byte in enumerate(self._input[:_MOST_VARINT_BYTES]):
            length |= (byte & 0x7F) << 7 * i
            if length > self._most_bytes:
                raise FrameError(f"a frame has at most {self._most_bytes} bytes")
            if byte < 0x80:
                stop = i + 1 + length
                if len(self._input) < stop:
                    return None
                content = bytes(self._input[i + 1 : stop])
                del self._input[:stop]
                return content
        if len(self._input) >= _MOST_VARINT_BYTES:
            raise FrameError(f"a length has at most {_MOST_VARINT_BYTES} bytes")
        return None
