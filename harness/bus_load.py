"""How long frames take on a CAN bus, how much of it an exchange fills, and how long a message may have to wait.

A frame is counted bit by bit, stuff bits included, from its start to the end of the intermission after it. Sources:
ISO 11898-1 (2015), clauses 10.4 and 10.5; for the worst case Davis, Burns, Bril and Lukkien, "Controller Area Network
schedulability analysis", Real-Time Systems 35 (2007), here "Davis et al.".
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

CLASSIC_BYTES = 8
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)

_CRC_15 = (15, 0x4599)
_END_BITS = 3 + 7 + 3
"""Delimiter of the checksum, acknowledgement and its delimiter; end of frame; intermission."""
_RUN = 5
"""So many equal bits, and one of the other kind is stuffed in."""


@dataclass(frozen=True)
class FrameBits:
    """Bits of one frame on the bus."""

    nominal: int
    """At the bit rate of the arbitration."""
    data: int = 0
    """At that of the data; only in a frame of CAN FD that switches."""

    def seconds(self, bitrate: int, data_bitrate: int | None = None) -> float:
        """How long it takes [s]."""
        return self.nominal / bitrate + self.data / (data_bitrate or bitrate)


# ---------------------------------------------------------------------------------------------------------------- bits


def frame_bits(identifier: int, data: bytes, *, is_fd: bool = False, switches: bool = False) -> FrameBits:
    """Of a data frame with 11 bits of identifier, exactly.

    :param is_fd: CAN FD; ``switches``: to the bit rate of the data after the arbitration (BRS).
    :raises ValueError: the length is none that a frame can have.
    """
    if is_fd:
        if len(data) not in FD_LENGTHS:
            raise ValueError(f"no frame of CAN FD has {len(data)} bytes")
        return _fd_bits(identifier, data, switches=switches)
    if len(data) > CLASSIC_BYTES:
        raise ValueError(f"a classic frame has at most {CLASSIC_BYTES} bytes, not {len(data)}")
    # start, identifier, RTR, IDE, r0, length; then the data and the checksum over all of it
    bits = [0, *_bits(identifier, 11), 0, 0, 0, *_bits(len(data), 4), *_data_bits(data)]
    bits += _bits(_crc(bits, *_CRC_15), 15)
    return FrameBits(len(bits) + stuffed(bits) + _END_BITS)


def longest_bits(length: int, *, is_fd: bool = False, switches: bool = False) -> FrameBits:
    """The most that a frame with 11 bits of identifier and so many bytes can take (Davis et al., Equ 1, g = 34)."""
    if not is_fd:
        checked = 34 + 8 * length
        return FrameBits(checked + _END_BITS + (checked - 1) // (_RUN - 1))
    # start to BRS (or the bit after ESI, when nothing is switched) and what follows the checksum's delimiter
    head, body = 17, 5 + 8 * length
    bound = (head + body - 2) // (_RUN - 1)  # a fixed stuff bit follows the last one
    early = (head - 1) // (_RUN - 1)
    tail = _fd_tail_bits(length)
    if switches:
        return FrameBits(head + early + _END_BITS - 1, body + (bound - early) + tail + 1)
    return FrameBits(head + body + bound + tail + _END_BITS)


def stuffed(bits: Sequence[int]) -> int:
    """How many bits a controller stuffs into a sequence; those it stuffs count in the runs that follow."""
    count, run, last = 0, 0, -1
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == _RUN:
            count += 1
            last, run = 1 - bit, 1
    return count


def _fd_bits(identifier: int, data: bytes, *, switches: bool) -> FrameBits:
    # start, identifier, RRS, IDE, FDF, res, BRS; ESI, length, data. A fixed stuff bit follows the last one.
    head = [0, *_bits(identifier, 11), 0, 0, 1, 0, int(switches)]
    body = [0, *_bits(FD_LENGTHS.index(len(data)), 4), *_data_bits(data)]
    early, all_of_it = stuffed(head), stuffed([*head, *body][:-1])
    tail = _fd_tail_bits(len(data))
    if switches:
        # The rate is that of the data from the sample point of BRS to that of the delimiter of the checksum.
        return FrameBits(len(head) + early + _END_BITS - 1, len(body) + all_of_it - early + tail + 1)
    return FrameBits(len(head) + len(body) + all_of_it + tail + _END_BITS)


def _fd_tail_bits(length: int) -> int:
    """Count of stuff bits (4), checksum of 17 or 21 bits, and a fixed stuff bit before it and after every four."""
    checked = 4 + (17 if length <= 16 else 21)
    return checked + -(-checked // 4)


def _bits(value: int, width: int) -> list[int]:
    """The most significant first."""
    return [(value >> i) & 1 for i in reversed(range(width))]


def _data_bits(data: bytes) -> list[int]:
    return [bit for byte in data for bit in _bits(byte, 8)]


def _crc(bits: Sequence[int], width: int, polynomial: int) -> int:
    register = 0
    for bit in bits:
        feedback = bit ^ (register >> (width - 1))
        register = (register << 1) & ((1 << width) - 1)
        if feedback:
            register ^= polynomial
    return register


# ---------------------------------------------------------------------------------------------------------------- load


@dataclass(frozen=True)
class Stream:
    """A message that comes again and again."""

    name: str
    identifier: int
    length: int
    """Bytes."""
    per_s: float
    """How often, on average."""
    burst: int = 1
    """So many at once."""
    is_fd: bool = False


@dataclass(frozen=True)
class BusLoad:
    """What streams of messages are to a bus."""

    bitrate: int
    data_bitrate: int | None
    utilisation: float
    """Part of the time in which the bus is busy, every frame as long as it can be; above 1 it does not fit."""
    frames_per_s: float
    shares: Mapping[str, float]
    """Of each message in the utilisation."""
    response_s: Mapping[str, float]
    """The longest time until a message is through, by its name; inf if it may never be."""


def bus_load(streams: Sequence[Stream], bitrate: int, data_bitrate: int | None = None) -> BusLoad:
    """Utilisation and response times of streams that share a bus, the lower identifier first."""
    lengths_s = {stream.name: _longest_s(stream, bitrate, data_bitrate) for stream in streams}
    shares = {stream.name: stream.per_s * lengths_s[stream.name] for stream in streams}
    return BusLoad(
        bitrate,
        data_bitrate,
        sum(shares.values()),
        sum(stream.per_s for stream in streams),
        shares,
        {stream.name: _response_s(stream, streams, lengths_s, 1.0 / bitrate) for stream in streams},
    )


@functools.lru_cache(maxsize=256)
def _longest_s(stream: Stream, bitrate: int, data_bitrate: int | None) -> float:
    switches = stream.is_fd and data_bitrate is not None
    return longest_bits(stream.length, is_fd=stream.is_fd, switches=switches).seconds(bitrate, data_bitrate)


def _response_s(stream: Stream, streams: Sequence[Stream], lengths_s: Mapping[str, float], bit_s: float) -> float:
    """The longest time from being ready to being through (Davis et al., section 3, without jitter).

    A burst is ready at once, and its messages wait for each other. A frame that has begun is not interrupted.
    """
    above = [other for other in streams if other.identifier < stream.identifier]
    below = [lengths_s[other.name] for other in streams if other.identifier > stream.identifier]
    own_s = lengths_s[stream.name]
    if sum(other.per_s * lengths_s[other.name] for other in (*above, stream)) >= 1.0:
        return float("inf")
    blocked_s = max(below, default=0.0) + (stream.burst - 1) * own_s
    waiting_s, before_s = blocked_s, -1.0
    while waiting_s - before_s > 0.5 * bit_s:
        before_s = waiting_s
        waiting_s = blocked_s + sum(_arrivals(other, waiting_s + bit_s) * lengths_s[other.name] for other in above)
    return waiting_s + own_s


def _arrivals(stream: Stream, within_s: float) -> int:
    """The most that can come in so long a time: a burst at its beginning, and one after every period."""
    period_s = stream.burst / stream.per_s
    return stream.burst * -int(-within_s // period_s)
