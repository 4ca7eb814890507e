"""The serial framing against its definition, written out here a second time in the slowest way."""

# ruff: noqa: S311 - the faults are drawn from a seed; they are no secret

from __future__ import annotations

import random

import pytest

from analogrig.catalogue import (
    BLOCK_SAMPLES,
    CATALOGUE_HASH,
    LAYOUTS,
    Control,
    Estimate,
    Hello,
    Identify,
    Message,
    Sample,
    SampleBlock,
    Stepped,
    pack,
    unpack,
)
from analogrig.links.link import MAX_ENCODED, FrameDecoder, encode_frame

POLYNOMIAL = 0x82F63B78
"""Castagnoli's, reflected."""

MESSAGES: list[Message] = [
    Identify(0),
    Identify(255),
    Control(7, 1, 0xFFFFFFFF),
    Sample(1, 1, 65535, 4095, 0),
    SampleBlock(2, 14, 0, 0x3FFF, tuple(range(0, 2 * BLOCK_SAMPLES * 256, 256))),
    SampleBlock(0, 0, 0, 0, (0,) * (2 * BLOCK_SAMPLES)),
    SampleBlock(255, 255, 65535, 65535, (65535,) * (2 * BLOCK_SAMPLES)),
    Hello(3, 6, 3, CATALOGUE_HASH),
    Estimate(4, 5, 811, -1.5),
    Stepped(5, 7, 811, 0.0),
]


def crc32c(content: bytes, seed: int = 0) -> int:
    """Bit by bit."""
    register = ~seed & 0xFFFFFFFF
    for byte in content:
        register ^= byte
        for _ in range(8):
            register = (register >> 1) ^ (POLYNOMIAL if register & 1 else 0)
    return ~register & 0xFFFFFFFF


def cobs(content: bytes) -> bytes:
    """COBS of fewer than 254 bytes: before each run of non-zero bytes its length plus one."""
    return b"".join(bytes([len(run) + 1]) + run for run in content.split(b"\0"))


def frame_of(packet: bytes, seed: int) -> bytes:
    return b"\0" + cobs(packet + crc32c(packet, seed).to_bytes(4, "little")) + b"\0"


def decoded(stream: bytes, catalogue_hash: int = CATALOGUE_HASH) -> tuple[list[bytes], int]:
    decoder = FrameDecoder(catalogue_hash)
    return decoder.feed(stream), decoder.dropped


def test_reference_has_the_published_check_value() -> None:
    assert crc32c(b"123456789") == 0xE3069283


@pytest.mark.parametrize("message", MESSAGES)
def test_frame_is_the_definition(message: Message) -> None:
    packet = pack(message)
    seed = 0 if isinstance(message, Identify | Hello) else CATALOGUE_HASH
    assert encode_frame(packet) == frame_of(packet, seed)
    assert decoded(encode_frame(packet)) == ([packet], 0)
    assert unpack(packet) == message


def test_stream_may_come_in_pieces_of_any_size() -> None:
    packets = [pack(message) for message in MESSAGES]
    stream = b"".join(map(encode_frame, packets))
    for size in range(1, len(stream) + 1):
        decoder = FrameDecoder()
        received = [packet for i in range(0, len(stream), size) for packet in decoder.feed(stream[i : i + size])]
        assert (received, decoder.dropped) == (packets, 0)


def test_every_single_damaged_byte_drops_the_frame() -> None:
    packet = pack(MESSAGES[3])
    good = encode_frame(packet)
    for position in range(1, len(good) - 1):
        for flip in range(1, 256):
            damaged = bytearray(good)
            damaged[position] ^= flip
            packets, dropped = decoded(bytes(damaged))
            assert not packets
            assert dropped >= 1


def test_truncated_frame_costs_nothing_but_itself() -> None:
    packet = pack(MESSAGES[3])
    good = encode_frame(packet)
    for size in range(2, len(good) - 1):
        assert decoded(good[:size] + good) == ([packet], 1)


def test_frame_after_garbage_is_found() -> None:
    noise = random.Random(5).randbytes(5000)
    packet = pack(MESSAGES[3])
    packets, dropped = decoded(noise + encode_frame(packet))
    assert packets == [packet]
    assert dropped > 0


def test_frame_of_another_catalogue_is_dropped_unless_it_introduces_itself() -> None:
    other = CATALOGUE_HASH ^ 1
    for message in MESSAGES:
        packet = pack(message)
        introduces = isinstance(message, Identify | Hello)
        assert decoded(encode_frame(packet, other)) == (([packet], 0) if introduces else ([], 1))


def test_wrong_length_is_dropped_though_the_checksum_is_right() -> None:
    packet = pack(MESSAGES[3])
    for wrong in (packet[:-1], packet + b"\0", packet[:1]):
        assert decoded(frame_of(wrong, CATALOGUE_HASH)) == ([], 1)
        assert unpack(wrong) is None


def test_unknown_identifier_is_dropped_though_the_checksum_is_right() -> None:
    unknown = next(i for i in range(1, 128) if i not in {layout.id for layout in LAYOUTS.values()})
    assert decoded(frame_of(bytes([unknown]) + bytes(8), CATALOGUE_HASH)) == ([], 1)
    assert unpack(bytes([unknown]) + bytes(8)) is None
    assert unpack(b"") is None


def test_endless_frame_takes_no_memory_and_counts_once() -> None:
    decoder = FrameDecoder()
    for _ in range(100):
        assert decoder.feed(b"\x55" * 10_000) == []
        assert len(decoder._begun) <= MAX_ENCODED + 1
    assert decoder.dropped == 0
    packet = pack(MESSAGES[0])
    assert decoder.feed(encode_frame(packet)) == [packet]
    assert decoder.dropped == 1
