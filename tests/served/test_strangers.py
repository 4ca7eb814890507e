"""Strangers on every TCP port that is served: requests of HTTP, and connections that say nothing or too little.

A page in a browser can send any request of HTTP to a port of this machine, with commands in its body.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from analogrig_instruments.simulator.server import Server
from analogrig_lucidac.served_machine import LucidacServer, specimen
from tests.harness.live.benches import LiveBench
from tests.harness.processes import LONG_S
from tests.harness.test_listen import QUESTION, listening
from tests.served.serving import in_thread
from tests.served.test_server import Counter

EMPTY_FRAME = b"\x00"
"""Message of a LUCIDAC that is answered with an error."""


@dataclass(frozen=True)
class Port:
    """Port of a running server."""

    number: int
    question: bytes
    """Question that is answered."""
    what: str
    """Part of the line that says what the port is."""
    executed: Callable[[], int]
    """Number of commands executed, apart from questions."""

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.number), LONG_S)

    def answers(self) -> bool:
        with self.connect() as line:
            return self.replies(line)

    def replies(self, line: socket.socket) -> bool:
        line.sendall(self.question)
        return bool(line.recv(4096))


@contextlib.contextmanager
def red_pitaya() -> Iterator[Port]:
    counter = Counter()
    with in_thread(Server(counter)) as served:
        yield Port(served.port, b"COUNT?\n", "an emulated Red Pitaya", lambda: counter.count)


@contextlib.contextmanager
def lucidac() -> Iterator[Port]:
    with in_thread(LucidacServer(specimen(1))) as served:
        yield Port(served.port, EMPTY_FRAME, "an emulated LUCIDAC", lambda: 0)


@contextlib.contextmanager
def device() -> Iterator[Port]:
    with listening() as started:
        yield Port(started.port, QUESTION, "analogrig-device", lambda: 0)


SERVERS = {"red-pitaya": red_pitaya, "lucidac": lucidac, "analogrig-device": device}


@pytest.fixture(params=SERVERS)
def port(request: pytest.FixtureRequest) -> Iterator[Port]:
    with SERVERS[request.param]() as running:
        yield running


HEADERS = "Host: 127.0.0.1\r\nOrigin: http://example.com\r\nContent-Type: text/plain\r\n\r\n"
BODY = b"COUNT\nCOUNT\nCOUNT?\n" + EMPTY_FRAME * 200 + b"\x00" + QUESTION + b"\x00"
"""Commands and questions of every server."""

REQUESTS = {
    "POST": "POST / HTTP/1.1\r\n",
    "GET": "GET / HTTP/1.1\r\n",
    "GET with a command in its path": "GET /;COUNT; HTTP/1.1\r\n",
    "lower case": "post / http/1.1\r\n",
    "preflight": "OPTIONS * HTTP/1.1\r\n",
    "HEAD of HTTP/1.0": "HEAD / HTTP/1.0\r\n",
    "PUT": "PUT /data HTTP/1.1\r\n",
    "PATCH": "PATCH /data HTTP/1.1\r\n",
    "DELETE": "DELETE /data HTTP/1.1\r\n",
    "tunnel of a proxy": "CONNECT 127.0.0.1:5000 HTTP/1.1\r\n",
    "absolute address": "GET http://127.0.0.1/ HTTP/1.1\r\n",
    "preface of HTTP/2": "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    "without a version": "GET /\r\n",
    "line that ends without CR": "POST / HTTP/1.1\n",
    "path of 100 kB": f"POST /{'x' * 100_000} HTTP/1.1\r\n",
}


def told(line: socket.socket) -> bytes:
    """Everything received until the end of the connection."""
    received = b""
    while data := line.recv(4096):
        received += data
    return received


@pytest.mark.parametrize("name", REQUESTS)
def test_request_of_http_is_answered_with_what_the_port_is_and_nothing_of_it_is_executed(port: Port, name: str) -> None:
    with port.connect() as line:
        line.sendall(f"{REQUESTS[name]}{HEADERS}".encode() + BODY)
        answer = told(line)
    assert answer.startswith(b"HTTP/1.0 400 this port is " + port.what.encode())
    assert answer.endswith(b", not a web server\r\n") and answer.count(b"\n") == 1
    assert port.executed() == 0
    assert port.answers()


def test_request_that_comes_in_pieces_is_recognised(port: Port) -> None:
    with port.connect() as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for byte in b"POST / HTTP/1.1\r\n":
            with contextlib.suppress(ConnectionError):
                line.send(bytes([byte]))
        assert port.what.encode() in told(line)
    assert port.executed() == 0 and port.answers()


@pytest.mark.parametrize("start", ["FOO / HTTP/1.1\r\n", "\r\nPOST / HTTP/1.1\r\n", "\n\n\r\nGET / HTTP/1.0\r\n"])
def test_request_by_another_method_or_after_empty_lines_is_recognised_by_scpi(start: str) -> None:
    with red_pitaya() as port:
        with port.connect() as line:
            line.sendall(f"{start}{HEADERS}".encode() + BODY)
            assert port.what.encode() in told(line)
        assert port.executed() == 0 and port.answers()


@pytest.mark.parametrize("start", ["COUNT\n", "COUNT;COUNT?\n", "GETTING\n", "PUT\n", "POSTSCRIPT HTTP\n"])
def test_lines_that_are_no_requests_are_executed_as_before(start: str) -> None:
    with red_pitaya() as port, port.connect() as line:
        line.sendall(start.encode())
        assert port.replies(line)
        assert port.executed() == start.count("COUNT") - start.count("?")


@pytest.mark.parametrize("count", [1, 20, 40, 80, 200])
@pytest.mark.parametrize("start", [b"", b"P"], ids=["silent", "one byte"])
def test_silent_connections_do_not_keep_a_newcomer_out(port: Port, count: int, start: bytes) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            line = stack.enter_context(port.connect())
            line.sendall(start)
        assert port.answers()


@pytest.mark.parametrize("start", [b"\n", b"\r\n\r\n", b"COU", b"x" * 100_000], ids=["empty", "two", "half", "long"])
def test_connections_without_a_whole_command_do_not_keep_a_newcomer_out(start: bytes) -> None:
    with red_pitaya() as port, contextlib.ExitStack() as stack:
        for _ in range(40):
            stack.enter_context(port.connect()).sendall(start)
        assert port.answers()


@pytest.mark.parametrize("others", [0, 15, 40])
def test_client_that_speaks_late_is_answered(port: Port, others: int) -> None:
    with contextlib.ExitStack() as stack:
        first, *_ = [stack.enter_context(port.connect()) for _ in range(1 + others)]
        assert port.answers()
        assert port.replies(first)


def test_requests_of_http_take_no_places(port: Port) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(40):
            stack.enter_context(port.connect()).sendall(b"GET / HTTP/1.1\r\n" + HEADERS.encode())
        assert port.answers()


@pytest.mark.parametrize("count", [80, 200])
@pytest.mark.parametrize("start", ["", "GET", "GET / HTTP/1.1\r\nHost: x"])
def test_silent_connections_do_not_keep_the_owner_of_the_token_out(tmp_path: Path, count: int, start: str) -> None:
    with LiveBench(tmp_path) as bench, contextlib.ExitStack() as stack:
        host, _, number = bench.address.removeprefix("http://").partition("/")[0].rpartition(":")
        for _ in range(count):
            stack.enter_context(socket.create_connection((host, int(number)), LONG_S)).sendall(start.encode())
        with socket.create_connection((host, int(number)), LONG_S) as owner:
            path = bench.address.partition(f"{number}/")[2]
            owner.sendall(f"GET /{path} HTTP/1.1\r\nHost: {host}:{number}\r\n\r\n".encode())
            assert owner.recv(64).startswith(b"HTTP/1.1 200")
