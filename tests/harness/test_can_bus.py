"""Buses that python-can opens: what its interfaces and the system say when something is wrong, as one line."""

from __future__ import annotations

import errno
import os
import pty
import termios
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from analogrig.errors import ConfigurationError, LinkClosed, LinkError
from analogrig.links.can_bus import PythonCanBus, complete_config
from analogrig.links.line import CanLine
from tests.harness.processes import LONG_S

FRAME = can.Message(arbitration_id=0x18, is_extended_id=False, data=bytes(8))


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    """Channel of a virtual bus that nobody else has."""
    return str(request.node.name)


@pytest.fixture
def bus(channel: str) -> Iterator[PythonCanBus]:
    bus = PythonCanBus({"interface": "virtual", "channel": channel})
    yield bus
    bus.close()


@pytest.fixture(autouse=True)
def _no_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    """Isolate the test from the user's own configuration."""
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        monkeypatch.delenv(name)
    monkeypatch.setattr("can.util.CONFIG_FILES", [])


def test_frames_pass_in_both_directions(bus: PythonCanBus, channel: str) -> None:
    with can.Bus(interface="virtual", channel=channel) as other:
        bus.send(FRAME)
        heard = other.recv(LONG_S)
        assert heard is not None and heard.equals(
            FRAME, timestamp_delta=None, check_channel=False, check_direction=False
        )
        other.send(FRAME)
        assert bus.receive(LONG_S) is not None
        assert bus.receive(0.0) is None


def test_bus_may_be_closed_twice(bus: PythonCanBus) -> None:
    bus.close()
    bus.close()


# ---- python-can's own configuration


def test_environment_says_what_is_not_said(monkeypatch: pytest.MonkeyPatch, channel: str) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    monkeypatch.setenv("CAN_CHANNEL", channel)
    monkeypatch.setenv("CAN_CONFIG", '{"fd": true, "bitrate": 500000, "data_bitrate": 2000000}')
    bus = PythonCanBus(complete_config({}))
    assert (bus.name, bus.is_fd) == (f"virtual/{channel}", True)
    assert bus.line is not None and bus.line.speed == "500000 bit/s, data 2000000 bit/s"
    bus.close()


def test_file_says_what_is_not_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, channel: str) -> None:
    (tmp_path / "can.conf").write_text(f"[default]\ninterface = virtual\nchannel = {channel}\nbitrate = 250000\n")
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(tmp_path / "can.conf")])
    bus = PythonCanBus(complete_config({"bitrate": 125_000}))
    assert bus.name == f"virtual/{channel}"
    assert bus.line is not None and bus.line.bitrate == 125_000
    bus.close()


def test_section_that_is_asked_for_comes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "can.conf").write_text(
        "[default]\ninterface = virtual\nchannel = a\nbitrate = 250000\n[bench]\nchannel = b\n"
    )
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(tmp_path / "can.conf")])
    assert complete_config({}) == {"interface": "virtual", "channel": "a", "bitrate": 250_000}
    assert complete_config({"config_context": "bench"}) == {"interface": "virtual", "channel": "b", "bitrate": 250_000}


def test_what_the_configuration_says_for_other_interfaces_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAN_CONFIG", '{"interface": "virtual", "app_name": "bench", "preserve_timestamps": true}')
    assert complete_config({}) == {"interface": "virtual", "channel": None, "preserve_timestamps": True}


@pytest.mark.parametrize(
    ("interface", "key"),
    [
        ("kvaser", "single_handle"),
        ("kvaser", "device_name"),
        ("slcan", "btr"),
        ("socketcan", "local_loopback"),
        ("vector", "app_name"),
        ("pcan", "nom_tseg1"),
        ("virtual", "protocol"),
    ],
)
def test_key_of_an_interface_is_known(interface: str, key: str) -> None:
    """python-can's documentation has it, whether or not it is among the parameters."""
    assert complete_config({"interface": interface, key: 1})[key] == 1


def test_bit_rate_may_be_said_by_the_timing_of_a_bit(channel: str) -> None:
    """8 MHz through 1, and 16 quanta a bit: 500 kbit/s; 80 MHz and 160, and 20 of the data: 500 kbit/s and 4 Mbit/s."""
    classic = {"f_clock": 8_000_000, "brp": 1, "tseg1": 11, "tseg2": 4, "sjw": 1, "nof_samples": 1}
    fd = {"f_clock": 80_000_000, "nom_brp": 1, "nom_tseg1": 119, "nom_tseg2": 40, "nom_sjw": 1}
    fd |= {"data_brp": 1, "data_tseg1": 14, "data_tseg2": 5, "data_sjw": 1}
    for timing, rates in ((classic, (500_000, None)), (fd, (500_000, 4_000_000))):
        bus = PythonCanBus(complete_config({"interface": "virtual", "channel": channel, **timing}))
        assert bus.line == CanLine(*rates)
        bus.close()


