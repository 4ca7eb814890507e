"""Lengths of frames against a construction bit by bit and published figures; load and latency of a bus."""

from __future__ import annotations

import math
import random
import re

import can
import pytest
from anycrc import Model

from analogrig.links.frame_bits import frame_bits, longest_classic_bits, longest_fd_bits
from analogrig.links.line import CanLine
from analogrig.protocol.bus_load import PeriodicFrames, exchange_load, latency_s

FD_LENGTHS = [*range(9), 12, 16, 20, 24, 32, 48, 64]


def classic(identifier: int, data: bytes, *, extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=extended)


def bits(value: int, width: int) -> str:
    return format(value, f"0{width}b")


def stuffed(stream: str) -> str:
    """A bit of the other kind after each five equal ones, which counts as one of the next five."""
    out = ""
    for bit in stream:
        out += bit
        if re.search("(0{5}|1{5})$", out):
            out += "1" if bit == "0" else "0"
    return out


def crc15(stream: str) -> str:
    """Long division by x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1 (ISO 11898-1, 10.4.2.6)."""
    divisor = bits(0b1100010110011001, 16)
    rest = list(stream + 15 * "0")
    for i in range(len(stream)):
        if rest[i] == "1":
            for k, bit in enumerate(divisor):
                rest[i + k] = "1" if rest[i + k] != bit else "0"
    return "".join(rest[-15:])


def drawn_out(frame: can.Message) -> str:
    """The whole of a classic frame as it is on the bus, with the space after it."""
    identifier, remote = frame.arbitration_id, bits(frame.is_remote_frame, 1)
    if frame.is_extended_id:
        head = "0" + bits(identifier >> 18, 11) + "11" + bits(identifier & 0x3FFFF, 18) + remote + "00"
    else:
        head = "0" + bits(identifier, 11) + remote + "00"
    body = head + bits(frame.dlc, 4) + "".join(bits(byte, 8) for byte in frame.data)
    return stuffed(body + crc15(body)) + "1" + "01" + 7 * "1" + 3 * "1"


def drawn_out_fd(frame: can.Message) -> tuple[int, int]:
    """(nominal, data) bits of a frame of CAN FD that switches; the CRC itself does not matter for its length."""
    if frame.is_extended_id:
        identifier = frame.arbitration_id
        head = "0" + bits(identifier >> 18, 11) + "11" + bits(identifier & 0x3FFFF, 18) + "0101"
    else:
        head = "0" + bits(frame.arbitration_id, 11) + "00101"
    body = head + "0" + bits(FD_LENGTHS.index(len(frame.data)), 4) + "".join(bits(byte, 8) for byte in frame.data)
    in_head = len(stuffed(head)) - ends_in_stuff(head)  # which comes after the switch
    in_data = len(stuffed(body)) - ends_in_stuff(body) - in_head  # for which the first fixed stuff bit stands in
    check = "".join(f"s{group}" for group in re.findall(".{1,4}", (4 + (17 if len(frame.data) <= 16 else 21)) * "c"))
    return in_head + 13, in_data + len(check)


def ends_in_stuff(stream: str) -> bool:
    """True if a stuff bit follows the last one."""
    return len(stuffed(stream)) - len(stuffed(stream[:-1])) == 2


def test_crc_of_the_construction_has_the_published_check_value() -> None:
    text = "".join(bits(byte, 8) for byte in b"123456789")
    assert int(crc15(text), 2) == 0x059E  # CRC-15/CAN in the catalogue of parametrised CRC algorithms
    assert Model("CRC15").calc(b"123456789") == 0x059E


@pytest.mark.parametrize("extended", [False, True])
def test_classic_frames_are_as_long_as_drawn_bit_by_bit(extended: bool) -> None:  # noqa: FBT001
    rng = random.Random(11)  # noqa: S311
    for n in range(9):
        for data in (bytes(n), n * b"\xff", n * b"\x0f", n * b"\x3c", *(rng.randbytes(n) for _ in range(30))):
            frame = classic(rng.randrange(1 << (29 if extended else 11)), data, extended=extended)
            exact = frame_bits(frame)
            assert exact == (len(drawn_out(frame)), 0)
            assert extended or exact.nominal <= longest_classic_bits(n).nominal


def test_remote_frames_have_a_length_but_no_data() -> None:
    for dlc in range(9):
        frame = can.Message(arbitration_id=0x18, is_remote_frame=True, dlc=dlc, is_extended_id=False)
        assert frame_bits(frame).nominal == len(drawn_out(frame))


@pytest.mark.parametrize("extended", [False, True])
def test_fd_frames_are_as_long_as_drawn_bit_by_bit(extended: bool) -> None:  # noqa: FBT001
    rng = random.Random(12)  # noqa: S311
    for n in FD_LENGTHS:
        for data in (bytes(n), n * b"\xff", n * b"\x0f", n * b"\x87", *(rng.randbytes(n) for _ in range(10))):
            frame = classic(rng.randrange(1 << (29 if extended else 11)), data, extended=extended)
            frame.is_fd = frame.bitrate_switch = True
            exact = frame_bits(frame)
            assert exact == drawn_out_fd(frame)
            if not extended:
                longest = longest_fd_bits(n)
                assert exact.time_s(500_000, 5_000_000) <= longest.time_s(500_000, 5_000_000)
            frame.bitrate_switch = False
            assert frame_bits(frame).data == 0


