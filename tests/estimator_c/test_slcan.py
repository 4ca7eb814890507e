"""slcan: what python-can sends is understood, it understands what goes out, and LAWICEL's commands are answered.

Sources: python-can's own slcan; the command descriptions of LAWICEL's manuals (CAN232 version 3, CANUSB 1.0D).
"""

# ruff: noqa: S311 - random frames are no secret

from __future__ import annotations

import ctypes
import random
import subprocess
from collections.abc import Iterator
from functools import partial

import can
import pytest
from can.interfaces.slcan import slcanBus as SlcanBus
from can.util import CAN_FD_DLC

from analogrig.catalogue import Alarm, unpack
from analogrig.devices.library import LIBRARY
from analogrig.devices.processes import HOST_PROGRAM
from tests.estimator_c.shells import (
    EXTENDED,
    FD,
    REMOTE,
    CFrame,
    Frame,
    SlcanDevice,
    conversation,
    frame_of,
    from_c,
    over_serial,
    to_c,
)

OK, BEL = b"\r", b"\a"
LONGEST = 1 + 8 + 1 + 2 * 64


class Event(ctypes.Structure):
    """slcan_event_t."""

    _fields_ = (
        ("has_frame", ctypes.c_bool),
        ("frame", CFrame),
        ("reply_n", ctypes.c_uint8),
        ("reply", ctypes.c_uint8 * 6),
    )


class Adapter:
    """slcan.h."""

    def __init__(self, *opening: str, is_fd: bool = True) -> None:
        self._c = ctypes.CDLL(str(LIBRARY))
        self._c.slcan_enter.restype = ctypes.c_bool
        self._c.slcan_encode.restype = ctypes.c_size_t
        self._state = ctypes.create_string_buffer(1024)  # more than sizeof(slcan_t)
        self._c.slcan_init(self._state, ctypes.c_bool(is_fd))
        for line in opening:
            assert self.enter(line) == (OK, None)

    def enter(self, line: str | bytes) -> tuple[bytes, Frame | None]:
        """A line without its CR: the reply, and the frame that goes out."""
        text = line.encode() if isinstance(line, str) else line
        event = Event()
        for byte in text:
            assert not self._c.slcan_enter(self._state, ctypes.c_uint8(byte), ctypes.byref(event))
        assert self._c.slcan_enter(self._state, ctypes.c_uint8(ord("\r")), ctypes.byref(event))
        return bytes(event.reply)[: event.reply_n], from_c(event.frame) if event.has_frame else None

    def encode(self, sent: Frame) -> bytes:
        text = ctypes.create_string_buffer(256)
        n = self._c.slcan_encode(self._state, ctypes.byref(to_c(sent)), text)
        return text.raw[:n]


@pytest.fixture(scope="module")
def user() -> Iterator[SlcanBus]:
    """python-can, whose line comes back to itself."""
    with SlcanBus("loop://", sleep_after_open=0, timeout=10.0) as bus:
        bus.flush()
        yield bus


def frames() -> list[can.Message]:
    """Some of every kind and length."""
    rng = random.Random(8)
    out = []
    for is_extended in (False, True):
        for i in range(40):
            top = 0x1FFFFFFF if is_extended else 0x7FF
            message = partial(
                can.Message, arbitration_id=rng.choice([0, top, rng.randint(0, top)]), is_extended_id=is_extended
            )
            out.append(message(data=rng.randbytes(i % 9)))
            out.append(message(data=rng.randbytes(CAN_FD_DLC[i % 16]), is_fd=True, bitrate_switch=i > 20))
            out.append(message(is_remote_frame=True, dlc=i % 9))
    return out


def flags_of(message: can.Message) -> int:
    kinds = ((EXTENDED, message.is_extended_id), (REMOTE, message.is_remote_frame), (FD, message.is_fd))
    return sum(flag for flag, holds in kinds if holds)


def test_what_python_can_sends_is_understood(user: SlcanBus) -> None:
    adapter = Adapter("O")
    for message in frames():
        user.send(message)
        reply, out = adapter.enter(user.serialPortOrig.read_until(b"\r")[:-1])
        assert out == Frame(message.arbitration_id, bytes(message.data), flags_of(message))
        assert reply == (b"Z\r" if message.is_extended_id else b"z\r")


def test_python_can_understands_what_goes_out(user: SlcanBus) -> None:
    adapter = Adapter("O")
    for message in frames():
        sent = Frame(message.arbitration_id, bytes(message.data), flags_of(message))
        user.serialPortOrig.write(adapter.encode(sent))
        heard = user.recv(1.0)
        assert heard is not None
        assert Frame(heard.arbitration_id, bytes(heard.data), flags_of(heard)) == sent


def test_length_between_those_of_can_fd_is_filled_with_zeros() -> None:
    text = Adapter("O").encode(Frame(0x123, b"\xff" * 9, FD))
    assert text == b"d1239" + b"FF" * 9 + b"00" * 3 + b"\r"


def test_remote_frame_has_a_length_and_no_data() -> None:
    assert Adapter("O").encode(Frame(0x123, bytes(5), REMOTE)) == b"r1235\r"


