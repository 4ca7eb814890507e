"""Lengths of CAN frames in bits, and the time that they take on a bus.

Lengths include stuff bits (ISO 11898-1:2015, 10.4 and 10.5) and the three bits of interframe space. The length of a
given frame is exact; without its contents, it is the longest possible.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import can

CLASSIC_BYTES = 8
"""Data of the longest classic frame."""

ERROR_FRAME_BITS = 23
"""Longest error frame: the flags of two controllers in sequence, the delimiter, and the interframe space."""

_CRC15 = 0x4599
_RUN = 5
"""Equal bits in a row, after which a stuff bit follows."""

_TAIL_BITS = 13
"""Bits without stuffing: CRC delimiter, acknowledgement and its delimiter, 7 bits of end, 3 of interframe space."""

_SHORT_FD_BYTES = 16
"""Data of the longest frame of CAN FD with a CRC of 17 bits; longer ones have 21."""


class FrameBits(NamedTuple):
    """Length of a frame."""

    nominal: int
    data: int = 0
    """Bits at the data bit rate, from ESI to the end of the CRC; zero without a bit rate switch."""

    def time_s(self, bitrate: int, data_bitrate: int | None = None) -> float:
        """Duration [s]; without ``data_bitrate``, all bits are at ``bitrate``."""
        return self.nominal / bitrate + self.data / (data_bitrate or bitrate)


def longest_frame_s(length_bytes: int, *, fd: bool, bitrate: int, data_bitrate: int | None = None) -> float:
    """Longest duration of a frame with this much data and an identifier of 11 bits [s]."""
    bits = longest_fd_bits(length_bytes) if fd else longest_classic_bits(length_bytes)
    return bits.time_s(bitrate, data_bitrate)


def longest_classic_bits(length_bytes: int, *, extended: bool = False) -> FrameBits:
    """Longest classic frame with this much data (Davis et al. 2007, Equ 1; see ``bus_load``)."""
    stuffable = (54 if extended else 34) + 8 * length_bytes
    return FrameBits(stuffable + (stuffable - 1) // 4 + _TAIL_BITS)


def longest_fd_bits(length_bytes: int) -> FrameBits:
    """Longest frame of CAN FD with this much data and an identifier of 11 bits.

    Stuff bits that may be in either phase are counted at the nominal bit rate, which is slower.
    """
    head, data = 17, 5 + 8 * length_bytes
    in_head = (head - 1) // 4
    stuffed = (head + data - 1) // 4
    return FrameBits(head + in_head + _TAIL_BITS, data + stuffed - in_head + _fd_check_bits(length_bytes))


def frame_bits(frame: can.Message) -> FrameBits:
    """Length of this very frame."""
    if frame.is_error_frame:
        return FrameBits(ERROR_FRAME_BITS)
    data = b"" if frame.is_remote_frame else bytes(frame.data)
    if frame.is_fd:
        return _fd_bits(frame, data)
    head, width = _classic_head(frame)
    state, stuffed, check = _head(head, width)
    for byte in data:
        state, more = _stuff(state, byte, 8)
        stuffed += more
        check = _crc15(check, byte)
    state, more = _stuff(state, check, 15)
    stuffed += more + (state[1] == _RUN)
    return FrameBits(width + 8 * len(data) + 15 + stuffed + _TAIL_BITS)


def _fd_bits(frame: can.Message, data: bytes) -> FrameBits:
    """Length of a frame of CAN FD. A stuff bit due after the last data bit is replaced by the first fixed one."""
    switch = frame.bitrate_switch
    if frame.is_extended_id:
        base, extension = divmod(frame.arbitration_id, 1 << 18)
        head, width = ((base << 2 | 0b11) << 18 | extension) << 4 | 0b0100 | switch, 36
    else:
        head, width = frame.arbitration_id << 5 | 0b00100 | switch, 17
    state, in_head = _stuff(_IDLE, head, width)
    state, in_data = _stuff(state, frame.error_state_indicator << 4 | _dlc(frame), 5)
    for byte in data:
        state, more = _stuff(state, byte, 8)
        in_data += more
    bits = FrameBits(width + in_head + _TAIL_BITS, 5 + 8 * len(data) + in_data + _fd_check_bits(len(data)))
    return bits if switch else FrameBits(sum(bits))


def _fd_check_bits(length_bytes: int) -> int:
    """Bits of the stuff count and the CRC, with their fixed stuff bits: one before, and one after every four bits."""
    checked = 4 + (17 if length_bytes <= _SHORT_FD_BYTES else 21)
    return checked + 1 + checked // 4


def _dlc(frame: can.Message) -> int:
    """The four bits of the data length code."""
    if not frame.is_fd or len(frame.data) <= CLASSIC_BYTES:
        return min(frame.dlc, CLASSIC_BYTES) if frame.is_remote_frame else len(frame.data)
    return 9 + sum(len(frame.data) > length for length in (12, 16, 20, 24, 32, 48))


def _classic_head(frame: can.Message) -> tuple[int, int]:
    """Bits before the data, and their number. The first is the start of frame, which is 0."""
    if frame.is_extended_id:
        base, extension = divmod(frame.arbitration_id, 1 << 18)
        return ((((base << 2 | 0b11) << 18 | extension) << 1 | frame.is_remote_frame) << 6) | _dlc(frame), 39
    return (frame.arbitration_id << 7) | (frame.is_remote_frame << 6) | _dlc(frame), 19


_State = tuple[int, int]
"""The last bit, and the number of equal bits in a row up to it."""

_IDLE: _State = (1, 0)


@functools.lru_cache(maxsize=1 << 14)
def _stuff(state: _State, value: int, width: int) -> tuple[_State, int]:
    """State after these bits, and the number of stuff bits inserted among them."""
    bit, run = state
    stuffed = 0
    for shift in reversed(range(width)):
        if run == _RUN:
            bit, run, stuffed = 1 - bit, 1, stuffed + 1
        this = value >> shift & 1
        bit, run = this, run + 1 if this == bit else 1
    return (bit, run), stuffed


@functools.lru_cache(maxsize=1 << 10)
def _head(head: int, width: int) -> tuple[_State, int, int]:
    """State, stuff bits and CRC after the head of a classic frame. Leading zeros do not change the CRC."""
    check = 0
    for byte in head.to_bytes(-(-width // 8), "big"):
        check = _crc15(check, byte)
    return *_stuff(_IDLE, head, width), check


def _crc15(check: int, byte: int) -> int:
    return _CRC15_OF[(check >> 7 ^ byte) & 0xFF] ^ check << 8 & 0x7FFF


def _crc15_of(byte: int) -> int:
    check = byte << 7
    for _ in range(8):
        check = check << 1 ^ (_CRC15 if check & 0x4000 else 0)
    return check & 0x7FFF


_CRC15_OF = [_crc15_of(byte) for byte in range(256)]
