"""The messages of the catalogue as types, and how they are packed.

The catalogue itself is estimator_c/catalogue/analogrig.dbc, which says what each message means; its layouts come from
the generated tables. A *packet* is what any link carries: the byte of the identifier, then the payload.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from struct import Struct
from typing import Any, NamedTuple, TypeAlias

from analogrig._catalogue import (
    CATALOGUE_HASH,
    LAYOUTS,
    Change,
    Command,
    Counter,
    Element,
    FirmwareId,
    Key,
    Layout,
    Result,
    SampleFlag,
    SteppedFlag,
    Trigger,
)

__all__ = [
    "BLOCK_SAMPLES",
    "CATALOGUE_HASH",
    "INDICES",
    "LAYOUTS",
    "RUNS",
    "RUN_SHIFT",
    "SEQS",
    "STEPPED_FLAGS",
    "Alarm",
    "Change",
    "Command",
    "Configure",
    "Configured",
    "Control",
    "Controlled",
    "Counter",
    "Diagnosis",
    "Element",
    "Estimate",
    "Firmware",
    "FirmwareId",
    "Hello",
    "Identify",
    "Key",
    "Message",
    "Result",
    "Sample",
    "SampleBlock",
    "SampleFlag",
    "Status",
    "Stepped",
    "SteppedFlag",
    "Trigger",
    "brief",
    "index_up_to",
    "is_number",
    "pack",
    "unpack",
    "unpack_any",
]

BLOCK_SAMPLES = 14
"""The most samples of one SampleBlock."""

RUN_SHIFT, _RUN_BITS = LAYOUTS["Stepped"].bits["run"]
"""Samples and what answers them carry the id of their run in their flags, from this bit on."""
RUNS = 1 << _RUN_BITS
"""Run ids are modulo this."""

SEQS = 1 << 8
"""Sequence numbers are modulo this."""
INDICES = 1 << 16
"""Indices of samples are modulo this in a message."""

STEPPED_FLAGS = sum(SteppedFlag)
"""All bits of the flags of Stepped but the run id."""


class Identify(NamedTuple):
    """Harness: asks who is there."""

    seq: int


class Hello(NamedTuple):
    """Device: the catalogue that it speaks."""

    seq: int
    theta_max: int
    answers: int
    catalogue_hash: int


class Firmware(NamedTuple):
    """Device: what it is, and since which boot."""

    seq: int
    firmware_id: int
    answers: int
    input_blocks: int
    """So many SampleBlocks may wait in its input."""
    boot_nonce: int


class Control(NamedTuple):
    """Harness: a command."""

    seq: int
    command: int
    argument: int


class Controlled(NamedTuple):
    """Device: what became of a command."""

    seq: int
    command: int
    answers: int
    result: int
    argument: int


class Configure(NamedTuple):
    """Harness: set one field of the configuration."""

    seq: int
    key: int
    value: float


class Configured(NamedTuple):
    """Device: what is set now."""

    seq: int
    key: int
    answers: int
    result: int
    value: float


class Sample(NamedTuple):
    """Harness: one pair of codes."""

    seq: int
    flags: int
    """SampleFlag, and the run id."""
    sample_index: int
    force: int
    displacement: int


class SampleBlock(NamedTuple):
    """Harness: up to BLOCK_SAMPLES consecutive pairs of codes."""

    seq: int
    flags: int
    """How many samples, and the run id."""
    sample_index: int
    missing: int
    """Bit i: sample i."""
    codes: tuple[int, ...]
    """Force and displacement in turn, 2 * BLOCK_SAMPLES of them."""


class Estimate(NamedTuple):
    """Device: one element of the estimate after a sample."""

    seq: int
    element: int
    sample_index: int
    value: float


class Stepped(NamedTuple):
    """Device: the sample has been entered; the last message about it."""

    seq: int
    flags: int
    """SteppedFlag, and the run id."""
    sample_index: int
    statistic: float


class Alarm(NamedTuple):
    """Device: the plant has changed."""

    seq: int
    trigger: int
    sample_index: int
    statistic: float


class Diagnosis(NamedTuple):
    """Device: what has changed."""

    seq: int
    change: int
    onset_index: int
    extent: float
    """New over old."""


class Status(NamedTuple):
    """Device: one counter."""

    seq: int
    counter: int
    answers: int
    value: int


Message: TypeAlias = (
    Identify
    | Hello
    | Firmware
    | Control
    | Controlled
    | Configure
    | Configured
    | Sample
    | SampleBlock
    | Estimate
    | Stepped
    | Alarm
    | Diagnosis
    | Status
)


class _Packing(NamedTuple):
    """How messages of one type are packed."""

    identifier: bytes
    length: int
    pack: Callable[..., bytes]
    unpack: Callable[[bytes, int], tuple[Any, ...]]
    make: Callable[[tuple[Any, ...]], Message]


def pack(message: Message) -> bytes:
    """The packet of a message.

    :raises struct.error: a value is out of the range of its field.
    """
    packing = _BY_TYPE[type(message)]
    return packing.identifier + packing.pack(*message)


def unpack(packet: bytes) -> Message | None:
    """As ``unpack_any``, but None also if its value is no number: what no device should compute is damaged."""
    message = unpack_any(packet)
    return message if message is not None and is_number(message) else None


def unpack_any(packet: bytes) -> Message | None:
    """The message in a packet, whatever its value; None if the catalogue has no such message of that length."""
    packing = _BY_IDENTIFIER.get(packet[0]) if packet else None
    if packing is None or len(packet) != packing.length:
        return None
    return packing.make(packing.unpack(packet, 1))


def is_number(message: Message) -> bool:
    """Whether its value is a number, neither NaN nor infinite; also true of a message without such a value."""
    value = message[-1]
    return not isinstance(value, float) or isfinite(value)


def brief(message: Message) -> str:
    """Its type, and its sample if it is about one."""
    index = getattr(message, "sample_index", None)
    return type(message).__name__ if index is None else f"{type(message).__name__} {index}"


def index_up_to(most: int, wire_index: int) -> int:
    """The last sample, up to ``most``, that a message calls ``wire_index``."""
    return most - (most - wire_index) % INDICES


_MODULI = {"seq": ("B", SEQS), "sample_index": ("H", INDICES)}


def _packing(message_type: Any) -> _Packing:
    layout = LAYOUTS[message_type.__name__]
    for field, (code, modulus) in _MODULI.items():
        if field in layout.fields and layout.format[1 + layout.fields.index(field)] != code:
            raise TypeError(f"{message_type.__name__}: {field} is not modulo {modulus}")
    if layout.bits.get("run", (RUN_SHIFT, _RUN_BITS)) != (RUN_SHIFT, _RUN_BITS):
        raise TypeError(f"{message_type.__name__} has the run id elsewhere than Stepped")
    if message_type is SampleBlock:
        return _block_packing(layout)
    if message_type._fields != layout.fields:
        raise TypeError(f"{message_type.__name__} has the fields {message_type._fields}, the catalogue {layout.fields}")
    struct = Struct(layout.format)
    if "f" in layout.format[:-1]:
        raise TypeError(f"{message_type.__name__} has a float that is not its last field")
    return _Packing(bytes([layout.id]), 1 + layout.length, struct.pack, struct.unpack_from, message_type._make)


def _block_packing(layout: Layout) -> _Packing:
    """As the catalogue has it, except that the codes are one field."""
    codes = tuple(f"{signal}{i}" for i in range(BLOCK_SAMPLES) for signal in ("force", "displacement"))
    if layout.fields != (*SampleBlock._fields[:-1], *codes):
        raise TypeError(f"SampleBlock differs from the catalogue, which has the fields {layout.fields}")
    struct = Struct(layout.format)
    return _Packing(
        identifier=bytes([layout.id]),
        length=1 + layout.length,
        pack=lambda *fields: struct.pack(*fields[:4], *fields[4]),
        unpack=struct.unpack_from,
        make=lambda values: SampleBlock(values[0], values[1], values[2], values[3], values[4:]),
    )


_BY_TYPE = {message_type: _packing(message_type) for message_type in Message.__args__}
_BY_IDENTIFIER = {packing.identifier[0]: packing for packing in _BY_TYPE.values()}
