"""Lengths of CAN frames in bits, and the time that they take on a bus.

Lengths include stuff bits (ISO 11898-1:2015, 10.4 and 10.5) and the three bits of interframe space. The length of a
given frame is exact; without its contents, it is the longest possible.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

import anycrc

if TYPE_CHECKING:
    import can

CLASSIC_BYTES = 8
"""Data of the longest classic frame."""

ERROR_FRAME_BITS = 23
"""Longest error frame: the flags of two controllers in sequence, the delimiter, and the interframe space."""

_crc15 = anycrc.Model("CRC15-CAN").calc

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


def longest_classic_bits(length_bytes: int) -> FrameBits:
    """Longest classic frame with this much data and an identifier of 11 bits (Davis et al. 2007, Equ 1)."""
    stuffable = 34 + 8 * length_bytes
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
    base, extension = divmod(frame.arbitration_id, 1 << 18) if frame.is_extended_id else (frame.arbitration_id, 0)
    head = f"0{base:011b}11{extension:018b}" if frame.is_extended_id else f"0{base:011b}"
    data = "" if frame.is_remote_frame else "".join(f"{byte:08b}" for byte in frame.data)
    if frame.is_fd:
        head += f"{'' if frame.is_extended_id else '0'}010{frame.bitrate_switch:d}"
        return _fd_bits(frame, head, f"{frame.error_state_indicator:d}{_dlc(frame):04b}{data}")
    stuffable = f"{head}{frame.is_remote_frame:d}00{_dlc(frame):04b}{data}"
    check = _crc15(int(stuffable, 2).to_bytes(-(-len(stuffable) // 8), "big"))  # leading zeros do not change it
    stuffable += f"{check:015b}"
    return FrameBits(len(stuffable) + _stuff_bits(stuffable) + _TAIL_BITS)


def _fd_bits(frame: can.Message, head: str, data: str) -> FrameBits:
    """Length of a frame of CAN FD. A stuff bit due after the last data bit is replaced by the first fixed one.

    :param head: bits up to the bit rate switch.
    :param data: bits from ESI to the last data bit.
    """
    in_head = _stuff_bits(head[:-1])
    in_data = _stuff_bits(head + data[:-1]) - in_head
    checked = _fd_check_bits(len(frame.data))
    bits = FrameBits(len(head) + in_head + _TAIL_BITS, len(data) + in_data + checked)
    return bits if frame.bitrate_switch else FrameBits(sum(bits))


def _fd_check_bits(length_bytes: int) -> int:
    """Bits of the stuff count and the CRC, with their fixed stuff bits: one before, and one after every four bits."""
    checked = 4 + (17 if length_bytes <= _SHORT_FD_BYTES else 21)
    return checked + 1 + checked // 4


def _dlc(frame: can.Message) -> int:
    """The four bits of the data length code."""
    if frame.is_remote_frame:
        return min(frame.dlc, CLASSIC_BYTES)
    length = len(frame.data)
    return length if length <= CLASSIC_BYTES else 9 + sum(length > each for each in (12, 16, 20, 24, 32, 48))


_RUNS = re.compile("0{5}(?:1{4}0{4})*(?:1{4})?|1{5}(?:0{4}1{4})*(?:0{4})?")
"""Five equal bits, and the runs of four that directly follow, each of which begins with the stuff bit before it."""


def _stuff_bits(bits: str) -> int:
    """Number of stuff bits in and after these bits: one after every five equal bits, stuff bits included."""
    return sum((len(runs) - 1) // 4 for runs in _RUNS.findall(bits))
