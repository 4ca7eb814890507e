"""Lengths of frames against a construction bit by bit and published figures."""

from __future__ import annotations

import random
import re

import can
import pytest
from anycrc import Model

from analogrig.links.frame_bits import frame_bits, longest_classic_bits, longest_fd_bits

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
