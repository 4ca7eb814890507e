"""The device on CAN: the messages of the serial line in frames, and what else may come over a bus."""

from __future__ import annotations

import pytest

from analogrig.catalogue import LAYOUTS, Alarm, Command, Control, Counter, Identify, Sample, unpack
from tests.estimator_c.shells import ERROR, EXTENDED, FD, REMOTE, CanDevice, Frame, conversation, frame_of, over_serial

SAMPLE, BLOCK, STEPPED = (LAYOUTS[name].id for name in ("Sample", "SampleBlock", "Stepped"))


def packets(frames: list[Frame]) -> list[bytes]:
    assert all(answer.flags == 0 for answer in frames), "every answer fits classic CAN"
    return [bytes([answer.id]) + answer.data for answer in frames]


@pytest.mark.parametrize("in_blocks", [False, True])
@pytest.mark.parametrize("room", [1, 64])
def test_answers_are_those_of_the_serial_line_in_their_order(*, in_blocks: bool, room: int) -> None:
    device = CanDevice()
    told = [frame_of(message) for message in conversation(in_blocks=in_blocks)]
    answers = packets(device.tell(*told, room=room))
    assert answers == over_serial(in_blocks=in_blocks)
    assert any(isinstance(unpack(answer), Alarm) for answer in answers)


def test_no_room_no_work() -> None:
    device = CanDevice()
    assert device.run([frame_of(Identify(0))], 0) == (0, [])
    assert len(device.tell(frame_of(Identify(0)))) == 2


FOREIGN = {
    "of nobody that it knows": Frame(0x51),
    "of the highest identifier": Frame(0x7FF),
    "with the low byte of a message": Frame(0x100 | SAMPLE),
    "with 29 bits of identifier": Frame(SAMPLE, flags=EXTENDED),
    "with 29 bits of identifier, of CAN FD": Frame(BLOCK, bytes(64), EXTENDED | FD),
    "that asks for one": Frame(SAMPLE, b"", REMOTE),
    "with what only a device says": Frame(STEPPED),
}

DROPPED = {
    **{f"sample of {n} bytes": Frame(SAMPLE, bytes(n)) for n in range(8)},
    **{f"sample of {n} bytes in CAN FD": Frame(SAMPLE, bytes(n), FD) for n in (0, 7, 12, 64)},
    **{f"block of {n} bytes": Frame(BLOCK, bytes(n), FD) for n in (0, 8, 48)},
    "block in a classic frame": Frame(BLOCK, bytes(64)),
}


@pytest.mark.parametrize("intruder", FOREIGN)
def test_frame_of_others_is_passed_over_and_counted(intruder: str) -> None:
    disturbed(FOREIGN[intruder], Counter.FRAMES_FOREIGN, is_fd=True)


@pytest.mark.parametrize("intruder", DROPPED)
def test_frame_that_is_not_whole_is_dropped_and_counted(intruder: str) -> None:
    disturbed(DROPPED[intruder], Counter.FRAMES_DROPPED, is_fd=True)


@pytest.mark.parametrize("intruder", [Frame(SAMPLE, flags=FD), Frame(BLOCK, bytes(64), FD)])
def test_classic_device_drops_frames_of_can_fd(intruder: Frame) -> None:
    disturbed(intruder, Counter.FRAMES_DROPPED, is_fd=False)


def test_error_frame_is_nobodys() -> None:
    disturbed(Frame(SAMPLE, flags=ERROR), None, is_fd=True)


def disturbed(intruder: Frame, counter: Counter | None, *, is_fd: bool) -> None:
    """The intruder after every frame of a conversation changes one counter, and nothing else."""
    told = [frame_of(message) for message in conversation(in_blocks=False, n=20)]
    clean, device = CanDevice(is_fd=is_fd), CanDevice(is_fd=is_fd)
    for one in told[:-1]:
        answers = device.tell(one, intruder)
        assert answers == clean.tell(one)
        assert answers
    expected = clean.counters(len(told) - 1)
    assert set(expected) == set(Counter)
    if counter is not None:
        assert expected[counter] == 0
        expected[counter] = len(told) - 1
    assert device.counters(len(told) - 1) == expected


def test_device_of_can_fd_takes_short_messages_in_either_kind_of_frame() -> None:
    device = CanDevice()
    sent = [frame_of(message) for message in (Identify(0), Control(1, Command.START, 0), Sample(2, 0, 0, 1, 2))]
    answers = device.tell(*(one._replace(flags=FD) for one in sent))
    assert answers == CanDevice().tell(*sent)
    assert len(answers) == 2 + 1 + 8
