"""Messages of the catalogue as types, and their encoding in packets.

estimator_c/catalogue/analogrig.dbc defines the messages and their meaning; the layouts here are generated from it. A
*packet* is the unit of every link: one byte of identifier, then the payload.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from math import isfinite
from struct import Struct
from typing import Any, NamedTuple

from analogrig._catalogue import *  # noqa: F403 - the generated names, for import from here
from analogrig._catalogue import LAYOUTS, Message, SampleBlock, SteppedFlag

BLOCK_SAMPLES = sum(name.startswith("force") for name in LAYOUTS["SampleBlock"].fields)
"""Samples in a full SampleBlock."""

RUN_SHIFT, _RUN_BITS = LAYOUTS["Stepped"].bits["run"]
"""First bit of the run id in the flags of samples and their answers."""
RUNS = 1 << _RUN_BITS
"""Modulus of run ids."""

SEQS = 1 << 8
"""Modulus of sequence numbers."""
INDICES = 1 << 16
"""Modulus of sample indices in messages."""

STEPPED_FLAGS = sum(SteppedFlag)
"""All bits of the flags of Stepped except the run id."""


class _Codec(NamedTuple):
    """Encoding of one type of message."""

    identifier: bytes
    length: int
    pack: Callable[..., bytes]
    unpack: Callable[[bytes, int], tuple[Any, ...]]
    make: Callable[[tuple[Any, ...]], Message]


def pack(message: Message) -> bytes:
    """Packet of a message.

    :raises struct.error: a value is out of the range of its field.
    """
    codec = _BY_TYPE[type(message)]
    return codec.identifier + codec.pack(*message)


def unpack(packet: bytes) -> Message | None:
    """Message in a packet; None if the catalogue has none of that length, or its value is not finite."""
    message = unpack_any(packet)
    return message if message is not None and is_finite(message) else None


def unpack_any(packet: bytes) -> Message | None:
    """Message in a packet; None if the catalogue has none of that length. Its value may be NaN or infinite."""
    return next(iter(unpack_all([packet])), None)


def unpack_all(packets: Iterable[bytes]) -> list[Message]:
    """Messages in the packets, as ``unpack_any``, without those that hold none."""
    messages = []
    for packet in packets:
        codec = _BY_IDENTIFIER.get(packet[0]) if packet else None
        if codec is not None and len(packet) == codec.length:
            messages.append(codec.make(codec.unpack(packet, 1)))
    return messages


def is_finite(message: Message) -> bool:
    """True unless the message has a value that is NaN or infinite."""
    value = message[-1]
    return not isinstance(value, float) or isfinite(value)


def brief(message: Message) -> str:
    """Type of a message, with its sample index if it has one."""
    index = getattr(message, "sample_index", None)
    return type(message).__name__ if index is None else f"{type(message).__name__} {index}"


def index_up_to(most: int, wire_index: int) -> int:
    """Last sample up to ``most`` whose index in a message is ``wire_index``."""
    return most - (most - wire_index) % INDICES


def _codec(message_type: Any) -> _Codec:
    layout = LAYOUTS[message_type.__name__]
    codes = dict(zip(layout.fields, layout.format.strip("<x"), strict=False))
    if codes["seq"] != "B" or codes.get("sample_index", "H") != "H":
        raise TypeError(f"{message_type.__name__}: seq is not modulo {SEQS}, or sample_index is not modulo {INDICES}")
    if layout.bits.get("run", (RUN_SHIFT, _RUN_BITS)) != (RUN_SHIFT, _RUN_BITS):
        raise TypeError(f"{message_type.__name__} has its run id at other bits than Stepped")
    if "f" in layout.format[:-1]:
        raise TypeError(f"{message_type.__name__} has a float that is not its last field")
    struct = Struct(layout.format)
    identifier, length = bytes([layout.id]), 1 + layout.length
    if message_type is not SampleBlock:
        return _Codec(identifier, length, struct.pack, struct.unpack_from, partial(tuple.__new__, message_type))
    return _Codec(
        identifier,
        length,
        pack=lambda *fields: struct.pack(*fields[:4], *fields[4]),
        unpack=struct.unpack_from,
        make=lambda values: SampleBlock(values[0], values[1], values[2], values[3], values[4:]),
    )


_BY_TYPE = {message_type: _codec(message_type) for message_type in Message.__args__}
_BY_IDENTIFIER = {codec.identifier[0]: codec for codec in _BY_TYPE.values()}
