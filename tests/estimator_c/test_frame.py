"""The framing of the device against that of the harness: two programs written apart must agree on every byte."""

# ruff: noqa: S311 - the faults are drawn from a seed; they are no secret

from __future__ import annotations

import ctypes
import random
from collections.abc import Iterator

import pytest

from analogrig.catalogue import CATALOGUE_HASH, LAYOUTS
from analogrig.devices.library import LIBRARY
from analogrig.links.link import MAX_ENCODED, FrameDecoder, encode_frame


class Decoder(ctypes.Structure):
    """frame_decoder_t of frame.h."""

    _fields_ = (
        ("catalogue_hash", ctypes.c_uint32),
        ("dropped", ctypes.c_uint32),
        ("fill", ctypes.c_uint8),
        ("overlong", ctypes.c_bool),
        ("bytes", ctypes.c_uint8 * MAX_ENCODED),
    )


@pytest.fixture(scope="module")
def c() -> ctypes.CDLL:
    library = ctypes.CDLL(str(LIBRARY))
    library.frame_crc.restype = ctypes.c_uint32
    library.frame_encode.restype = ctypes.c_size_t
    library.frame_decoder_enter.restype = ctypes.c_bool
    return library


def encoded(c: ctypes.CDLL, packet: bytes, catalogue_hash: int = CATALOGUE_HASH) -> bytes:
    out = ctypes.create_string_buffer(b"\xaa" * 200)
    n = c.frame_encode(ctypes.c_uint32(catalogue_hash), ctypes.c_uint8(packet[0]), packet[1:], out)
    assert out.raw[n : n + 8] == b"\xaa" * 8, "it wrote more than it says"
    return out.raw[:n]


def decoded(c: ctypes.CDLL, stream: bytes, catalogue_hash: int = CATALOGUE_HASH) -> tuple[list[bytes], int]:
    decoder = Decoder()
    c.frame_decoder_init(ctypes.byref(decoder), ctypes.c_uint32(catalogue_hash))
    lengths = {layout.id: 1 + layout.length for layout in LAYOUTS.values()}
    packets = [
        bytes(decoder.bytes)[: lengths[decoder.bytes[0]]]
        for byte in stream
        if c.frame_decoder_enter(ctypes.byref(decoder), ctypes.c_uint8(byte))
    ]
    return packets, decoder.dropped


def random_packets(rng: random.Random, n: int) -> Iterator[bytes]:
    """Bytes of all messages, with many zeros, which COBS replaces."""
    layouts = list(LAYOUTS.values())
    for _ in range(n):
        layout = rng.choice(layouts)
        zeros = rng.random()
        payload = bytes(0 if rng.random() < zeros else rng.randrange(256) for _ in range(layout.length))
        yield bytes([layout.id]) + payload


def test_checksum_has_the_published_check_value(c: ctypes.CDLL) -> None:
    assert c.frame_crc(ctypes.c_uint32(0), b"123456789", ctypes.c_size_t(9)) == 0xE3069283


def test_checksum_of_a_whole_is_that_of_its_parts(c: ctypes.CDLL) -> None:
    first = c.frame_crc(ctypes.c_uint32(0), b"1234", ctypes.c_size_t(4))
    assert c.frame_crc(ctypes.c_uint32(first), b"56789", ctypes.c_size_t(5)) == 0xE3069283


def test_both_encode_alike(c: ctypes.CDLL) -> None:
    rng = random.Random(1)
    for packet in random_packets(rng, 3000):
        catalogue_hash = rng.choice((CATALOGUE_HASH, rng.getrandbits(32)))
        assert encoded(c, packet, catalogue_hash) == encode_frame(packet, catalogue_hash)


def damaged(rng: random.Random, stream: bytes) -> bytes:
    """With flipped bits, lost and inserted bytes, and lost and repeated stretches."""
    out = bytearray(stream)
    for _ in range(rng.randrange(20)):
        at = rng.randrange(len(out))
        size = rng.choice((1, 1, 1, 5, 30))
        kind = rng.randrange(5)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del out[at : at + size]
        elif kind == 2:
            out[at:at] = rng.randbytes(size)
        elif kind == 3:
            out[at:at] = out[at : at + size]
        else:
            out[at:at] = b"\0" * size
    return bytes(out)


@pytest.mark.parametrize("seed", range(8))
def test_both_take_the_same_frames_from_a_damaged_stream(c: ctypes.CDLL, seed: int) -> None:
    rng = random.Random(seed)
    for _ in range(20):
        sent = list(random_packets(rng, 40))
        stream = damaged(rng, b"".join(map(encode_frame, sent)))
        decoder = FrameDecoder()
        packets = decoder.feed(stream)
        assert decoded(c, stream) == (packets, decoder.dropped)
        assert set(packets) <= set(sent), "a frame was taken that nobody sent"


def test_both_drop_the_same_from_noise(c: ctypes.CDLL) -> None:
    noise = random.Random(2).randbytes(200_000)
    decoder = FrameDecoder()
    assert decoded(c, noise) == (decoder.feed(noise), decoder.dropped)
    assert decoder.dropped > 500


def test_content_of_the_longest_size_is_taken_and_one_byte_more_is_not(c: ctypes.CDLL) -> None:
    longest = max(LAYOUTS.values(), key=lambda layout: layout.length)
    good = encode_frame(bytes([longest.id]) + b"\x01" * longest.length)
    assert len(good) == MAX_ENCODED + 2
    assert len(decoded(c, good)[0]) == 1
    assert decoded(c, good[:-1] + b"\x01" + b"\0" + good) == (decoded(c, good)[0], 1)
