"""Devices on CAN: how they are named, and that they say the same to the bit as over a serial line."""

from __future__ import annotations

import dataclasses
import functools
import os
import socket
import threading
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.catalogue import Counter
from analogrig.devices.can import CanDevice
from analogrig.devices.device import Device
from analogrig.devices.library import InprocDevice
from analogrig.devices.registry import describe, from_table, open_dut, reopen_dut
from analogrig.errors import ConfigurationError, DeviceError, LinkError
from analogrig.judging.verdict import judge
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from tests.harness.commands import error_of
from tests.harness.fed import catalogue, fed
from tests.soak.fault_runs import DISPLACEMENT, ESTIMATOR, FORCE, N, reference

# ---- names


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("can:virtual", {"interface": "virtual"}),
        ("can:", {}),
        (
            "can:socketcan/can0?bitrate=1000000&fd=1&device=host",
            {"interface": "socketcan", "channel": "can0", "bitrate": 1_000_000, "fd": True, "device": "host"},
        ),
        ("can:slcan//dev/ttyACM0", {"interface": "slcan", "channel": "/dev/ttyACM0"}),
        (
            "can:slcan//dev/tty%3F?sleep_after_open=0.5&rtscts=true&btr=031C&n=7&exchange=stream",
            {
                "interface": "slcan",
                "channel": "/dev/tty%3F",
                "exchange": "stream",
                "options": {"sleep_after_open": 0.5, "rtscts": True, "btr": "031C", "n": 7},
            },
        ),
        ("can:udp_multicast/239.74.163.2", {"interface": "udp_multicast", "channel": "239.74.163.2"}),
        ("can:?interface=kvaser&channel=0", {"interface": "kvaser", "channel": "0"}),
    ],
)
def test_bus_is_named_with_what_python_can_is_to_be_told(name: str, expected: dict[str, Any]) -> None:
    description = describe(name)
    assert isinstance(description, CanDevice)
    assert description == CanDevice(name=name, **expected)
    assert from_table(description.as_table(), "recorded").as_table() == description.as_table()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("can:virtual?foo", "can:virtual?foo: 'foo' is not KEY=VALUE"),
        ("can:virtual?fd=maybe", "fd: must be true or false, not 'maybe'"),
        ("can:virtual?bitrate=fast", "bitrate: must be a whole number, not 'fast'"),
        ("can:virtual?bitrate=0", "bitrate must be 1 to 20000000, not 0"),
        ("can:virtual?device=bob", "device: must be one of 'none', 'inproc', 'host', not 'bob'"),
        ("can:virtual?device=host", "a host process needs SocketCAN, not virtual: use inproc"),
        ("can:virtual?data_bitrate=2000000", "data_bitrate is for CAN FD: set fd = true and bitrate as well"),
        ("host?link=can", "unknown key 'link'"),
        ("inproc?link=slcan", "link: must be one of 'serial', 'can', not 'slcan'"),
        ("inproc?bitrate=1000000", "bitrate and fd are for a CAN bus: set link = 'can'"),
        ("inproc?link=can&baud=9600", "baud is for a serial line, and link is 'can': set bitrate"),
        ("host?foo=1", "unknown key 'foo'"),
        ("host:there", "a device of the kind host has no 'there'"),
        ("can:virtual?wire_faults=flip@to:1", "'flip@to:1' is not KIND@to:FRAME"),
        ("can:virtual?fd=1&fd=0", "can:virtual?fd=1&fd=0: fd is given twice"),
        ("can:virtual?interface=slcan", "interface is given twice"),
        ("can:virtual/a?channel=b", "channel is given twice"),
        ("inproc:./a.so?library=./b.so", "library is given twice"),
        ("host?name=bob", "name is given twice"),
        *(
            (
                f"can:{each}//dev/ttyACM0?device=inproc",
                f"inproc needs a connection of its own, and a {each} adapter",
            )
            for each in ("slcan", "serial", "robotell")
        ),
    ],
)
def test_wrong_name_is_one_line(name: str, said: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        describe(name)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_url_of_a_serial_port_keeps_its_question_mark() -> None:
    assert describe("serial:socket://bob:7?logging=debug").as_table()["url"] == "socket://bob:7?logging=debug"


def test_option_that_a_device_has_not_is_named(tmp_path: Path) -> None:
    assert (
        error_of("run", "--dut", "can:virtual", "--baud", "9600", "--out", str(tmp_path))
        == "analogrig: device can:virtual: a device of the kind can has no baud\n"
    )


def test_device_on_a_bus_is_not_opened_again_on_the_word_of_a_recording() -> None:
    recorded = CanDevice(name="bob", interface="socketcan", channel="can0").as_table()
    with pytest.raises(ConfigurationError, match="CAN bus can:socketcan/can0, which no file may order: pass"):
        reopen_dut(recorded, "run.npz")


# ---- python-can's own configuration


@pytest.fixture
def _configured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By a file, with a section that is not the first."""
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        monkeypatch.delenv(name)
    (tmp_path / "can.conf").write_text(
        "[default]\ninterface = virtual\nbitrate = 250000\n[desert]\nchannel = dunes\n[board]\ninterface = slcan\n"
    )
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(tmp_path / "can.conf")])


@pytest.mark.usefixtures("_configured")
def test_virtual_bus_of_the_configuration_has_the_device_of_this_process_on_it() -> None:
    with open_dut("can:") as dut:
        assert catalogue(dut).recover().firmware == "LIBRARY"


@pytest.mark.usefixtures("_configured")
def test_silent_bus_of_the_configuration_is_named() -> None:
    with pytest.raises(LinkError, match="the bus was opened as can:virtual/dunes: is the device on it"):
        open_dut("can:?config_context=desert&device=none", timeout_s=0.01)


@pytest.mark.usefixtures("_configured")
def test_device_that_cannot_be_on_the_bus_of_the_configuration_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="a host process needs SocketCAN, not virtual: use inproc"):
        open_dut("can:?device=host")
    with pytest.raises(ConfigurationError, match="inproc needs a connection of its own, and a slcan adapter"):
        open_dut("can:/dev/ttyACM0?config_context=board&device=inproc")


@pytest.mark.usefixtures("_configured")
def test_bit_rate_of_the_configuration_is_in_the_record() -> None:
    run = play(describe("can:"), scenario=dataclasses.replace(THESIS, samples=56, changes=()))
    assert run.conditions.line == {"bitrate": 250_000, "samples_per_message": 1, "window": 1}


@pytest.mark.usefixtures("_configured")
def test_real_time_that_does_not_fit_the_bus_of_the_configuration_is_refused() -> None:
    said = "need 97.2 times the capacity of 250000 bit/s"
    with open_rig("emulator") as rig, open_dut("can:") as dut, pytest.raises(ConfigurationError, match=said):
        Bench(rig, dut, real_time=1.0).play(THESIS, seed=1)


# ---- the same to the bit


THESIS = Scenario.load("thesis")


def play(description: Any, *, seed: int = 1, scenario: Scenario = THESIS) -> Run:
    with open_rig("emulator") as rig, description.connect() as dut:
        return Bench(rig, dut).play(scenario, seed)


@functools.cache
def serial_hash() -> str:
    return judge(play(InprocDevice(name="bob", exchange="block"))).theta_hash


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        return int(free.getsockname()[1])


@pytest.mark.parametrize(
    "name",
    [
        "inproc?link=can",
        "inproc?link=can&exchange=stream",
        "inproc?link=can&fd=1&exchange=block",
        "can:virtual",
        "can:virtual?exchange=stream",
        "can:virtual?fd=1&exchange=stream",
        "can:udp_multicast/239.74.163.2?device=inproc&port=PORT",
        "can:udp_multicast/239.74.163.2?device=inproc&port=PORT&fd=1&exchange=stream",
    ],
)
def test_theta_is_that_of_a_serial_line(name: str) -> None:
    run = play(describe(name.replace("PORT", str(free_port()))))
    assert run.conditions.faults == ()
    assert judge(run).theta_hash == serial_hash()
    assert run.conditions.link_counters == {"frames_dropped": 0, "frames_foreign": 0, "error_frames": 0}


def feed(dut: Device) -> None:
    """N samples, answered as ever.

    :raises AssertionError: otherwise.
    """
    dut.start()
    replies = fed(dut, 0, FORCE[:N], DISPLACEMENT[:N], np.zeros(N, bool))
    assert np.array_equal(replies.theta, reference(N, ()).theta)
    dut.stop()


# ---- what a bus can carry


def test_real_time_that_does_not_fit_the_bus_is_refused_with_the_arithmetic() -> None:
    """At most 135 bits a frame (Davis et al. 2007): one there and eight back, 20,000 times a second, at 1 Mbit/s."""
    with open_rig("emulator") as rig, InprocDevice(name="bob", link="can", bitrate=1_000_000).connect() as dut:
        with pytest.raises(ConfigurationError) as caught:
            Bench(rig, dut, real_time=1.0).play(THESIS, seed=1)
        assert str(caught.value) == (
            "device bob: real time does not fit its line: 20000 samples/s, each of 135 us to the device and 1080 us"
            " back (7 estimates every 1 samples), need 24.3 times the capacity of 1000000 bit/s;"
            " 24.3 times slower would fit"
        )
        short = Scenario(samples=56, excitation=THESIS.excitation)
        assert Bench(rig, dut, real_time=24.31).play(short, seed=1).samples == 56


def test_time_on_the_bus_is_that_of_all_frames() -> None:
    with InprocDevice(name="bob", link="can", bitrate=500_000, estimator=ESTIMATOR).connect() as dut:
        dut.start()
        fed(dut, 0, FORCE[:N], DISPLACEMENT[:N], np.zeros(N, bool))
        alarms = catalogue(dut).status()["alarms"]
        frames = 9 * N + alarms + 1 + len(Counter)  # the question for the counters, and an answer for each
        assert 111 / 500_000 < dut.line_s / frames < 135 / 500_000


# ---- on a bus with others


def on_virtual(channel: str, **other: Any) -> CanDevice:
    return CanDevice(name="bob", interface="virtual", channel=channel, estimator=ESTIMATOR, timeout_s=1.0, **other)


def test_traffic_of_others_is_counted_and_does_no_harm() -> None:
    """A node that sends as fast as it can."""
    ends, sent = threading.Event(), 0

    def babble() -> None:
        nonlocal sent
        with can.Bus(interface="virtual", channel="crowd") as other:
            while not ends.wait(1e-4):
                other.send(can.Message(arbitration_id=0x100 + sent % 0x600, is_extended_id=False, data=bytes(8)))
                sent += 1

    thread = threading.Thread(target=babble)
    thread.start()
    try:
        with on_virtual("crowd").connect() as dut:
            while not sent:
                catalogue(dut).identity()
            feed(dut)
            counters = dut.link_counters
    finally:
        ends.set()
        thread.join()
    assert 0 < counters["frames_foreign"] <= sent
    assert counters["frames_dropped"] == 0


def test_device_does_not_count_what_it_said_itself_where_the_bus_shows_it() -> None:
    heard: list[can.Message] = []
    name = f"can:udp_multicast/239.74.163.2?device=inproc&port={free_port()}"
    with open_dut(name, listener=heard.append) as dut:
        dut.start()
        fed(dut, 0, FORCE[:N], DISPLACEMENT[:N], np.zeros(N, bool))
        assert dut.stop()["frames_foreign"] == 0
    assert sum(each.arbitration_id == 0x18 for each in heard) == N


def test_two_devices_on_one_bus_are_found_out() -> None:
    def greet_often() -> None:
        """Connect, and request the identity 100 times."""
        with on_virtual("twins").connect() as dut:  # the other device may answer after the handshake
            for _ in range(100):
                catalogue(dut).identity()

    with on_virtual("twins").connect(), pytest.raises((LinkError, DeviceError)):
        greet_often()


def test_two_harnesses_on_one_bus_are_found_out() -> None:
    with on_virtual("rivals").connect() as dut, can.Bus(interface="virtual", channel="rivals") as other:
        other.send(can.Message(arbitration_id=0x30, is_extended_id=False, data=bytes((99, 0, 0, 0, 0, 0, 0, 0))))
        with pytest.raises(LinkError, match="another node uses the harness's identifiers"):
            catalogue(dut).identity()


def test_runs_on_virtual_buses_without_a_name_do_not_meet() -> None:
    with open_dut("can:virtual") as one, open_dut("can:virtual") as other:
        assert one.link_name != other.link_name
        assert catalogue(one).recover().boot_nonce != catalogue(other).recover().boot_nonce


def test_bus_without_a_device_is_told_with_how_it_was_opened() -> None:
    with pytest.raises(LinkError) as caught:
        on_virtual("desert", device="none").connect()
    assert str(caught.value) == (
        "device bob: no Hello in answer to Identify within 1 s (last message: none); the bus was opened as"
        " can:virtual/desert: is the device on it, at the same bit rate?"
    )


def test_listener_hears_the_handshake_and_the_samples() -> None:
    heard: list[can.Message] = []
    with open_dut("can:virtual", listener=heard.append) as dut:
        dut.start()
        fed(dut, 0, FORCE[:N], DISPLACEMENT[:N], np.zeros(N, bool))
    assert heard[0].arbitration_id == 0x30 and not heard[0].is_rx
    assert sum(each.arbitration_id == 0x18 and not each.is_rx for each in heard) == N
    assert sum(each.arbitration_id == 0x21 and each.is_rx for each in heard) == N
    times_s = [each.timestamp for each in heard]
    assert times_s == sorted(times_s)


def test_what_else_was_on_the_line_is_in_the_recording(tmp_path: Path) -> None:
    description = InprocDevice(name="bob", link="can", wire_faults="babble@from:100,error@to:5,error@to:60")
    run = play(description, scenario=THESIS)
    run.save(tmp_path / "run.npz")
    counters = Run.load(tmp_path / "run.npz").conditions.link_counters
    assert counters["error_frames"] == 2
    assert counters["frames_foreign"] > run.samples
    assert judge(run).valid
