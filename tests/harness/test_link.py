"""Links over real lines: pseudo-terminals, sockets; and the program of the host port by itself."""

from __future__ import annotations

import itertools
import os
import pty
import socket
import subprocess
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from analogrig.catalogue import (
    CATALOGUE_HASH,
    Command,
    Control,
    Hello,
    Identify,
    Message,
    SampleBlock,
    Stepped,
    pack,
)
from analogrig.devices.library import MemoryWire
from analogrig.devices.processes import HOST_PROGRAM
from analogrig.errors import ConfigurationError, LinkClosed, LinkError
from analogrig.links.link import FrameDecoder, FramedLink, PortWire, encode_frame
from tests.harness.processes import LONG_S


class Terminal:
    """A pseudo-terminal; the test holds the far end."""

    def __init__(self) -> None:
        self.far, self._near = pty.openpty()
        tty.setraw(self._near)
        self.path = os.ttyname(self._near)

    def close(self) -> None:
        for fd in (self.far, self._near):
            try:
                os.close(fd)
            except OSError:  # the test has hung up
                continue

    def hang_up(self) -> None:
        os.close(self.far)


def at_port(url: str) -> FramedLink:
    return FramedLink(PortWire(url))


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    out = Terminal()
    yield out
    out.close()


@pytest.fixture
def link(terminal: Terminal) -> Iterator[FramedLink]:
    out = at_port(terminal.path)
    yield out
    out.close()


# ---- a port


def test_messages_go_out_as_frames_in_one_piece(link: FramedLink, terminal: Terminal) -> None:
    messages: list[Message] = [Identify(1), Control(2, 3, 4)]
    link.send(messages)
    assert os.read(terminal.far, 4096) == b"".join(encode_frame(pack(message)) for message in messages)


def test_messages_come_in_one_by_one(link: FramedLink, terminal: Terminal) -> None:
    messages: list[Message] = [Hello(1, 6, 0, 2), Stepped(2, 0, 7, 1.5), Stepped(3, 0, 8, 2.5)]
    os.write(terminal.far, b"noise" + b"".join(encode_frame(pack(message)) for message in messages))
    assert [link.receive(LONG_S) for _ in messages] == messages
    assert link.receive(0.0) is None
    assert link.counters == {"frames_dropped": 1}


def test_message_that_comes_in_halves_is_waited_for(link: FramedLink, terminal: Terminal) -> None:
    message = Stepped(2, 0, 7, 1.5)
    whole = encode_frame(pack(message))
    os.write(terminal.far, whole[:9])
    assert link.receive(0.0) is None
    os.write(terminal.far, whole[9:])
    assert link.receive(LONG_S) == message


@pytest.mark.parametrize(
    ("received", "told"),
    [
        (b"", "no byte came"),
        (b"x", "1 byte came without a valid frame: another speed, or another protocol"),
        (b"hello\r\n" * 9, "63 bytes came without a valid frame"),
        (b"\0\0\0", "3 bytes came without a valid frame"),
        (encode_frame(pack(Hello(1, 6, 0, 2)), 7)[:-3] + b"\0", "bytes came without a valid frame"),
        (b"noise" + encode_frame(pack(Hello(1, 6, 0, 2))), ""),
    ],
)
def test_silence_is_told_from_bytes_without_a_frame(
    link: FramedLink, terminal: Terminal, received: bytes, told: str
) -> None:
    os.write(terminal.far, received)
    while link.receive(0.01) is None and link._received_n < len(received):
        pass
    assert told in link.trouble
    assert bool(told) == bool(link.trouble)


def test_time_is_over_though_the_line_babbles(terminal: Terminal) -> None:
    """Bytes without end, but never a frame: the clock alone ends it."""
    seconds = itertools.count()

    def clock() -> float:
        os.write(terminal.far, b"babble" * 50)
        return float(next(seconds))

    link = at_port(terminal.path)
    link.clock = clock
    assert link.receive(50.0) is None
    assert 50 <= next(seconds) <= 110
    link.close()


def test_other_end_that_hangs_up_is_told_from_silence(link: FramedLink, terminal: Terminal) -> None:
    terminal.hang_up()
    with pytest.raises(LinkClosed, match=terminal.path):
        link.receive(LONG_S)
    with pytest.raises(LinkClosed, match=terminal.path):
        link.send([Identify(0)])


