"""The device of this process in its shells for CAN: frames in, or slcan's text, and the same out."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from typing import NamedTuple

from analogrig.catalogue import (
    BLOCK_SAMPLES,
    CATALOGUE_HASH,
    Command,
    Configure,
    Control,
    Counter,
    FirmwareId,
    Identify,
    Key,
    Message,
    Sample,
    Status,
    pack,
    unpack,
)
from analogrig.devices.library import LIBRARY, MemoryWire
from analogrig.links.link import FrameDecoder, encode_frame
from tests.estimator_c.test_device import NONCE, blocks, codes

EXTENDED, REMOTE, FD, ERROR = 1, 2, 4, 8
"""CAN_FRAME_... of device/can_frame.h."""


class Frame(NamedTuple):
    """can_frame_t."""

    id: int
    data: bytes = bytes(8)
    flags: int = 0


class CFrame(ctypes.Structure):
    """can_frame_t itself."""

    _fields_ = (
        ("id", ctypes.c_uint32),
        ("flags", ctypes.c_uint8),
        ("length", ctypes.c_uint8),
        ("data", ctypes.c_uint8 * 64),
    )


class Progress(ctypes.Structure):
    """device_progress_t."""

    _fields_ = (("taken", ctypes.c_size_t), ("given", ctypes.c_size_t))


IDENTITY = (ctypes.c_uint32 * 3)(CATALOGUE_HASH, NONCE, FirmwareId.LIBRARY << 8 | 255)
"""device_identity_t: hash of the catalogue, nonce, firmware."""


def to_c(frame: Frame) -> CFrame:
    return CFrame(frame.id, frame.flags, len(frame.data), (ctypes.c_uint8 * 64)(*frame.data))


def from_c(frame: CFrame) -> Frame:
    return Frame(frame.id, bytes(frame.data)[: frame.length], frame.flags)


def frame_of(message: Message) -> Frame:
    """A message as the harness sends it."""
    packet = pack(message)
    return Frame(packet[0], packet[1:], FD if len(packet) > 9 else 0)


def numbered(messages: Iterable[Message]) -> list[Message]:
    """One after the other."""
    return [message._replace(seq=i % 256) for i, message in enumerate(messages)]


def conversation(*, in_blocks: bool, n: int = 140) -> list[Message]:
    """Identity, settings, samples of which some are missing, a change that raises an alarm, counters."""
    u, y = codes(n, change_at=100)
    missing = [k in (30, 31, 57) for k in range(n)]
    samples = [Sample(0, int(missing[k]), k, u[k], y[k]) for k in range(n)]
    return numbered(
        [
            Identify(0),
            Configure(0, Key.WARM_UP_N, 40.0),
            Configure(0, 99, 1.0),
            Control(0, Command.START, 0),
            *(blocks(u, y, missing, BLOCK_SAMPLES) if in_blocks else samples),
            Control(0, Command.STATUS, 0),
        ]
    )


def over_serial(*, in_blocks: bool) -> list[bytes]:
    """The packets that the same conversation brings back there."""
    wire = MemoryWire(NONCE)
    wire.write(b"".join(encode_frame(pack(message)) for message in conversation(in_blocks=in_blocks)))
    return FrameDecoder().feed(wire.read(0.0))


class CanDevice:
    """can_device.h."""

    def __init__(self, *, is_fd: bool = True) -> None:
        c = ctypes.CDLL(str(LIBRARY))
        c.can_device_run.restype = Progress
        c.can_device_size.restype = ctypes.c_size_t
        self._run = c.can_device_run
        self._state = ctypes.create_string_buffer(c.can_device_size())
        c.can_device_init(self._state, IDENTITY, ctypes.c_bool(is_fd))

    def run(self, frames: list[Frame], room: int) -> tuple[int, list[Frame]]:
        """Feed it; return the count that it took, and its answer. The bytes taken are gone afterwards."""
        given = (CFrame * room)()
        taken = (CFrame * len(frames))(*map(to_c, frames))
        progress = self._run(self._state, taken, ctypes.c_size_t(len(frames)), given, ctypes.c_size_t(room))
        ctypes.memset(taken, 0xFF, progress.taken * ctypes.sizeof(CFrame))
        return progress.taken, [from_c(frame) for frame in given[: progress.given]]

    def tell(self, *frames: Frame, room: int = 64) -> list[Frame]:
        """All its answers."""
        waiting, answers = list(frames), list[Frame]()
        while True:
            taken, given = self.run(waiting, room)
            answers += given
            waiting = waiting[taken:]
            if not given and not waiting:
                return answers

    def counters(self, seq: int) -> dict[Counter, int]:
        return counters(self.tell(frame_of(Control(seq, Command.STATUS, 0))))


def counters(answers: Iterable[Frame]) -> dict[Counter, int]:
    """Counters of a device, by its answers."""
    messages = [unpack(bytes([answer.id]) + answer.data) for answer in answers]
    return {Counter(message.counter): message.value for message in messages if isinstance(message, Status)}


class SlcanDevice:
    """slcan_device.h."""

    def __init__(self) -> None:
        c = ctypes.CDLL(str(LIBRARY))
        c.slcan_device_run.restype = Progress
        c.slcan_device_size.restype = ctypes.c_size_t
        self._run = c.slcan_device_run
        self._state = ctypes.create_string_buffer(c.slcan_device_size())
        c.slcan_device_init(self._state, IDENTITY)

    def run(self, text: bytes, room: int) -> tuple[int, bytes]:
        """Feed it; return the count of bytes taken, and its answer."""
        given = ctypes.create_string_buffer(b"\xaa" * (room + 64))
        progress = self._run(self._state, text, ctypes.c_size_t(len(text)), given, ctypes.c_size_t(room))
        assert progress.given <= room
        assert given.raw[room:].startswith(b"\xaa" * 64), "it wrote beyond the room it has"
        return progress.taken, given.raw[: progress.given]

    def tell(self, text: bytes, room: int = 4096) -> bytes:
        """All its answers."""
        answers = b""
        while True:
            taken, given = self.run(text, room)
            answers += given
            text = text[taken:]
            if not given and not text:
                return answers