@pytest.mark.parametrize(
    ("asked", "kind", "said"),
    [
        ({}, ConfigurationError, "can: no interface given: use can:virtual or can:socketcan/can0, or set it in"),
        ({"interface": "foo"}, ConfigurationError, "can:foo: python-can knows canalystii, .*, and no 'foo'"),
        ({"interface": "sockecan"}, ConfigurationError, r".* and no 'sockecan': did you mean 'socketcan'\?$"),
        ({"interface": "slcan"}, ConfigurationError, "can:slcan: no channel given: use can:slcan/CHANNEL"),
        (
            {"interface": "slcan", "channel": "/dev/absent", "sleep_after_open": 0},
            LinkError,
            "cannot open can:slcan//dev/absent: No such file or directory",
        ),
        ({"interface": "virtual", "foo": 1, "state": "odd"}, ConfigurationError, "can: .*State config not valid!"),
        (
            {"config_context": "bench"},
            ConfigurationError,
            r"can: no interface given: .*CAN_INTERFACE_bench, ~/can.conf \[bench\]",
        ),
        (
            {"interface": "virtual", "nope": 1},
            ConfigurationError,
            "can:virtual: python-can's virtual has no key 'nope'$",
        ),
        (
            {"interface": "virtual", "rx_queue": 1},
            ConfigurationError,
            ".* no key 'rx_queue': did you mean 'rx_queue_size'[?]",
        ),
    ],
)
def test_what_cannot_be_opened_is_named(asked: dict[str, Any], kind: type[Exception], said: str) -> None:
    with pytest.raises(kind, match=f"^{said}") as caught:
        PythonCanBus(complete_config(asked))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.EAFNOSUPPORT, "this kernel has no CAN"),
        (errno.ENODEV, "there is no such interface"),
        (errno.EPERM, "Operation not permitted"),
    ],
)
def test_what_the_system_refuses_is_named(number: int, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("can.interfaces.socketcan.socketcan.create_socket", refuse)
    with pytest.raises(LinkError, match=f"^cannot open can:socketcan/can0: {said}"):
        PythonCanBus({"interface": "socketcan", "channel": "can0"})


# ---- while it is open


def failing(error: Exception, times: int) -> Callable[..., None]:
    """So often, and then well."""
    left = times

    def send(*_: object) -> None:
        nonlocal left
        left -= 1
        if left >= 0:
            raise error

    return send


NO_ROOM = can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS)
DOWN = can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN)


def test_full_queue_is_waited_for(bus: PythonCanBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus._bus, "send", failing(NO_ROOM, times=3))
    bus.send(FRAME)


@pytest.mark.parametrize("error", [NO_ROOM, can.CanTimeoutError(), can.CanOperationError("Transmit buffer full")])
def test_queue_that_stays_full_is_named_with_what_may_be_the_cause(
    bus: PythonCanBus, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("analogrig.links.can_bus.WRITE_TIMEOUT_S", 0.02)
    monkeypatch.setattr(bus._bus, "send", failing(error, times=1000))
    with pytest.raises(LinkError, match=r"queue has been full for 0\.02 s: nobody acknowledges") as caught:
        bus.send(FRAME)
    assert not isinstance(caught.value, LinkClosed)


@pytest.mark.parametrize("way", ["send", "recv"])
def test_interface_that_goes_down_is_gone(bus: PythonCanBus, way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus._bus, way, failing(DOWN, times=1))
    with pytest.raises(LinkClosed, match=r"^virtual/\S+: Network is down$"):
        bus.send(FRAME) if way == "send" else bus.receive(1.0)


def test_what_the_interface_cannot_read_is_counted(bus: PythonCanBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus._bus, "recv", failing(ValueError("invalid literal for int()"), times=2))
    assert [bus.receive(1.0), bus.receive(1.0), bus.receive(1.0)] == [None, None, None]
    assert bus.damaged == 2


@pytest.mark.parametrize(
    "field",
    [
        {"arbitration_id": 32.0},
        {"arbitration_id": float("nan")},
        {"arbitration_id": 0x800},
        {"arbitration_id": -1},
        {"bitrate_switch": "yes"},
        {"error_state_indicator": "yes"},
        {"is_fd": 1},
        {"dlc": 8.0},
        {"data": bytearray(65)},
    ],
    ids=str,
)
def test_frame_with_a_field_that_makes_no_sense_is_counted(
    bus: PythonCanBus, field: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frame with fields that a datagram of udp_multicast may have."""
    strange = can.Message(**{"arbitration_id": 0x20, "is_extended_id": False, "data": bytes(8), **field})
    monkeypatch.setattr(bus._bus, "recv", lambda _: strange)
    assert bus.receive(1.0) is None
    assert bus.damaged == 1


def test_garbage_of_an_adapter_is_counted_and_its_end_told() -> None:
    ours, theirs = pty.openpty()
    path = os.ttyname(theirs)
    bus = PythonCanBus({"interface": "slcan", "channel": path, "sleep_after_open": 0})
    os.write(ours, b"tXYZ\rt0208\xff\xff\r")
    assert [bus.receive(1.0), bus.receive(1.0)] == [None, None]
    assert bus.damaged == 2
    os.write(ours, b"t02020102\r")
    heard = bus.receive(1.0)
    assert heard is not None and (heard.arbitration_id, heard.data.hex()) == (0x20, "0102")
    os.close(theirs)
    os.close(ours)
    with pytest.raises(LinkClosed, match=f"^slcan/{path}: "):
        bus.receive(1.0)
    bus.close()


def test_terminal_whose_other_end_is_gone_while_it_is_written_to_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pyserial lets the termios.error of tcdrain() or tcflush() through, which is no OSError."""

    def gone(*_: object, **__: object) -> None:
        raise can.CanOperationError("Could not write to serial device") from termios.error(errno.EIO, "no such end")

    bus = PythonCanBus({"interface": "virtual", "channel": "gone"})
    try:
        monkeypatch.setattr(bus._bus, "send", gone)
        with pytest.raises(LinkClosed):
            bus.send(can.Message(arbitration_id=1))
    finally:
        bus.close()