def test_line_that_takes_nothing_is_an_error_not_a_hang(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analogrig.links.link.WRITE_TIMEOUT_S", 0.05)
    link = at_port(terminal.path)
    with pytest.raises(LinkError, match="the other end does not read"):
        link.send([Identify(0)] * 100_000)
    link.close()


def test_port_is_opened_by_one_alone(link: FramedLink, terminal: Terminal) -> None:  # noqa: ARG001 - it holds the port
    with pytest.raises(LinkError, match=f"cannot open {terminal.path}"):
        at_port(terminal.path)


@pytest.mark.parametrize(
    ("url", "error", "said"),
    [
        ("/dev/ttyNOWHERE", LinkError, "^cannot open /dev/ttyNOWHERE: No such file or directory$"),
        (__file__, LinkError, f"cannot open {__file__}"),
        ("pigeon://coop", ConfigurationError, "pigeon://coop"),
    ],
)
def test_port_that_cannot_be_opened_is_named(url: str, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        at_port(url)


def test_link_may_be_closed_twice(link: FramedLink) -> None:
    link.close()
    link.close()


def test_any_url_of_pyserial_will_do_loop() -> None:
    link = at_port("loop://")
    messages: list[Message] = [Identify(1), Control(2, 3, 4)]
    link.send(messages)
    assert [link.receive(LONG_S), link.receive(LONG_S), link.receive(0.0)] == [*messages, None]
    link.close()


def test_any_url_of_pyserial_will_do_socket() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = at_port(f"socket://127.0.0.1:{server.getsockname()[1]}")
        far, _ = server.accept()
        with far:
            link.send([Identify(1)])
            assert far.recv(4096) == encode_frame(pack(Identify(1)))
            far.sendall(encode_frame(pack(Stepped(2, 0, 7, 1.5))))
            assert link.receive(LONG_S) == Stepped(2, 0, 7, 1.5)
            assert link.receive(0.0) is None
        with pytest.raises(LinkClosed):
            link.receive(LONG_S)
        link.close()


# ---- the device in this process


def test_library_that_was_not_built_is_named_with_the_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    absent = tmp_path / "absent.so"
    with pytest.raises(ConfigurationError, match=r"absent\.so: cannot be loaded as a library of a device"):
        MemoryWire(1, library=absent)
    monkeypatch.setattr("analogrig.devices.library.OWN_LIBRARIES", (absent,))
    with pytest.raises(LinkError, match="make setup"):
        MemoryWire(1, library=absent)


# ---- the program by itself


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [HOST_PROGRAM, *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LONG_S,
        check=False,
    )


def test_program_explains_itself() -> None:
    assert "usage: analogrig-device" in run("--help").stdout
    assert f"{CATALOGUE_HASH:08x}" in run("--version").stdout


def test_program_ends_with_its_input() -> None:
    done = run()
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("/dev/pts/")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--loud"], "unexpected argument: --loud"),
        (["/dev/null", "/dev/zero"], "unexpected argument: /dev/zero"),
        (["--catalogue-hash"], "not a hash of 32 bits: nothing"),
        (["--catalogue-hash", "1ffffffff"], "not a hash of 32 bits: 1ffffffff"),
        (["--catalogue-hash", "12x"], "not a hash of 32 bits: 12x"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(arguments: list[str], complaint: str) -> None:
    done = run(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"analogrig-device: {complaint} (see --help)\n"


@pytest.mark.parametrize("path", ["/dev/ttyNOWHERE", "/dev/null"])
def test_line_that_cannot_be_opened_is_named(path: str) -> None:
    done = run(path)
    assert done.returncode == 1
    assert done.stderr.startswith(f"analogrig-device: cannot open {path}: ")


def test_program_serves_a_serial_device_that_is_there_and_ends_when_it_is_gone(terminal: Terminal) -> None:
    with subprocess.Popen([HOST_PROGRAM, terminal.path], stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        os.write(terminal.far, encode_frame(pack(Identify(0))))
        received: list[bytes] = []
        decoder = FrameDecoder()
        while len(received) < 2:
            received += decoder.feed(os.read(terminal.far, 4096))
        assert received[0][0] == 0x31
        terminal.hang_up()
        assert process.wait(LONG_S) == 1
        assert process.stderr is not None
        assert process.stderr.read().decode().startswith(f"analogrig-device: lost {terminal.path}: ")


def test_device_answers_bursts_that_fill_its_output_to_the_last() -> None:
    """Work that is left over when the output has just been emptied must not wait for the next message."""
    burst, bursts = 11, 500
    with subprocess.Popen([HOST_PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        link = at_port(process.stdout.readline().strip())
        link.send([Control(0, Command.START, 0)])
        assert link.receive(LONG_S) is not None
        for i in range(bursts):
            first = i * burst
            link.send(
                SampleBlock((1 + k) % 256, 14, (14 * k) % 65536, 0, (100,) * 28) for k in range(first, first + burst)
            )
            stepped = 0
            while stepped < 14 * burst:
                answer = link.receive(LONG_S)
                assert answer is not None, f"silent after {stepped} samples of burst {i}"
                stepped += isinstance(answer, Stepped)
        link.close()
        process.stdin.close()  # type: ignore[union-attr]


def test_device_waits_for_a_harness_that_does_not_read() -> None:
    """A line that is full of answers delays, and loses nothing."""
    with subprocess.Popen([HOST_PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        link = at_port(process.stdout.readline().strip())
        asked = 300  # their answers are 13 times as long: far more than a terminal holds
        for i in range(asked):
            link.send([Control(i % 256, 5, 0)])
        answers = [link.receive(LONG_S) for _ in range(12 * asked)]
        assert [None if answer is None else answer.seq for answer in answers] == [i % 256 for i in range(12 * asked)]
        link.close()
        process.stdin.close()  # type: ignore[union-attr]
        assert process.wait(LONG_S) == 0
