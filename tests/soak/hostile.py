"""Hostile clients beside one well-behaved client; as a program, a table of the memory and time that each costs.

    python -m tests.soak.hostile SECONDS SEED

A witness queries the server at the same time.
"""

# ruff: noqa: S311, T201 - input drawn from a seed is no secret; a program prints

from __future__ import annotations

import contextlib
import random
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from tests.harness.processes import LONG_S
from tests.served.serving import ServedByProcess, ended, serving
from tests.served.talk import SEQUENCE

IDENTITY = "analogrig,emulated STEMlab 125-14,0,0"
MOST_GROWTH_KB = 96 * 1024
"""Limit of the growth in resident memory after the first record: 4 MB for the answers of 16 clients; the rest for the
largest record, at a million samples a second."""
WITNESS_S = 10.0
"""Limit of the server's processor time per answer: commands of all clients before it, each computing a record."""
LONG_LINE_BYTES = 10_000_000
SILENT_BYTES = 30_000_000
"""More commands than the buffers of server and system accept from a client that never reads."""

WORDS = (
    *(line.partition(" ")[0] for line in SEQUENCE),
    *("ACQ:TRig:STAT?", "ACQ:TRig:FILL?", "ACQ:SOUR1:DATA?", "ACQ:SOUR2:DATA:STA:N?", "*IDN?", "*RST", "*CLS"),
    *("POT1:DIAL", "POT2:DIAL?", "POT3:DIAL", "POT:CATalog?", "POT:SCHedule", "POT:SCHedule:CLEar", "ACQ:STOP"),
    *("SYST:ERR?", "SYST:ERR:COUN?", "SOUR1:PHAS", "SOUR1:DCYC", "ACQ:SRATe?", "ACQ:BUF:SIZE?", "OUTPUT1:STATE?"),
)
VALUES = (
    *("0", "1", "-1", "0.5", "1e-3", "8192", "16384", "-8192", "125", "65536", "1e6", "1e400", "-1e400", "nan", "inf"),
    *(
        "9" * 400,
        "0." + "0" * 400 + "1",
        "1,2,3",
        "0,16384",
        "16383,1",
        "3,0.5,0.01",
        "1,0,1e4",
        ",",
        ",,,",
        "#15hello",
    ),
    *("ON", "OFF", "NOW", "AWG_PE", "CH1_PE", "CH2_NE", "DISABLED", "SQUARE", "PWM", "DC", "LV", "HV", "BIN", "ASCII"),
    *("RAW", "VOLTS", "'", '"', "(@1:16384)", "MAX", "1 V", "\x00", "\x7f", "%s%n", "../../etc/passwd", "{0}"),
)
RIGHT = (
    *(*SEQUENCE, *SEQUENCE, "ACQ:START", "ACQ:START", "ACQ:TRig NOW", "ACQ:TRig CH1_PE", "ACQ:TRig CH2_NE"),
    *("ACQ:DEC 125", "ACQ:DEC 65536", "ACQ:TRig:DLY 0", "ACQ:TRig:DLY -8192", "ACQ:TRig:DLY 1e6", "ACQ:AVG OFF"),
    *("SOUR1:FREQ:FIX 1e-3", "SOUR1:FREQ:FIX 1e6", "SOUR1:FUNC PWM", "SOUR1:DCYC 0.001", "SOUR1:PHAS -1", "*RST"),
    *("POT1:DIAL 0", "POT1:DIAL 1", "POT2:DIAL 0", "POT3:DIAL 1", "POT:SCH 2,1,0", "POT:SCH 3,0,1e-5", "ACQ:STOP"),
    *("ACQ:DATA:FORMAT BIN", "ACQ:DATA:Units RAW", "ACQ:SOUR1:DATA?", "ACQ:SOUR2:DATA:STA:N? 5,7", "ACQ:TRig:STAT?"),
)
"""Valid commands, up to the limits of their arguments."""


