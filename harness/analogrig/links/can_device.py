"""The device in this very process, reached by CAN frames: directly, or in a thread on a bus of its own."""

from __future__ import annotations

import ctypes
import threading
from collections import deque
from collections.abc import Iterable
from pathlib import Path

from analogrig.errors import LinkClosed
from analogrig.links.can_bus import CanBus
from analogrig.links.line import CanLine
from analogrig.links.python_can import can
from analogrig.links.wire import LIBRARY, Identity, Progress, VirtualClock, load_library
from analogrig.protocol.catalogue import CATALOGUE_HASH, FirmwareId

MOST_BYTES = 64
"""In a frame of CAN FD."""

_EXTENDED, _REMOTE, _FD, _ERROR = 1, 2, 4, 8
"""As estimator_c/device/can_frame.h has them."""

_OUTPUT_N = 128
_POLL_S = 0.05
"""A device in a thread asks so often whether it shall end."""


class _Frame(ctypes.Structure):
    """As can_frame_t of estimator_c/device/can_frame.h."""

    _fields_ = (
        ("id", ctypes.c_uint32),
        ("flags", ctypes.c_uint8),
        ("length", ctypes.c_uint8),
        ("data", ctypes.c_uint8 * MOST_BYTES),
    )


def _to_c(frame: can.Message) -> _Frame:
    flags = (
        (_EXTENDED if frame.is_extended_id else 0)
        | (_REMOTE if frame.is_remote_frame else 0)
        | (_FD if frame.is_fd else 0)
        | (_ERROR if frame.is_error_frame else 0)
    )
    data = bytes(frame.data[:MOST_BYTES])
    out = _Frame(frame.arbitration_id, flags, len(data))
    ctypes.memmove(out.data, data, len(data))
    return out


def _from_c(frame: _Frame) -> can.Message:
    return can.Message(
        arbitration_id=frame.id,
        is_extended_id=False,
        is_fd=bool(frame.flags & _FD),
        data=bytes(frame.data)[: frame.length],
    )


class LibraryCanDevice:
    """The C of the device behind its CAN shell."""

    def __init__(
        self, *, is_fd: bool, input_blocks: int, catalogue_hash: int = CATALOGUE_HASH, library: Path = LIBRARY
    ) -> None:
        """It is not booted yet; ``is_fd``: its controller understands CAN FD. Another hash makes it a stranger.

        :raises LinkError: the device library was not built.
        """
        c = load_library(library, ("can_device_size", "can_device_init", "can_device_run"))
        c.can_device_run.restype = Progress
        c.can_device_size.restype = ctypes.c_size_t
        self._run, self._init = c.can_device_run, c.can_device_init
        self._is_fd, self._input_blocks, self._catalogue_hash = is_fd, input_blocks, catalogue_hash
        self._device = ctypes.create_string_buffer(c.can_device_size())
        self._output = (_Frame * _OUTPUT_N)()

    def boot(self, boot_nonce: int) -> None:
        """As if it had been switched off and on."""
        identity = Identity(self._catalogue_hash, boot_nonce, self._input_blocks, FirmwareId.LIBRARY)
        self._init(self._device, ctypes.byref(identity), ctypes.c_bool(self._is_fd))

    def answers(self, frames: Iterable[can.Message]) -> list[can.Message]:
        """What it says to these."""
        waiting = [_to_c(frame) for frame in frames]
        out: list[can.Message] = []
        while True:
            array = (_Frame * len(waiting))(*waiting)
            progress = self._run(
                self._device, array, ctypes.c_size_t(len(waiting)), self._output, ctypes.c_size_t(_OUTPUT_N)
            )
            out += [_from_c(self._output[i]) for i in range(progress.given)]
            waiting = waiting[progress.taken :]
            if not progress.given and not waiting:
                return out


class MemoryBus:
    """A bus with nobody but a device of this process, no operating system between, and no real time."""

    name = "memory"
    unread_n = None
    damaged = 0

    def __init__(
        self,
        boot_nonce: int,
        *,
        is_fd: bool = False,
        line: CanLine | None = None,
        catalogue_hash: int = CATALOGUE_HASH,
        clock: VirtualClock | None = None,
    ) -> None:
        """Boot a device.

        :raises LinkError: the device library was not built.
        """
        self.is_fd = is_fd
        self.line = line
        self.clock = VirtualClock() if clock is None else clock
        self._device = LibraryCanDevice(is_fd=is_fd, input_blocks=_ALWAYS_ROOM, catalogue_hash=catalogue_hash)
        self._answers: deque[can.Message] = deque()
        self._device.boot(boot_nonce)

    def send(self, frame: can.Message) -> None:
        self._answers += self._device.answers([frame])

    def receive(self, timeout_s: float) -> can.Message | None:
        """What the device has answered; if that is nothing, nothing will come, and the clock goes on."""
        if self._answers:
            return self._answers.popleft()
        self.clock.advance(timeout_s)
        return None

    def close(self) -> None:
        """Nothing is held."""


_ALWAYS_ROOM = 255
"""Blocks that may wait in the input of a device that works while it is told."""

BUS_INPUT_BLOCKS = 64
"""Messages that may wait for a device on a bus of its own: fewer than its system keeps for it."""


class InhabitedBus:
    """A bus with a device of this process on it, which has a connection of its own and a thread to serve it."""

    def __init__(self, bus: CanBus, devices_bus: CanBus, boot_nonce: int) -> None:
        """Take over both connections to the same bus; the device boots.

        :raises LinkError: the device library was not built.
        """
        self.name, self.clock, self.is_fd = bus.name, bus.clock, bus.is_fd
        self.line, self.unread_n = bus.line, bus.unread_n
        self._bus, self._devices_bus = bus, devices_bus
        self._device = LibraryCanDevice(is_fd=bus.is_fd, input_blocks=BUS_INPUT_BLOCKS)
        self._device.boot(boot_nonce)
        self._said: dict[tuple[int, int], bytes] = {}
        """What the device has said last in each kind of message with each sequence number."""
        self._ends = threading.Event()
        self._death: Exception | None = None
        self._thread = threading.Thread(target=self._serve, name=f"device on {bus.name}", daemon=True)
        self._thread.start()

    @property
    def damaged(self) -> int:
        return self._bus.damaged

    def send(self, frame: can.Message) -> None:
        self._bus.send(frame)

    def receive(self, timeout_s: float) -> can.Message | None:
        frame = self._bus.receive(timeout_s)
        if frame is None and self._death is not None:
            raise LinkClosed(f"the device in this process lost its bus: {self._death}") from self._death
        return frame

    def close(self) -> None:
        self._ends.set()
        self._thread.join()
        self._devices_bus.close()
        self._bus.close()

    def _serve(self) -> None:
        try:
            while not self._ends.is_set():
                frame = self._devices_bus.receive(_POLL_S)
                if frame is not None and not self._is_echo(frame):
                    for answer in self._device.answers([frame]):
                        self._said[answer.arbitration_id, answer.data[0]] = bytes(answer.data)
                        self._devices_bus.send(answer)
        except Exception as error:  # noqa: BLE001 - whatever ends the thread is told to who waits for it
            self._death = error

    def _is_echo(self, frame: can.Message) -> bool:
        """Whether the interface shows the device what it has said itself, as udp_multicast does."""
        if frame.is_extended_id or frame.is_remote_frame or frame.is_error_frame or not frame.data:
            return False
        return self._said.get((frame.arbitration_id, frame.data[0])) == bytes(frame.data)