def test_fixed_stuff_bits_of_fd_are_six_to_sixteen_bytes_and_seven_beyond() -> None:
    """ISO 11898-1:2015, 10.4.2.6: one before the count of stuff bits, and one after each four bits from there on."""
    shorter, longer = (can.Message(data=bytes([0x55] * n), is_fd=True, is_extended_id=False) for n in (16, 20))
    assert sum(frame_bits(longer)) - sum(frame_bits(shorter)) == 8 * 4 + (21 + 7) - (17 + 6)


def test_longest_frames_are_those_of_davis_and_others() -> None:
    """Real-Time Systems 35 (2007), Equ 2: 55 + 10 n bits with an identifier of 11 bits."""
    for n in range(9):
        assert longest_classic_bits(n).nominal == 55 + 10 * n
    assert longest_classic_bits(7).time_s(125_000) == pytest.approx(1e-3)


def test_data_of_an_fd_frame_takes_less_time_at_a_higher_rate() -> None:
    bits = longest_fd_bits(64)
    fast = bits.time_s(500_000, 2_000_000)
    assert bits.time_s(500_000) == pytest.approx(sum(bits) / 500_000)
    assert fast == pytest.approx(bits.nominal / 500_000 + bits.data / 2_000_000)
    frame = can.Message(data=bytes(64), is_fd=True, bitrate_switch=True, is_extended_id=False)
    assert frame_bits(frame).time_s(500_000, 2_000_000) < fast


def refuted() -> list[PeriodicFrames]:
    """Table 1 of Davis et al. 2007: three messages of 7 bytes at 125 kbit/s."""
    return [PeriodicFrames(1, 1e-3, 2.5e-3), PeriodicFrames(2, 1e-3, 3.5e-3), PeriodicFrames(3, 1e-3, 3.5e-3)]


def test_latencies_are_those_of_the_revised_analysis() -> None:
    """Davis et al. 2007, section 3.4: 2, 3 and 3.5 ms; the refuted analysis had 3 ms for the last one."""
    latencies = [latency_s(refuted(), identifier, 8e-6) for identifier in (1, 2, 3)]
    assert latencies == pytest.approx([2e-3, 3e-3, 3.5e-3])


def test_latency_has_no_limit_on_a_bus_that_is_full() -> None:
    full = [*refuted(), PeriodicFrames(0, 1e-3, 5e-3)]
    assert latency_s(full, 3, 8e-6) is None
    assert latency_s(full, 0, 8e-6) == pytest.approx(2e-3)


def test_frames_queued_together_wait_for_each_other() -> None:
    alone = [PeriodicFrames(5, 1e-3, 100e-3, frames=9)]
    assert latency_s(alone, 5, 1e-6) == pytest.approx(9e-3)
    with_others = [*alone, PeriodicFrames(1, 1e-3, 4e-3), PeriodicFrames(9, 2e-3, math.inf)]
    assert latency_s(with_others, 5, 1e-6) == pytest.approx(15e-3)  # 2 that has begun, 9, and those of 0, 4, 8, 12 ms


def test_what_an_exchange_needs_is_the_sum_of_its_frames() -> None:
    """By hand: a sample, 7 estimates and the end, 9 frames of 8 bytes: 135 bits each."""
    load = exchange_load(CanLine(1_000_000), in_blocks=False, parameters=6, report_interval_n=1, period_s=2e-3)
    assert load.sample_s == pytest.approx(9 * 135e-6)
    assert load.utilisation == pytest.approx(9 * 135e-6 / 2e-3)
    # One that has begun, the sample, alarm, diagnosis and misfit, the next sample, 7 estimates, the end.
    assert load.latency_s == pytest.approx((1 + 1 + 3 + 1 + 7 + 1) * 135e-6)
    assert load.most_samples_per_s == pytest.approx(1 / 1215e-6)


def test_an_exchange_that_does_not_fit_has_no_latency() -> None:
    load = exchange_load(CanLine(1_000_000), in_blocks=False, parameters=6, report_interval_n=1, period_s=50e-6)
    assert load.utilisation == pytest.approx(24.3)
    assert load.latency_s is None


def test_blocks_of_fd_with_rare_reports_fit_where_samples_do_not() -> None:
    blocks, samples = (
        exchange_load(
            CanLine(1_000_000, 8_000_000 if in_blocks else None),
            in_blocks=in_blocks,
            parameters=6,
            report_interval_n=64,
            period_s=250e-6,
        )
        for in_blocks in (True, False)
    )
    assert blocks.utilisation < 1.0 < samples.utilisation
    assert blocks.latency_s is not None
    assert samples.latency_s is None
