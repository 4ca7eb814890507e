"""Hostile clients of the served LUCIDAC; as a program, a table of the memory and time that each costs.

python -m tests.soak.hostile_lucidac SECONDS SEED [FRAMES]

With FRAMES only as many random frames are sent, however long they take.
"""

from __future__ import annotations

import contextlib
import functools
import random
import socket
import struct
import sys
import time
from typing import Any

from analogrig_emulator.lucidac.configuration import Configuration, LucidacLane
from analogrig_lucidac.linear_patch import module_of
from analogrig_lucidac.messages import MOST_FRAME_BYTES, FrameReader, frame, protocol
from analogrig_lucidac.served_machine import MAC
from tests.served.serving import ServedByProcess, serving
from tests.soak.hostile import Attack, Stop, connect_often, ignore_disconnection, survive_all

MOST_FRAMES_AT_ONCE = 200
SILENT_N = 100_000
"""More answers than the buffers of server and system accept for a client that never reads."""


def varint(value: int) -> bytes:
    head = bytearray()
    while value >= 0x80:
        head.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*head, value))


def command(kind: str, **fields: Any) -> bytes:
    """Frame with a command."""
    message = protocol().MessageV1(id="7")
    getattr(message, kind).MergeFrom(type(getattr(message, kind))(**fields))
    getattr(message, kind).SetInParent()
    return frame(message)


def query(served: ServedByProcess) -> str:
    """Address of the device, by a client of its own."""
    reader = FrameReader(1 << 20)
    with served.connect() as connection:
        connection.sendall(command("extract_command", specification=True))
        while (content := reader.next()) is None:
            if not (data := connection.recv(65536)):
                return ""
            reader.feed(data)
    items = protocol().Envelope.FromString(content).message_v1.extract_response.module.items
    return str(items[0].entity_specification.entity.id)


def kinds() -> list[str]:
    """Names of all messages."""
    return [field.name for field in protocol().MessageV1.DESCRIPTOR.oneofs_by_name["kind"].fields]


@functools.cache
def valid_contents() -> tuple[bytes, ...]:
    """Contents of valid frames, one for each command that the device executes."""
    pb = protocol()
    lanes = {0: LucidacLane(0, 1, 0.05), 8: LucidacLane(1, 0, -0.05, upscaled=True), 26: LucidacLane(None, 8)}
    patch = Configuration(lanes=lanes, external=frozenset({2}), adc=(0, 1, 12))
    fields: dict[str, dict[str, Any]] = {
        "extract_command": {"specification": True, "configuration": True},
        "reset_command": {"overload_reset": True, "circuit_reset": True},
        "config_command": {"module": module_of(patch, MAC), "reset_before": True},
        "calibration_command": {"config": {"gain": "Enabled", "offset": "Enabled"}},
        "start_run_command": {
            "run_config": pb.RunConfig(op_time=pb.Time(value=1, prefix=pb.MILLI)),
            "daq_config": pb.DaqConfig(sample_rate=100_000),
        },
        "stop_run_command": {},
        "manual_control_command": {"to": pb.ManualControlCommand.HALT},
        "udp_data_streaming_command": {"port": 1},
        "get_overload_status_command": {},
    }
    return tuple(next_content(command(kind, **values)) for kind, values in fields.items())


def next_content(data: bytes) -> bytes:
    """Content of one frame."""
    reader = FrameReader()
    reader.feed(data)
    return reader.next() or b""


def random_frame(draw: random.Random) -> bytes:
    """Frame of a valid command with some bytes changed, or of random content, and sometimes of a wrong length."""
    if draw.random() < 0.6:
        content = bytearray(draw.choice(valid_contents()))
        changes = draw.choice((0, 1, 1, 1, 2, 5))
    else:
        content = bytearray(draw.randbytes(draw.choice((0, 1, 10, 100, 2000))))
        changes = 0
        if draw.random() < 0.8:
            body = _field("MessageV1", draw.choice(kinds()), bytes(content))
            content = bytearray(_field("Envelope", "message_v1", b"\x0a\x01x" + body))
    for _ in range(changes):
        content[draw.randrange(len(content))] = draw.randrange(256)
    wrong = draw.choice((1, -1, 1 << 20, 1 << 62)) if draw.random() < 0.01 else 0
    return varint(max(0, len(content) + wrong)) + bytes(content)


