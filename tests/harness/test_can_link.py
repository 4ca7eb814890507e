"""Messages over a CAN bus: how they lie in frames, and what others on the bus are to them."""

from __future__ import annotations

from collections import deque

import can
import pytest

from analogrig.catalogue import Estimate, Hello, Identify, Sample, SampleBlock, Stepped, pack
from analogrig.devices.catalogue_device import CatalogueDevice
from analogrig.devices.exchange import Conversation
from analogrig.devices.library import InprocDevice, MemoryBus
from analogrig.errors import ConfigurationError, LinkError, LinkTimeout
from analogrig.links.can_link import CanLink
from analogrig.links.line import CanLine
from analogrig.links.link import VirtualClock

SAMPLE = Sample(7, 0, 513, 1000, 2000)
ESTIMATE = Estimate(3, 1, 513, 0.5)

ACKNOWLEDGE_MISSING, CONTROLLER, OFF, RESTARTED = 0x20, 0x04, 0x40, 0x100
BOTH_PASSIVE, ACTIVE_AGAIN = 0x30, 0x40
"""linux/can/error.h: classes, and byte 1 of those about the controller."""


class Bus:
    """Keeps what is sent; says what it is given."""

    name = "bus"
    unread_n = None
    damaged = 0

    def __init__(self, *, is_fd: bool = False, line: CanLine | None = None) -> None:
        self.clock = VirtualClock()
        self.is_fd, self.line = is_fd, line
        self.sent: list[can.Message] = []
        self.said: deque[can.Message] = deque()

    def send(self, frame: can.Message) -> None:
        self.sent.append(frame)

    def receive(self, timeout_s: float) -> can.Message | None:
        if self.said:
            return self.said.popleft()
        self.clock.advance(timeout_s)
        return None

    def close(self) -> None:
        """Nothing is held."""


@pytest.fixture
def bus() -> Bus:
    return Bus()


def frame(identifier: int, data: bytes = b"", **other: object) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, **{"is_extended_id": False, **other})  # type: ignore[arg-type]


def estimate(**other: object) -> can.Message:
    """0x20: the packet of a message begins with its identifier."""
    return frame(0x20, pack(ESTIMATE)[1:], **other)


def error(classes: int, controller: int = 0) -> can.Message:
    return frame(classes, bytes((0, controller, 0, 0, 0, 0, 0, 0)), is_error_frame=True)


# ---- messages


def test_message_is_a_classic_frame_with_its_identifier(bus: Bus) -> None:
    """analogrig.dbc: Sample is 0x18; Seq, Run and Missing, SampleIndex, Force, Displacement, the low byte first."""
    CanLink(bus).send([SAMPLE])
    (sent,) = bus.sent
    assert (sent.arbitration_id, sent.is_extended_id, sent.is_fd) == (0x18, False, False)
    assert sent.data.hex() == "07000102e803d007"


@pytest.mark.parametrize(("line", "switches"), [(None, False), (CanLine(500_000, 2_000_000), True)])
def test_block_is_a_frame_of_can_fd(line: CanLine | None, switches: bool) -> None:  # noqa: FBT001
    bus = Bus(is_fd=True, line=line)
    CanLink(bus).send([SampleBlock(0, 14, 0, 0, 28 * (1,)), SAMPLE])
    assert [(len(sent.data), sent.is_fd, sent.bitrate_switch) for sent in bus.sent] == [
        (64, True, switches),
        (8, False, False),
    ]


def test_block_on_a_classic_bus_is_refused_in_one_line() -> None:
    dut = CatalogueDevice(CanLink(MemoryBus(1)), InprocDevice(name="bob", link="can", exchange="block"))
    with pytest.raises(ConfigurationError, match="^device bob: exchange: a block has 64 bytes, and a frame of classic"):
        dut.recover()


def test_messages_of_the_device_come_in_their_order(bus: Bus) -> None:
    stepped = Stepped(4, 0, 513, 1.5)
    bus.said += [estimate(), frame(0x21, pack(stepped)[1:])]
    link = CanLink(bus)
    assert [link.receive(1.0), link.receive(1.0), link.receive(1.0)] == [ESTIMATE, stepped, None]
    assert link.clock() == 1.0


# ---- others


@pytest.mark.parametrize(
    "other",
    [
        frame(0x7FF, bytes(8)),
        frame(0x00),
        frame(0x20, pack(ESTIMATE)[1:], is_extended_id=True),
        frame(0x20, is_remote_frame=True, dlc=8),
        frame(0x18, is_remote_frame=True, dlc=8),
    ],
    ids=["other id", "empty", "extended", "remote", "remote for the harness's"],
)
def test_what_is_none_of_ours_is_passed_over_and_counted(bus: Bus, other: can.Message) -> None:
    bus.said += [other, estimate(), other]
    link = CanLink(bus)
    assert [link.receive(1.0), link.receive(1.0)] == [ESTIMATE, None]
    assert link.counters == {"frames_dropped": 0, "frames_foreign": 2, "error_frames": 0}


@pytest.mark.parametrize(
    "damaged",
    [frame(0x20, pack(ESTIMATE)[1:-1]), frame(0x20), estimate(is_fd=True), frame(0x20, bytes(64), is_fd=True)],
    ids=["short", "empty", "FD", "long"],
)
def test_what_should_be_the_devices_and_is_not_is_dropped(bus: Bus, damaged: can.Message) -> None:
    bus.damaged = 3  # items that were no frames
    bus.said.append(damaged)
    link = CanLink(bus)
    assert link.receive(1.0) is None
    assert link.counters["frames_dropped"] == 4


