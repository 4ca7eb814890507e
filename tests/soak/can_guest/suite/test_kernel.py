"""Assumptions of the link about the kernel's interfaces and python-can."""

from __future__ import annotations

import errno
import itertools

import can
import pytest

from tests.harness.processes import LONG_S

from .interfaces import CONTROLLERS, VIRTUAL, down, queue, socketcan, state

MOMENT_S = 0.1
"""Wait for a frame that must not come, in seconds."""
BUS_OFF = 0x40
"""CAN_ERR_BUSOFF of include/uapi/linux/can/error.h."""

CLASSIC = (
    can.Message(arbitration_id=0x7FF, is_extended_id=False, data=bytes(range(8))),
    can.Message(arbitration_id=0x1FFFFFFF, data=b""),
    can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=0),
)
"""QEMU's SJA1000 (7.2) forgets where the next frame begins after a remote one of another length."""
VIRTUAL_ONLY = (
    can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=4),
    can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=True, data=bytes(range(64))),
    can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(12)),
)


@pytest.mark.parametrize(
    ("sender", "receiver", "frames"),
    [
        (VIRTUAL, VIRTUAL, CLASSIC + VIRTUAL_ONLY),
        *((*pair, CLASSIC) for pair in itertools.permutations(CONTROLLERS, 2)),
    ],
)
def test_frames_of_every_kind_arrive_as_they_were_sent(
    sender: str, receiver: str, frames: tuple[can.Message, ...]
) -> None:
    is_fd = any(frame.is_fd for frame in frames)
    with socketcan(sender, fd=is_fd) as bus, socketcan(receiver, fd=is_fd) as other:
        for frame in frames:
            bus.send(frame)
            arrived = other.recv(LONG_S)
            assert arrived is not None and arrived.is_rx == (sender != receiver)
            assert frame.equals(arrived, timestamp_delta=None, check_channel=False, check_direction=False)


@pytest.mark.parametrize("channel", [VIRTUAL, CONTROLLERS[0]])
def test_own_frames_do_not_come_back(channel: str) -> None:
    with socketcan(channel) as bus:
        bus.send(CLASSIC[0])
        assert bus.recv(MOMENT_S) is None


def test_controller_without_can_fd_refuses_its_frames() -> None:
    with socketcan(CONTROLLERS[0], fd=True) as bus, pytest.raises(can.CanOperationError) as raised:
        bus.send(VIRTUAL_ONLY[-1])
    assert raised.value.error_code == errno.EINVAL


def test_error_frames_are_seen_with_their_class() -> None:
    """Error frames as a driver gives them, here from another socket."""
    bus_off = can.Message(arbitration_id=BUS_OFF, is_extended_id=False, is_error_frame=True, data=bytes(8))
    with socketcan(VIRTUAL) as bus, socketcan(VIRTUAL) as driver:
        driver.send(bus_off)
        seen = bus.recv(LONG_S)
    assert seen is not None and seen.is_error_frame
    assert seen.arbitration_id == BUS_OFF


@pytest.mark.parametrize("channel", [VIRTUAL, CONTROLLERS[0]])
def test_interface_that_goes_down_fails_whoever_listens_and_whoever_sends(channel: str) -> None:
    with socketcan(channel) as bus:
        with down(channel):
            with pytest.raises(can.CanOperationError) as raised:
                bus.recv(LONG_S)
            assert raised.value.error_code == errno.ENETDOWN
            with pytest.raises(can.CanOperationError) as raised:
                bus.send(CLASSIC[0])
            assert raised.value.error_code == errno.ENETDOWN
        bus.send(CLASSIC[0])


def test_full_queue_refuses_a_frame_at_once() -> None:
    """The sender must therefore wait."""
    with socketcan(VIRTUAL) as bus, queue(VIRTUAL, limit_n=1, bitrate=8):
        bus.send(CLASSIC[0])  # takes 16 s and more
        with pytest.raises(can.CanOperationError) as raised:
            bus.send(CLASSIC[0], timeout=LONG_S)
        assert raised.value.error_code == errno.ENOBUFS


@pytest.mark.parametrize("channel", CONTROLLERS)
def test_controllers_are_some_that_know_no_can_fd(channel: str) -> None:
    told = state(channel)
    assert told["mtu"] == 16  # CAN_MTU; CANFD_MTU is 72
    assert told["linkinfo"]["info_data"]["state"] == "ERROR-ACTIVE"
    assert told["linkinfo"]["info_data"]["bittiming"]["bitrate"] == 500_000
