"""`analogrig-device --listen`: the device on a TCP port, for clients of any origin."""

from __future__ import annotations

import contextlib
import signal
import socket
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass

import can
import pytest
import serial

from analogrig.bench import Bench
from analogrig.catalogue import Hello, Identify, pack, unpack_any
from analogrig.devices.device import Device
from analogrig.devices.processes import HOST_PROGRAM
from analogrig.devices.registry import describe, from_table
from analogrig.errors import LinkTimeout
from analogrig.links.link import FrameDecoder, encode_frame
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from tests.harness.fed import catalogue
from tests.harness.processes import LONG_S

QUESTION = encode_frame(pack(Identify(1)))
THESIS_HASH = "54f04f72e4f6d22a"
"""First digits of the theta_hash of the scenario thesis with the seed 7, on any device."""


@dataclass(frozen=True)
class Listener:
    """A running analogrig-device, and the port that it printed."""

    process: subprocess.Popen[str]
    address: str
    port: int

    @property
    def url(self) -> str:
        return f"socket://127.0.0.1:{self.port}"

    def client(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), LONG_S)


@contextlib.contextmanager
def listening(*arguments: str, address: str = "tcp://127.0.0.1:0") -> Iterator[Listener]:
    command = [str(HOST_PROGRAM), "--listen", address, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        printed = process.stdout.readline().strip()
        yield Listener(process, printed, int(printed.rpartition(":")[2]))
        process.kill()


@pytest.fixture
def listener() -> Iterator[Listener]:
    with listening() as started:
        yield started


def answers(line: socket.socket | serial.SerialBase, count: int) -> list[Hello]:
    """Answers of the device, of which Hello is the first to Identify."""
    decoder, found = FrameDecoder(), list[Hello]()
    while len(found) < count:
        received = line.recv(4096) if isinstance(line, socket.socket) else line.read(1)
        assert received, "the device has hung up"
        messages = [unpack_any(packet) for packet in decoder.feed(received)]
        found += [message for message in messages if isinstance(message, Hello)]
    return found


def is_closed(line: socket.socket) -> bool:
    """True if the other end has hung up; what it sent before is skipped."""
    try:
        while line.recv(4096):
            pass
    except ConnectionResetError:
        pass
    return True


# ---- clients


def play(dut: Device) -> Run:
    with open_rig("emulator") as rig:
        return Bench(rig, dut).play(Scenario.load("thesis"), seed=7)


@pytest.mark.parametrize("exchange", ["sample", "block", "stream"])
def test_estimates_are_those_of_every_other_line(listener: Listener, exchange: str) -> None:
    table = {"name": "bob", "kind": "serial", "url": listener.url, "exchange": exchange}
    with from_table(table, "bob").connect() as dut:
        played = play(dut)
    assert played.conditions.faults == ()
    assert played.theta_hash().startswith(THESIS_HASH)


def test_pyserial_talks_to_the_device(listener: Listener) -> None:
    with serial.serial_for_url(listener.url, timeout=LONG_S) as port:
        port.write(QUESTION)
        assert len(answers(port, 1)) == 1


def test_client_that_stops_sending_still_gets_its_answers(listener: Listener) -> None:
    with listener.client() as client:
        client.sendall(1000 * QUESTION)
        client.shutdown(socket.SHUT_WR)
        assert len(answers(client, 1000)) == 1000
        assert is_closed(client)


def test_python_can_talks_slcan_to_the_device() -> None:
    with (
        listening("--slcan") as listener,
        can.Bus(interface="slcan", channel=listener.url, bitrate=1_000_000, sleep_after_open=0.0) as bus,
    ):
        identify = pack(Identify(1))
        bus.send(can.Message(arbitration_id=identify[0], data=identify[1:], is_extended_id=False))
        answer = bus.recv(LONG_S)
        assert answer is not None
        assert isinstance(unpack_any(bytes([answer.arbitration_id, *answer.data])), Hello)


def test_client_waits_for_the_one_before_it_and_finds_a_device_that_has_just_booted(listener: Listener) -> None:
    description = describe(f"serial:{listener.url}")
    with description.connect() as dut, listener.client() as waiting:
        first = dut.description()["identity"]["boot_nonce"]
        dut.start()  # and never stopped
        waiting.sendall(QUESTION)
        catalogue(dut).status()  # the device, which has one context only, has turned to its first client again
        waiting.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            waiting.recv(1)
        waiting.settimeout(LONG_S)
        dut.close()
        assert len(answers(waiting, 1)) == 1
    with description.connect() as dut:
        assert dut.description()["identity"]["boot_nonce"] != first
        assert play(dut).theta_hash().startswith(THESIS_HASH)


def test_client_that_is_not_served_is_told_why(listener: Listener) -> None:
    table = {"name": "bob", "kind": "serial", "url": listener.url, "timeout_s": 0.2}
    with listener.client() as served:
        served.sendall(QUESTION)
        assert len(answers(served, 1)) == 1
        with pytest.raises(LinkTimeout, match="no Hello .*; the port may be serving another client$"):
            from_table(table, "bob").connect()


@pytest.mark.parametrize("begun", [b"", QUESTION[:4], 1000 * QUESTION], ids=["silent", "half", "unread"])
def test_client_that_vanishes_makes_way_for_the_next(listener: Listener, begun: bytes) -> None:
    """By a reset of the connection: it reads nothing, and closes with answers unread."""
    for _ in range(3):
        client = listener.client()
        client.sendall(begun)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
    with listener.client() as client:
        client.sendall(QUESTION)
        assert len(answers(client, 1)) == 1


# ---- address


@pytest.mark.parametrize(
    ("address", "host"),
    [("tcp://:0", "127.0.0.1"), ("tcp://127.0.0.1:0", "127.0.0.1"), ("tcp://0.0.0.0:0", "0.0.0.0")],  # noqa: S104
)
def test_address_is_printed_and_is_the_loopback_interface_unless_given(address: str, host: str) -> None:
    with listening(address=address) as listener:
        assert listener.address == f"tcp://{host}:{listener.port}"
        with listener.client() as client:
            client.sendall(QUESTION)
            assert len(answers(client, 1)) == 1


def refusal(*arguments: str) -> tuple[int, str]:
    """Exit status and error message."""
    done = subprocess.run(
        [HOST_PROGRAM, *arguments], input="", capture_output=True, text=True, timeout=LONG_S, check=False
    )
    (line,) = done.stderr.splitlines()
    assert done.stdout == ""
    return done.returncode, line


def test_port_in_use_is_named(listener: Listener) -> None:
    assert refusal("--listen", listener.address) == (
        1,
        f"analogrig-device: cannot listen on {listener.address}: Address already in use",
    )


@pytest.mark.parametrize(
    "address",
    [
        *("", "127.0.0.1:4000", "tcp://127.0.0.1", "tcp://127.0.0.1:", "tcp://127.0.0.1:x", "tcp://127.0.0.1:65536"),
        *("tcp://127.0.0.1:000000", "tcp://::1:4000", "tcp://[::1:4000", "tcp://[]4000", "tcp://a/b:4000"),
        f"tcp://{300 * 'a'}:4000",
    ],
)
def test_wrong_address_is_refused_with_an_example(address: str) -> None:
    assert refusal("--listen", address) == (
        2,
        f"analogrig-device: not an address like tcp://127.0.0.1:4000: {address} (see --help)",
    )


@pytest.mark.parametrize(
    "arguments", [("--listen",), ("--listen", "tcp://:0", "--can", "can0"), ("--listen", "tcp://:0", "/dev/ttyS0")]
)
def test_wrong_combination_is_refused(arguments: tuple[str, ...]) -> None:
    assert refusal(*arguments)[0] == 2


# ---- end


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
@pytest.mark.parametrize("is_served", [False, True])
def test_signal_ends_it_and_frees_the_port(listener: Listener, number: signal.Signals, *, is_served: bool) -> None:
    with listener.client() if is_served else contextlib.nullcontext() as client:
        if client is not None:
            client.sendall(QUESTION)
            answers(client, 1)
        listener.process.send_signal(number)
        assert listener.process.wait(LONG_S) == -number
        assert client is None or is_closed(client)
    with listening(address=listener.address) as again:
        assert again.port == listener.port


@pytest.mark.parametrize("is_served", [False, True])
def test_it_ends_with_its_standard_input(listener: Listener, *, is_served: bool) -> None:
    with listener.client() if is_served else contextlib.nullcontext() as client:
        if client is not None:
            client.sendall(QUESTION)
            answers(client, 1)
        assert listener.process.stdin is not None
        listener.process.stdin.close()
        assert listener.process.wait(LONG_S) == 0
        assert client is None or is_closed(client)