def test_message_in_a_frame_of_can_fd_is_taken_where_there_is_can_fd() -> None:
    bus = Bus(is_fd=True)
    bus.said.append(estimate(is_fd=True))
    assert CanLink(bus).receive(1.0) == ESTIMATE


@pytest.mark.parametrize("is_rx", [True, False])
def test_own_echoes_are_passed_over_untold_and_take_no_time(is_rx: bool) -> None:  # noqa: FBT001
    bus = Bus(line=CanLine(1_000_000))
    link = CanLink(bus)
    told: list[can.Message] = []
    link.listen(told.append)
    link.send([SAMPLE])
    sent_s = link.line_s
    bus.said.append(frame(0x18, bytes(bus.sent[0].data), is_rx=is_rx))
    assert link.receive(1.0) is None
    assert len(told) == 1 and link.line_s == sent_s
    bus.said.append(estimate())
    assert link.receive(1.0) == ESTIMATE
    assert link.counters["frames_foreign"] == 0


def test_somebody_else_who_speaks_as_the_harness_ends_the_talk(bus: Bus) -> None:
    link = CanLink(bus)
    link.send([SAMPLE])
    bus.said.append(frame(0x18, pack(SAMPLE._replace(force=1001))[1:]))
    with pytest.raises(LinkError, match=r"uses the harness's identifiers \(frame 0x018 with 07000102e903d007\)"):
        link.receive(1.0)


def test_somebody_else_who_speaks_as_the_device_ends_the_talk(bus: Bus) -> None:
    """The genuine message follows with the number that is no longer due."""
    bus.said += [frame(0x20, pack(ESTIMATE._replace(value=0.25))[1:]), estimate()]
    talk = Conversation(CanLink(bus), "bob", 1.0)
    talk.receive(1.0)
    with pytest.raises(
        LinkError, match="have the same number, 3: the device was reset, or two nodes send as this device"
    ):
        talk.receive(1.0)


def test_message_that_comes_twice_is_no_other_one(bus: Bus) -> None:
    bus.said += [estimate(), estimate()]
    talk = Conversation(CanLink(bus), "bob", 1.0)
    assert [talk.receive(1.0), talk.receive(2.0)] == [ESTIMATE, None]


# ---- what the controller says


@pytest.mark.parametrize(
    ("errors", "trouble"),
    [
        ([error(CONTROLLER, BOTH_PASSIVE)], "the bus is error-passive, 1 error frame (the last: controller)"),
        ([error(ACKNOWLEDGE_MISSING), error(OFF)], "the bus is bus-off, 2 error frames (the last: bus-off)"),
        ([error(OFF), error(RESTARTED)], "2 error frames (the last: restarted)"),
        ([error(CONTROLLER, BOTH_PASSIVE), error(CONTROLLER, ACTIVE_AGAIN)], "2 error frames (the last: controller)"),
        ([error(ACKNOWLEDGE_MISSING), frame(0x123)], "1 error frame (the last: not acknowledged), 1 frame of others"),
        ([], ""),
    ],
)
def test_silence_is_explained_by_what_the_controller_says(bus: Bus, errors: list[can.Message], trouble: str) -> None:
    bus.said += errors
    link = CanLink(bus)
    with pytest.raises(LinkTimeout) as caught:
        Conversation(link, "bob", 1.0).ask(Identify(0), Hello)
    said = f"(last message: none{'; ' if trouble else ''}{trouble})"
    assert str(caught.value) == f"device bob: no Hello in answer to Identify within 1 s {said}"


def test_states_of_the_controller_are_counted(bus: Bus) -> None:
    bus.said += [error(CONTROLLER, BOTH_PASSIVE), error(OFF), error(RESTARTED), error(OFF), error(CONTROLLER, 0x01)]
    link = CanLink(bus)
    link.receive(1.0)
    assert link.counters == {
        "frames_dropped": 0,
        "frames_foreign": 0,
        "error_frames": 5,
        "error_passive": 1,
        "bus_off": 2,
        "receive_overflows": 1,
    }


# ---- listening, and time


def test_listener_is_told_every_frame_and_when(bus: Bus) -> None:
    told: list[tuple[float, bool, int]] = []

    def note(message: can.Message) -> None:
        told.append((message.timestamp, message.is_rx, message.arbitration_id))

    link = CanLink(bus)
    link.listen(note)
    link.send([SAMPLE])
    bus.clock.advance(0.25)
    bus.said += [frame(0x123, is_extended_id=True), error(OFF), frame(0x18, bytes(bus.sent[0].data), is_rx=False)]
    link.receive(1.0)
    bus.said.append(estimate())
    link.receive(1.0)
    assert told == [(0.0, False, 0x18), (0.25, True, 0x123), (0.25, True, OFF), (1.25, True, 0x20)]


@pytest.mark.parametrize(("line", "expected_s"), [(CanLine(1_000_000), 135e-6), (CanLine(125_000), 1080e-6)])
def test_frames_take_their_time(line: CanLine, expected_s: float) -> None:
    """Davis et al. 2007: a frame of 8 bytes has 111 bits and at most 24 stuff bits, 1080 us at 125 kbit/s."""
    bus = Bus(line=line)
    link = CanLink(bus)
    link.send([SAMPLE])
    bus.said.append(estimate())
    link.receive(1.0)
    assert 2 * 111 / 135 * expected_s < link.line_s < 2 * expected_s
    assert line.message_s(Sample) == pytest.approx(expected_s)


def test_bus_carries_one_thing_at_a_time() -> None:
    assert CanLine(1_000_000).together_s(1.0, 2.0) == 3.0
