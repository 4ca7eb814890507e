"""Device as a process on a SocketCAN interface (estimator_c/ports/host): events that only a kernel can cause."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

import can
import pytest

from analogrig.catalogue import (
    BLOCK_SAMPLES,
    CATALOGUE_HASH,
    RUN_SHIFT,
    Command,
    Control,
    Controlled,
    Counter,
    Firmware,
    FirmwareId,
    Hello,
    Identify,
    Message,
    SampleBlock,
    Status,
    Stepped,
    pack,
    unpack,
)
from analogrig.devices.child import Child
from analogrig.devices.processes import HOST_PROGRAM
from tests.harness.processes import LONG_S, children, ends

from .interfaces import CONTROLLERS, VIRTUAL, device, down, queue, socketcan

FOREIGN = can.Message(arbitration_id=0x7F0, is_extended_id=False, data=b"anything")


def frame(message: Message) -> can.Message:
    packet = pack(message)
    return can.Message(arbitration_id=packet[0], is_extended_id=False, data=packet[1:], is_fd=len(packet) > 9)


class Harness:
    """Peer of the device on a bus, as slow as a test needs."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._seq = 0

    def send(self, kind: Callable[..., Message], *fields: object) -> None:
        self._bus.send(frame(kind(self._seq, *fields)))
        self._seq += 1

    def answers(self, last: type[Message], *, n: int = 1) -> list[Message]:
        """Messages of the device, up to the last of so many of a kind."""
        heard: list[Message] = []
        while sum(isinstance(message, last) for message in heard) < n:
            came = self._bus.recv(LONG_S)
            assert came is not None, f"nothing after {heard[-1:]}"
            message = unpack(bytes((came.arbitration_id,)) + came.data)
            assert message is not None
            heard.append(message)
        return heard

    def play_block(self) -> list[Message]:
        """Start a run and send one full block; return the answers up to the last Stepped."""
        for command in (Command.RESET, Command.START):
            self.send(Control, command, 1)
            self.answers(Controlled)
        self.send(SampleBlock, BLOCK_SAMPLES | 1 << RUN_SHIFT, 0, 0, (2048,) * (2 * BLOCK_SAMPLES))
        return self.answers(Stepped, n=BLOCK_SAMPLES)

    def counters(self) -> dict[Counter, int]:
        self.send(Control, Command.STATUS, 0)
        heard = self.answers(Status, n=len(Counter))
        return {Counter(message.counter): message.value for message in heard if isinstance(message, Status)}


@pytest.mark.parametrize(
    ("harness", "arguments"),
    [(VIRTUAL, [VIRTUAL]), (VIRTUAL, [VIRTUAL, "--fd"]), (CONTROLLERS[0], [CONTROLLERS[1]])],
    ids=["virtual", "virtual-fd", "controllers"],
)
def test_device_says_who_it_is(harness: str, arguments: list[str]) -> None:
    with device(*arguments), socketcan(harness, fd="--fd" in arguments) as bus:
        talk = Harness(bus)
        talk.send(Identify)
        hello, firmware = talk.answers(Firmware)
    assert isinstance(hello, Hello) and hello.catalogue_hash == CATALOGUE_HASH
    assert isinstance(firmware, Firmware) and firmware.firmware_id == FirmwareId.HOST


def test_device_gives_the_reason_when_there_is_no_such_interface() -> None:
    child = Child([HOST_PROGRAM, "--can", "can7"], "the device")
    try:
        with pytest.raises(Exception, match="status 1: .*cannot open the CAN interface can7: No such device"):
            child.first_line()
    finally:
        child.end()


@pytest.mark.parametrize("interface", [VIRTUAL, CONTROLLERS[1]])
def test_device_ends_with_the_reason_when_its_interface_goes_down(interface: str) -> None:
    with device(interface) as child, down(interface):
        assert ends(child.tether_pid)
        assert (
            child.exit_report()
            == f"the device ended with status 1: analogrig-device: lost {interface}: Network is down"
        )


def test_answers_wait_for_a_queue_that_is_full_and_go_out_in_order() -> None:
    """Five elements and Stepped of each of fourteen samples, into a queue of three."""
    with device(VIRTUAL, "--fd"), socketcan(VIRTUAL, fd=True) as bus:
        talk = Harness(bus)
        quick = talk.play_block()
        with queue(VIRTUAL, limit_n=3, bitrate=250_000):
            slow = talk.play_block()
    assert len(quick) > BLOCK_SAMPLES
    assert [message._replace(seq=0) for message in slow] == [message._replace(seq=0) for message in quick]
    assert [(message.seq - slow[0].seq) % 256 for message in slow] == list(range(len(slow)))


def test_frames_that_are_not_for_the_device_are_counted_and_passed_over() -> None:
    identify = frame(Identify(0))
    foreign = [
        FOREIGN,
        can.Message(arbitration_id=identify.arbitration_id, is_extended_id=True, data=identify.data),
        can.Message(arbitration_id=identify.arbitration_id, is_extended_id=False, is_remote_frame=True, dlc=8),
    ]
    dropped = [
        can.Message(arbitration_id=identify.arbitration_id, is_extended_id=False, data=identify.data[:-1]),
        can.Message(arbitration_id=identify.arbitration_id, is_extended_id=False, data=identify.data, is_fd=True),
    ]
    error = can.Message(arbitration_id=0x40, is_extended_id=False, is_error_frame=True, data=bytes(8))
    with device(VIRTUAL), socketcan(VIRTUAL, fd=True) as bus:
        for each in (*foreign, *dropped, error):
            bus.send(each)
        counted = Harness(bus).counters()
    assert counted[Counter.FRAMES_FOREIGN] == len(foreign)
    assert counted[Counter.FRAMES_DROPPED] == 1  # a socket of classic CAN is not shown frames of CAN FD


def test_frames_that_the_system_dropped_for_the_device_are_counted() -> None:
    """The device takes no frame while it is stopped."""
    sent_n = 2000
    with device(VIRTUAL) as child, socketcan(VIRTUAL) as bus:
        (pid,) = children(child.tether_pid)
        os.kill(pid, signal.SIGSTOP)
        for _ in range(sent_n):
            bus.send(FOREIGN)
        os.kill(pid, signal.SIGCONT)
        counted = Harness(bus).counters()
    assert counted[Counter.RECEIVE_OVERRUNS] > 0
    assert counted[Counter.RECEIVE_OVERRUNS] + counted[Counter.FRAMES_FOREIGN] == sent_n