@pytest.mark.parametrize(
    ("opening", "line", "reply"),
    [
        ("", "O", OK),
        ("O", "O", BEL),
        ("", "L", OK),
        ("O", "L", BEL),
        ("O", "C", OK),
        ("L", "C", OK),
        ("", "C", BEL),
        ("", "S8", OK),
        ("O", "S8", BEL),
        ("", "S", BEL),
        ("", "s031C", OK),
        ("", "Y5", OK),
        ("", "V", b"V0101\r"),
        ("O", "V", b"V0101\r"),
        ("", "N", b"NRIG1\r"),
        ("O", "F", b"F00\r"),
        ("", "F", BEL),
        ("", "Z0", OK),
        ("", "Z1", BEL),
        ("", "", OK),
        ("", "OO", BEL),
        ("", "VX", BEL),
        ("", "?", BEL),
        ("", "t1230", BEL),
        ("L", "t1230", BEL),
    ],
)
def test_command_is_answered_as_lawicel_says(opening: str, line: str, reply: bytes) -> None:
    assert Adapter(*opening).enter(line) == (reply, None)


@pytest.mark.parametrize(
    "line",
    [
        "t",
        "t12",
        "t123",
        "t8000",
        "tG000",
        "t1239001122334455667788",
        "t1232AA",
        "t1232AABBC",
        "t1232AABBCC",
        "t1232AAXB",
        "t123x",
        "T200000000",
        "T1FFFFFF0",
        "r12318",
        "r1239",
        "d123900",
        "dG",
        "x1230",
        "t" * LONGEST,
        "t" * (LONGEST + 1),
        "t" * (LONGEST + 2),
        "t1230" * 1000,
    ],
)
def test_line_that_is_no_frame_is_refused_and_the_next_one_is_taken(line: str) -> None:
    adapter = Adapter("O")
    assert adapter.enter(line) == (BEL, None)
    assert adapter.enter("t7ff2AbcD") == (b"z\r", Frame(0x7FF, b"\xab\xcd"))


def test_classic_adapter_refuses_frames_of_can_fd() -> None:
    adapter = Adapter("O", is_fd=False)
    assert [adapter.enter(kind + "1230") for kind in "db"] == [(BEL, None)] * 2
    assert adapter.enter("t1230") == (b"z\r", Frame(0x123, b""))


def test_closed_channel_tells_nobody() -> None:
    assert Adapter().encode(Frame(0x123)) == b""
    assert Adapter("O", "C").encode(Frame(0x123)) == b""
    assert Adapter("L").encode(Frame(0x123)) == b"t1238" + b"00" * 8 + b"\r"


# ---- the device behind it


def told(*, in_blocks: bool) -> list[bytes]:
    """The lines of the same conversation, as an adapter writes them."""
    sent = map(frame_of, conversation(in_blocks=in_blocks))
    return [Adapter("O").encode(one) for one in sent]


def packet(line: bytes) -> bytes:
    """Payload of an answer: always a classic frame of eight bytes."""
    assert line[:2] + line[4:5] == b"t08"
    return bytes.fromhex(line[2:4].decode()) + bytes.fromhex(line[5:].decode())


@pytest.mark.parametrize("in_blocks", [False, True])
def test_answers_are_those_of_the_serial_line(*, in_blocks: bool) -> None:
    device = SlcanDevice()
    assert device.tell(b"S8\rO\r") == OK * 2
    lines = device.tell(b"".join(told(in_blocks=in_blocks))).split(b"\r")[:-1]
    assert lines.count(b"z") == len(told(in_blocks=in_blocks))
    packets = [packet(line) for line in lines if line != b"z"]
    assert packets == over_serial(in_blocks=in_blocks)
    assert any(isinstance(unpack(answer), Alarm) for answer in packets)


def test_answers_do_not_depend_on_pieces_and_room() -> None:
    stream = b"V\rO\r" + b"".join(told(in_blocks=True)) + b"t1230\rnonsense\rN\r"
    whole = SlcanDevice().tell(stream)
    for room in (22, 23, 44, 1000):  # 22: SLCAN_DEVICE_ANSWER
        rng = random.Random(room)
        device, at, answers = SlcanDevice(), 0, b""
        while at < len(stream):
            taken, given = device.run(stream[at : at + rng.randrange(40)], room)
            at, answers = at + taken, answers + given
        assert answers + device.tell(b"", room) == whole


def test_device_of_a_closed_channel_is_silent_and_well() -> None:
    device = SlcanDevice()
    first, second = told(in_blocks=False)[:2]
    assert device.tell(b"O\r" + first + b"C\r" + second).endswith(b"\r" + OK + BEL)
    assert device.tell(b"O\r" + second).count(b"t037") == 1


# ---- the program


def test_python_can_speaks_with_the_program() -> None:
    """Over a pseudo-terminal, blocks in CAN FD and all."""
    program = subprocess.Popen([HOST_PROGRAM, "--slcan"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with program:
        assert program.stdout is not None
        with SlcanBus(program.stdout.readline().strip(), sleep_after_open=0, bitrate=1_000_000) as bus:
            expected = over_serial(in_blocks=True)
            heard = list[bytes]()
            for message in conversation(in_blocks=True):
                one = frame_of(message)
                bus.send(
                    can.Message(arbitration_id=one.id, is_extended_id=False, data=one.data, is_fd=bool(one.flags & FD))
                )
            while len(heard) < len(expected):
                answer = bus.recv(10.0)
                assert answer is not None
                heard.append(bytes([answer.arbitration_id]) + bytes(answer.data))
        assert program.stdin is not None
        program.stdin.close()
        assert program.wait(10.0) == 0
    assert heard[2:] == expected[2:]
