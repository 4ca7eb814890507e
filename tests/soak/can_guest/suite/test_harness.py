"""Runs over SocketCAN: the bits of a serial line; events of the interface are named."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import can
import pytest

from analogrig.bench import Bench
from analogrig.catalogue import LAYOUTS, Sample, unpack
from analogrig.devices.registry import open_dut
from analogrig.errors import LinkError, LinkTimeout
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario

from .interfaces import CONTROLLERS, VIRTUAL, device, down, queue, socketcan
from .test_port import FOREIGN

SAMPLES = 120
AT = 60
"""Sample during which the event happens."""

LONG_S = 60.0
"""Time-out of an answer that comes at once on an idle machine."""

HERE, THERE, ELSEWHERE = CONTROLLERS
ON_VIRTUAL = f"can:socketcan/{VIRTUAL}?device=host"
BUS_OFF = can.Message(arbitration_id=0x40, is_extended_id=False, is_error_frame=True, data=bytes(8))
RESTARTED = can.Message(arbitration_id=0x100, is_extended_id=False, is_error_frame=True, data=bytes(8))
"""CAN_ERR_BUSOFF, CAN_ERR_RESTARTED of include/uapi/linux/can/error.h."""

Listener = Callable[[can.Message], object]


def play(dut: str, listener: Listener | None = None, **changes: Any) -> Run:
    """A short scenario. The device has time to answer on a busy machine, where the guest gets little of a processor."""
    changes = {"timeout_s": LONG_S, **changes}
    scenario = dataclasses.replace(Scenario.load("healthy"), samples=SAMPLES)
    with open_rig("emulator") as rig, open_dut(dut, listener=listener, **changes) as opened:
        return Bench(rig, opened).play(scenario, seed=5)


def at_sample(act: Callable[[], object]) -> Listener:
    """Link that acts when the harness sends the sample AT."""

    def listener(frame: can.Message) -> None:
        message = None if frame.is_rx else unpack(bytes((frame.arbitration_id,)) + frame.data)
        if isinstance(message, Sample) and message.sample_index == AT:
            act()

    return listener


@pytest.fixture(scope="module")
def expected() -> str:
    """Hash of theta over a serial line."""
    run = play("host")
    assert run.conditions.faults == ()
    return run.theta_hash()


@pytest.mark.parametrize("exchange", ["sample", "stream"])
@pytest.mark.parametrize("settings", ["device=host", "device=inproc", "device=host&fd=1"])
def test_run_on_a_virtual_interface_gives_the_bits_of_a_serial_line(
    settings: str, exchange: str, expected: str
) -> None:
    run = play(f"can:socketcan/{VIRTUAL}?{settings}", exchange=exchange)
    assert run.conditions.faults == ()
    assert run.theta_hash() == expected


@pytest.mark.parametrize("exchange", ["sample", "stream"])
def test_run_from_controller_to_controller_gives_the_bits_of_a_serial_line(exchange: str, expected: str) -> None:
    with device(THERE):
        run = play(f"can:socketcan/{HERE}", exchange=exchange)
    assert run.conditions.faults == ()
    assert run.theta_hash() == expected


def test_frames_of_both_sides_are_told_to_who_listens() -> None:
    heard: list[can.Message] = []
    with open_dut(ON_VIRTUAL, listener=heard.append):
        pass
    assert {frame.is_rx for frame in heard} == {True, False}


def test_full_queue_is_waited_for(expected: str) -> None:
    with queue(VIRTUAL, limit_n=2, bitrate=250_000):
        run = play(ON_VIRTUAL, exchange="stream")
    assert run.conditions.faults == ()
    assert run.theta_hash() == expected


def test_queue_that_never_empties_is_told() -> None:
    """Such as the queue of a controller whose frames get no acknowledgement."""
    with (
        queue(VIRTUAL, limit_n=1, bitrate=8),
        pytest.raises(LinkError, match=r"socketcan/vcan0: nothing can be sent, the controller's queue has been full"),
    ):
        open_dut(f"can:socketcan/{VIRTUAL}", timeout_s=LONG_S)


def test_frames_of_others_are_counted_and_change_nothing(expected: str) -> None:
    """Ten frames of a third controller for each of ours, also between those of the device."""
    sent_n = 0

    def babble(frame: can.Message) -> None:
        nonlocal sent_n
        if not frame.is_rx:
            for _ in range(10):
                other.send(FOREIGN)
            sent_n += 10

    with device(THERE), socketcan(ELSEWHERE) as other:
        run = play(f"can:socketcan/{HERE}", babble)
    assert run.conditions.faults == ()
    assert run.theta_hash() == expected
    assert sent_n > 10 * SAMPLES
    assert run.conditions.link_counters["frames_foreign"] > sent_n - 20  # but of those after the last answer


@pytest.mark.parametrize("channel", [VIRTUAL, HERE])
def test_interface_that_goes_down_ends_the_run_with_its_name(channel: str) -> None:
    """Unplugged, or taken down by another program."""
    with contextlib.ExitStack() as undone, device(VIRTUAL if channel == VIRTUAL else THERE):
        run = play(f"can:socketcan/{channel}", at_sample(lambda: undone.enter_context(down(channel))))
    (fault,) = run.conditions.faults
    assert f"socketcan/{channel}: the interface is down" in fault


def test_bus_that_was_off_and_came_back_is_counted(expected: str) -> None:
    """Error frames as a driver sends them, here from another socket. No frame is lost."""
    with socketcan(VIRTUAL) as driver:
        run = play(ON_VIRTUAL, at_sample(lambda: [driver.send(told) for told in (BUS_OFF, RESTARTED)]))
    assert run.conditions.faults == ()
    assert run.theta_hash() == expected
    assert run.conditions.link_counters["error_frames"] == 2
    assert run.conditions.link_counters["bus_off"] == 1


def test_bus_that_stays_off_is_told_when_nobody_answers() -> None:
    def tell(frame: can.Message) -> None:
        if not frame.is_rx:
            driver.send(BUS_OFF)

    with socketcan(VIRTUAL) as driver, pytest.raises(LinkTimeout, match="the bus is bus-off"):
        open_dut(f"can:socketcan/{VIRTUAL}", listener=tell, timeout_s=0.5)


def test_another_harness_on_the_bus_is_noticed() -> None:
    with socketcan(VIRTUAL) as other:
        intruder = can.Message(arbitration_id=LAYOUTS["Sample"].id, is_extended_id=False, data=bytes(range(8)))
        run = play(ON_VIRTUAL, at_sample(lambda: other.send(intruder)))
    (fault,) = run.conditions.faults
    assert "another node uses the harness's identifiers" in fault


def test_interface_that_is_absent_is_told() -> None:
    with pytest.raises(LinkError, match="^cannot open can:socketcan/can7: there is no such interface"):
        open_dut("can:socketcan/can7")


def test_bus_without_a_device_is_told_with_how_it_was_opened() -> None:
    with pytest.raises(LinkTimeout, match=f"the bus was opened as can:socketcan/{HERE}"):
        open_dut(f"can:socketcan/{HERE}", timeout_s=0.5)
