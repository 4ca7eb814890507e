"""The time that frames take on a CAN bus, how much of the bus an exchange needs, and how late an answer can be.

A frame lasts as long as its bits, stuff bits included; with those of a given frame the length is exact, without them it
is the longest (ISO 11898-1:2015, 10.4 and 10.5). Latencies are those of R. I. Davis, A. Burns, R. J. Bril, J. J.
Lukkien: Controller Area Network (CAN) schedulability analysis: refuted, revisited and revised, Real-Time Systems 35,
2007. Every length has the three bits of space that follow each frame.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from analogrig.protocol.catalogue import BLOCK_SAMPLES, LAYOUTS

if TYPE_CHECKING:
    import can

    from analogrig.run import Run

CLASSIC_BYTES = 8
"""The most in a frame that is not CAN FD."""

ERROR_FRAME_BITS = 23
"""At most: the flags of two controllers one after the other, the delimiter, and the space."""

_CRC15 = 0x4599
_RUN = 5
"""After so many equal bits comes one that is different."""

_TAIL_BITS = 13
"""Never stuffed: delimiter of the CRC, acknowledgement and its delimiter, 7 bits of end, 3 of space."""

_SHORT_FD_BYTES = 16
"""Up to here a frame of CAN FD has the CRC of 17 bits."""


class FrameBits(NamedTuple):
    """The length of a frame."""

    nominal: int
    data: int = 0
    """So many of them at the bit rate of the data: those from ESI to the end of the CRC. Zero without a switch."""

    def time_s(self, bitrate: int, data_bitrate: int | None = None) -> float:
        """How long it takes; ``data_bitrate`` None: no faster."""
        return self.nominal / bitrate + self.data / (data_bitrate or bitrate)


def frame_s(length_bytes: int, *, fd: bool, bitrate: int, data_bitrate: int | None = None) -> float:
    """The longest that a frame with so many bytes of data and an identifier of 11 bits can take [s]."""
    bits = longest_fd_bits(length_bytes) if fd else longest_classic_bits(length_bytes)
    return bits.time_s(bitrate, data_bitrate)


def message_s(frame: can.Message, bitrate: int, data_bitrate: int | None = None) -> float:
    """How long this very frame takes [s]."""
    return frame_bits(frame).time_s(bitrate, data_bitrate)


def longest_classic_bits(length_bytes: int, *, extended: bool = False) -> FrameBits:
    """With as many stuff bits as there can be (Davis et al. 2007, Equ 1)."""
    stuffable = (54 if extended else 34) + 8 * length_bytes
    return FrameBits(stuffable + (stuffable - 1) // 4 + _TAIL_BITS)


def longest_fd_bits(length_bytes: int) -> FrameBits:
    """The same for CAN FD with an identifier of 11 bits; as many stuff bits as can be at the slower bit rate."""
    head, data = 17, 5 + 8 * length_bytes
    in_head = (head - 1) // 4
    stuffed = (head + data - 1) // 4
    return FrameBits(head + in_head + _TAIL_BITS, data + stuffed - in_head + _fd_check_bits(length_bytes))


def frame_bits(frame: can.Message) -> FrameBits:
    """The bits of this very frame."""
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
    """A stuff bit that would come after the last of the data does not: the first fixed one is there."""
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
    """The count of the stuff bits and the CRC, with their own: one before, and one after every four of them."""
    checked = 4 + (17 if length_bytes <= _SHORT_FD_BYTES else 21)
    return checked + 1 + checked // 4


def _dlc(frame: can.Message) -> int:
    """The four bits that say how long the data is."""
    if not frame.is_fd or len(frame.data) <= CLASSIC_BYTES:
        return min(frame.dlc, CLASSIC_BYTES) if frame.is_remote_frame else len(frame.data)
    return 9 + sum(len(frame.data) > length for length in (12, 16, 20, 24, 32, 48))


def _classic_head(frame: can.Message) -> tuple[int, int]:
    """What comes before the data, and how many bits that is; the first is the start of the frame, which is 0."""
    if frame.is_extended_id:
        base, extension = divmod(frame.arbitration_id, 1 << 18)
        return ((((base << 2 | 0b11) << 18 | extension) << 1 | frame.is_remote_frame) << 6) | _dlc(frame), 39
    return (frame.arbitration_id << 7) | (frame.is_remote_frame << 6) | _dlc(frame), 19


_State = tuple[int, int]
"""The last bit, and how many there are of it in a row."""

_IDLE: _State = (1, 0)


@functools.lru_cache(maxsize=1 << 14)
def _stuff(state: _State, value: int, width: int) -> tuple[_State, int]:
    """After so many bits: the state, and how many stuff bits had to come before one of them."""
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
    """State, stuff bits and CRC after the head of a classic frame; leading zeros leave a CRC that began with 0."""
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

# ------------------------------------------------------------------------------------------------- load and latency


@dataclass(frozen=True)
class Stream:
    """Frames with the same identifier that are queued together, again and again; the lower it is, the earlier."""

    identifier: int
    frame_s: float
    """One of them, at most."""
    period_s: float
    """At least so long until they are queued again; infinite: never."""
    frames: int = 1
    jitter_s: float = 0.0
    """They may be queued so much later than they are due."""

    @property
    def utilisation(self) -> float:
        return self.frames * self.frame_s / self.period_s


_MOST_STEPS = 10_000


def latency_s(streams: Iterable[Stream], identifier: int, bit_s: float) -> float | None:
    """From when frames of a stream are due until the last of them is over, at most [s]; None: there is no such limit.

    Davis et al. 2007, Equ 4 to 9, for frames that are queued ``frames`` at a time. A frame that has begun is not broken
    off, and of those that wait the one with the lowest identifier is next.

    :raises StopIteration: no stream has that identifier.
    """
    streams = tuple(streams)
    own = next(stream for stream in streams if stream.identifier == identifier)
    higher = [stream for stream in streams if stream.identifier < identifier]
    blocking_s = max((stream.frame_s for stream in streams if stream.identifier > identifier), default=0.0)
    if own.utilisation + sum(stream.utilisation for stream in higher) >= 1.0:
        return None
    busy_s = _settled(blocking_s, [*higher, own], 0.0, own.frames * own.frame_s)
    if busy_s is None:
        return None
    longest_s = 0.0
    for instance in range(max(1, math.ceil((busy_s + own.jitter_s) / own.period_s))):
        before_s = blocking_s + ((instance + 1) * own.frames - 1) * own.frame_s
        waiting_s = _settled(before_s, higher, bit_s, before_s)
        if waiting_s is None:
            return None
        passed_s = instance * own.period_s if instance else 0.0
        longest_s = max(longest_s, own.jitter_s + waiting_s - passed_s + own.frame_s)
    return longest_s


def _settled(own_s: float, streams: Iterable[Stream], bit_s: float, start_s: float) -> float | None:
    """The least t >= start with t = own + what the streams have queued by t; None: not found."""
    now_s = start_s
    for _ in range(_MOST_STEPS):
        queued = (each.frames * each.frame_s * _times(each, now_s + bit_s) for each in streams)
        next_s = own_s + sum(queued)
        if next_s <= now_s * (1.0 + 1e-12):
            return next_s
        now_s = next_s
    return None


def _times(stream: Stream, within_s: float) -> int:
    """How often it is queued at most; what is due at the end by no more than an error of rounding is not yet."""
    return max(1, math.ceil((within_s + stream.jitter_s) / stream.period_s - 1e-9))


@dataclass(frozen=True)
class BusLoad:
    """What an exchange asks of a bus; every frame with as many stuff bits as it can have."""

    bitrate: int
    data_bitrate: int | None
    sample_s: float
    """On the bus for one sample and all answers to it; alarms and diagnoses not counted."""
    utilisation: float
    """Of the bus, in real time; more than 1.0 does not fit."""
    latency_s: float | None
    """In real time, from a sample until the last answer to it is over, with an alarm and a diagnosis before; a device
    that takes no time itself. None: there is no such limit."""

    @property
    def most_samples_per_s(self) -> float:
        return 1.0 / self.sample_s


def exchange_load(
    *,
    bitrate: int,
    data_bitrate: int | None,
    in_blocks: bool,
    parameters: int,
    report_interval_n: int,
    period_s: float,
) -> BusLoad:
    """Of samples every ``period_s``, one in a message or BLOCK_SAMPLES, with ``parameters`` elements of theta and the
    innovation for each ``report_interval_n`` samples."""

    def stream(name: str, frames: int = 1, every_s: float = math.inf, jitter_s: float = 0.0) -> Stream:
        layout = LAYOUTS[name]
        is_fd = layout.length > CLASSIC_BYTES
        longest_s = frame_s(layout.length, fd=is_fd, bitrate=bitrate, data_bitrate=data_bitrate)
        return Stream(layout.id, longest_s, every_s, frames, jitter_s)

    together = BLOCK_SAMPLES if in_blocks else 1
    elements = parameters + 1
    samples = stream("SampleBlock" if in_blocks else "Sample", 1, together * period_s)
    per_sample_s = stream("Stepped").frame_s + stream("Estimate").frame_s * elements / report_interval_n
    per_sample_s += samples.frame_s / together

    def answers(jitter_s: float) -> list[Stream]:
        reports = math.ceil(together / report_interval_n)
        estimates = stream("Estimate", reports * elements, max(together, report_interval_n) * period_s, jitter_s)
        stepped = stream("Stepped", together, together * period_s, jitter_s)
        return [samples, estimates, stepped]

    there_s = latency_s(answers(0.0), samples.identifier, 1.0 / bitrate)
    late_s = 0.0 if there_s is None else there_s - samples.frame_s
    rare = [stream("Alarm"), stream("Diagnosis")]
    back_s = latency_s([*rare, *answers(late_s)], LAYOUTS["Stepped"].id, 1.0 / bitrate)
    return BusLoad(
        bitrate,
        data_bitrate,
        sample_s=per_sample_s,
        utilisation=per_sample_s / period_s,
        latency_s=None if there_s is None or back_s is None else samples.frame_s + back_s,
    )


def load_of(run: Run) -> BusLoad | None:
    """Of a run; None: it was on no CAN bus, or on one of unknown bit rate."""
    ran = run.conditions
    if "bitrate" not in ran.line:
        return None
    return exchange_load(
        bitrate=ran.line["bitrate"],
        data_bitrate=ran.line.get("data_bitrate"),
        in_blocks=ran.line.get("samples_per_message", 1) > 1,
        parameters=run.theta.shape[1],
        report_interval_n=int(ran.dut.get("report_interval_n", 1)),
        period_s=ran.sample_period_s * (ran.real_time or 1.0),
    )