def line(draw: random.Random) -> bytes:
    """Random line, mostly of valid or almost valid commands."""
    if draw.random() < 0.1:
        return draw.randbytes(draw.choice((1, 10, 100, 5000))) + b"\n"
    units = []
    for _ in range(draw.choice((1, 1, 1, 2, 5, 50))):
        if draw.random() < 0.6:
            units.append(f":{draw.choice(RIGHT)}")
            continue
        value = draw.choice(VALUES) if draw.random() < 0.7 else f"{draw.uniform(-2.0, 2.0) * 10 ** draw.randint(-3, 5)}"
        units.append(f"{draw.choice(WORDS)} {value}" if draw.random() < 0.7 else draw.choice(WORDS))
    said = bytearray(";".join(units).encode())
    if draw.random() < 0.2:
        said[draw.randrange(len(said))] = draw.randrange(256)
    return bytes(said) + b"\n"


Stop = Callable[[], bool]
Attack = Callable[[ServedByProcess, random.Random, Stop], int]
"""Attack at least once, and until the stop. Return the number of attacks."""


def talk(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Send random lines, and read most answers."""
    said = 0
    while True:
        with ignore_disconnection(), served.connect() as connection:
            connection.settimeout(0.01)
            for _ in range(draw.randrange(1, 200)):
                connection.sendall(line(draw))
                said += 1
                if draw.random() < 0.9:
                    with contextlib.suppress(TimeoutError):
                        connection.recv(draw.choice((1, 1000, 1_000_000)))
        if stop():
            return said


def talk_at_once(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Run ``talk`` in several clients at once."""
    said: list[int] = []
    own = [random.Random(draw.random()) for _ in range(6)]
    clients = [
        threading.Thread(target=lambda each: said.append(talk(served, each, stop)), args=(each,)) for each in own
    ]
    for client in clients:
        client.start()
    for client in clients:
        client.join()
    return sum(said)


def leave_half_open(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Send half a line, then close one way, reset the connection, or stay silent."""
    left: list[socket.socket] = []
    count = 0
    while True:
        with ignore_disconnection():
            connection = served.connect()
            connection.sendall(draw.choice((b"", b"*IDN", b"OUTPUT1:STATE ON\nSOUR1:TRig:INT\nACQ:", line(draw)[:-1])))
            match draw.randrange(3):
                case 0:
                    connection.shutdown(socket.SHUT_WR)
                    left.append(connection)
                case 1:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    connection.close()
                case _:
                    left.append(connection)
        count += 1
        for connection in left[:-200]:
            connection.close()
        del left[:-200]
        if stop() and count >= 100:
            for connection in left:
                connection.close()
            return count


def read_slowly(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Read answers of 100 kB a kilobyte at a time."""
    count = 0
    with served.connect() as connection, ignore_disconnection():
        connection.sendall("".join(f"{command}\n" for command in SEQUENCE).encode())
        connection.sendall(b"ACQ:SOUR1:DATA?;" * 200 + b"\n")
        while not stop() or count < 100:
            count += len(connection.recv(draw.randrange(1, 1024))) > 0
            time.sleep(0.001)
    return count


def never_read(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Query large answers until the server reads no more."""
    count = 0
    while True:
        with served.connect() as connection, ignore_disconnection():
            connection.settimeout(0.2)
            connection.sendall("".join(f"{command}\n" for command in SEQUENCE).encode())
            for _ in range(SILENT_BYTES // 4000):
                connection.sendall(b"ACQ:SOUR1:DATA?;" * draw.randrange(1, 250) + b"\n")
        count += 1
        if stop():
            return count


def never_end_a_line(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Send 10 MB without an end of line, then a valid line."""
    count = 0
    while True:
        client = served.client()
        chunk = bytes(draw.randrange(11, 256) for _ in range(1000))
        for _ in range(LONG_LINE_BYTES // len(chunk)):
            client.connection.sendall(chunk)
        client.say("", "")
        if client.ask("SYST:ERR?") != '-363,"Input buffer overrun"' or client.ask("*IDN?") != IDENTITY:
            raise AssertionError("a line of 10 MB was not refused")
        client.close()
        count += 1
        if stop():
            return count


def connect_often(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Connect, and disconnect at once or a little later."""
    count = 0
    kept: list[socket.socket] = []
    while True:
        with ignore_disconnection():
            kept.append(served.connect())
        count += 1
        if len(kept) > draw.randrange(1, 100):
            kept.pop(draw.randrange(len(kept))).close()
        if stop() and count >= 300:
            for connection in kept:
                connection.close()
            return count


ATTACKS: tuple[Attack, ...] = (
    talk,
    talk_at_once,
    leave_half_open,
    read_slowly,
    never_read,
    never_end_a_line,
    connect_often,
)


@contextlib.contextmanager
def ignore_disconnection() -> Iterator[None]:
    """Ignore errors of a connection that the server has closed or refused."""
    with contextlib.suppress(OSError):
        yield


@dataclass(frozen=True)
class Survival:
    """Cost of an attack for the server."""

    times: int
    grown_kb: int
    slowest_s: float
    """Longest time until the witness had its answer."""


def warm(served: ServedByProcess) -> None:
    """Take and read a record at the highest rate, so that the server has all the memory that it needs."""
    client = served.client()
    client.say(*SEQUENCE, "ACQ:DEC 125", "ACQ:START", "ACQ:TRig NOW")
    if len(client.ask("ACQ:SOUR1:DATA?")) < 16384:
        raise AssertionError("no record")
    client.say("*RST")
    client.close()


Query = Callable[[ServedByProcess], str]
"""Query of the witness, which returns the identity of the instrument; empty if all places are taken."""


def survive(served: ServedByProcess, attack: Attack, seed: int, seconds: float, query: Query | None = None) -> Survival:
    """Attack a server that is warm.

    :param query: that of the witness; by default SCPI.

    :raises AssertionError: the witness gets no answer, or the memory grows too much.
    """
    before_kb = served.most_resident_kb
    until_s = time.monotonic() + seconds
    done = threading.Event()
    slowest_s = [0.0]
    failures: list[str] = []
    witness = threading.Thread(target=_watch, args=(served, query or _identity, done, slowest_s, failures))
    witness.start()
    try:
        times = attack(served, random.Random(seed), lambda: time.monotonic() >= until_s)
    finally:
        done.set()
        witness.join()
    survival = Survival(times, served.most_resident_kb - before_kb, slowest_s[0])
    if failures or survival.grown_kb > MOST_GROWTH_KB or served.process.poll() is not None:
        raise AssertionError(f"{attack.__name__}, seed {seed}: {failures or survival}")
    return survival


def _watch(
    served: ServedByProcess, query: Query, done: threading.Event, slowest_s: list[float], failures: list[str]
) -> None:
    """Query repeatedly, and once more at the end. All answers must be the same."""
    over, identity = False, ""
    while not over and not failures:
        over = done.wait(0.02)
        begun_s, worked_s = time.monotonic(), served.processor_s
        try:
            heard = _query(served, query)
            identity = identity or heard
        except OSError as error:
            heard = repr(error)
        waited_s, worked_s = time.monotonic() - begun_s, served.processor_s - worked_s
        slowest_s[0] = max(slowest_s[0], waited_s)
        if not heard or heard != identity or worked_s > WITNESS_S:
            failures.append(
                f"the witness received {heard!r} after {waited_s:.1f} s and {worked_s:.1f} s of the processor"
            )


def _identity(served: ServedByProcess) -> str:
    client = served.client()
    try:
        return client.ask("*IDN?")
    finally:
        client.close()


def _query(served: ServedByProcess, query: Query) -> str:
    """Query the identity; retry while all places are taken."""
    deadline_s = time.monotonic() + LONG_S
    while True:
        with contextlib.suppress(ConnectionError):
            heard = query(served)
            if heard or time.monotonic() > deadline_s:
                return heard
        if time.monotonic() > deadline_s:
            return ""
        time.sleep(0.05)


def survive_all(served: ServedByProcess, attacks: Sequence[Attack], seconds: float, seed: int, query: Query) -> None:
    """Print a table; raise AssertionError at the first failure."""
    print(f"{'client':18} {'times':>9} {'grown kB':>9} {'slowest answer s':>17}")
    for attack in attacks:
        survival = survive(served, attack, seed, seconds, query)
        print(f"{attack.__name__:18} {survival.times:9d} {survival.grown_kb:9d} {survival.slowest_s:17.2f}", flush=True)
    served.process.terminate()
    if (output := ended(served, [130])) != "analogrig: interrupted\n":
        raise AssertionError(output)
    print(f"{seconds:g} s each, seed {seed}: alive afterwards")


def main(seconds: float, seed: int) -> None:
    with serving() as served:
        warm(served)
        survive_all(served, ATTACKS, seconds, seed, _identity)


if __name__ == "__main__":
    main(float(sys.argv[1]), int(sys.argv[2]))