def fuzz(served: ServedByProcess, draw: random.Random, stop: Stop, least: int = 0) -> int:
    """Send random frames, at least so many, and read most answers."""
    count = 0
    while True:
        with ignore_disconnection(), served.connect() as connection:
            connection.settimeout(0.01)
            for _ in range(draw.randrange(1, MOST_FRAMES_AT_ONCE)):
                connection.sendall(random_frame(draw))
                count += 1
                if draw.random() < 0.1:
                    with contextlib.suppress(TimeoutError):
                        connection.recv(1 << 20)
        if stop() and count >= least:
            return count


def claim_lengths(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Announce frames of up to 2^64 bytes, and send some of them."""
    count = 0
    while True:
        with ignore_disconnection(), served.connect() as connection:
            connection.sendall(varint(1 << draw.randrange(15, 64)))
            for _ in range(MOST_FRAME_BYTES // 65536 + 2):
                connection.sendall(bytes(65536))
        count += 1
        if stop() and count >= 50:
            return count


def nested(depth_bytes: int) -> bytes:
    """Frame of a configuration whose entities are nested to so many bytes."""
    content = b""
    while len(content) < depth_bytes:
        content = _field("Entity", "children", content)
    for message, field in (
        ("EntitySpecification", "entity"),
        ("Item", "entity_specification"),
        ("Module", "items"),
        ("ConfigCommand", "module"),
        ("MessageV1", "config_command"),
        ("Envelope", "message_v1"),
    ):
        content = _field(message, field, content)
    return varint(len(content)) + content


def _field(message: str, field: str, content: bytes) -> bytes:
    number = protocol().DESCRIPTOR.message_types_by_name[message].fields_by_name[field].number
    return varint(number << 3 | 2) + varint(len(content)) + content


def nest(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Send messages nested in messages, up to the longest frame."""
    frames = [nested(size) for size in (200, 2000, draw.randrange(2000, 20_000), MOST_FRAME_BYTES - 1000)]
    count = 0
    while True:
        with ignore_disconnection(), served.connect() as connection:
            connection.sendall(draw.choice(frames))
            connection.recv(1000)
        count += 1
        if stop() and count >= 50:
            return count


def leave_half_open(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Send half a frame, then close one way, reset the connection, or stay silent."""
    left: list[socket.socket] = []
    count = 0
    while True:
        with ignore_disconnection():
            connection = served.connect()
            left.append(connection)
            connection.sendall(draw.choice((b"", b"\x80", command("reset_command"), random_frame(draw)[:-1])))
            match draw.randrange(3):
                case 0:
                    connection.shutdown(socket.SHUT_WR)
                case 1:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    connection.close()
        count += 1
        for connection in left[:-200]:
            connection.close()
        del left[:-200]
        if stop() and count >= 100:
            for connection in left:
                connection.close()
            return count


def never_read(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Ask for the specification until the server reads no more."""
    asked = command("extract_command", specification=True) * draw.randrange(50, 100)
    count = 0
    while True:
        with served.connect() as connection, ignore_disconnection():
            connection.settimeout(0.2)
            for _ in range(SILENT_N // 50):
                connection.sendall(asked)
        count += 1
        if stop():
            return count


def run_and_read_slowly(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
    """Start a run of an hour, and read its samples a kilobyte at a time."""
    pb = protocol()
    run, daq = pb.RunConfig(op_time=pb.Time(value=3600)), pb.DaqConfig(sample_rate=1000)
    adc = pb.Item(entity=pb.EntityId(path=MAC), adc_config=pb.AdcConfig(channels=[pb.AdcChannel()] * 8))
    count = 0
    with served.connect() as connection, ignore_disconnection():
        connection.sendall(command("config_command", module=pb.Module(items=[adc]), reset_before=True))
        connection.sendall(command("start_run_command", run_config=run, daq_config=daq))
        while not stop() or count < 20:
            count += len(connection.recv(draw.randrange(1, 1024))) > 0
            time.sleep(0.001)
    return count


ATTACKS: tuple[Attack, ...] = (
    fuzz,
    claim_lengths,
    nest,
    leave_half_open,
    never_read,
    run_and_read_slowly,
    connect_often,
)


def main(seconds: float, seed: int, frames: int = 0) -> None:
    def fuzz_frames(served: ServedByProcess, draw: random.Random, stop: Stop) -> int:
        return fuzz(served, draw, stop, frames)

    with serving("--as", "lucidac") as served:
        query(served)
        survive_all(served, (fuzz_frames,) if frames else ATTACKS, seconds, seed, query)


if __name__ == "__main__":
    main(float(sys.argv[1]), *map(int, sys.argv[2:]))
