"""The device in this very process, reached by CAN frames: directly, or in a thread on a bus of its own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable

import can

from harness.can_bus import CanBus
from harness.catalogue import CATALOGUE_HASH
from harness.errors import LinkClosed, LinkError
from harness.frame import FrameDecoder, encode
from harness.line import CanLine
from harness.wire import MemoryWire, VirtualClock

MOST_BYTES = 64
"""In a frame of CAN FD."""

CLASSIC_BYTES = 8

_POLL_S = 0.05
"""A device in a thread asks so often whether it shall end."""


class LibraryCanDevice:
    """The C of the device; its CAN shell is made here of its serial one."""

    def __init__(self, *, is_fd: bool, input_blocks: int, catalogue_hash: int = CATALOGUE_HASH) -> None:
        """It is not booted yet; ``is_fd``: its controller understands CAN FD. Another hash makes it a stranger.

        :raises LinkError: the device library was not built.
        """
        self._wire = MemoryWire(0, catalogue_hash=catalogue_hash, input_blocks=input_blocks)
        self._decoder = FrameDecoder(catalogue_hash)
        self._catalogue_hash, self._most_bytes = catalogue_hash, MOST_BYTES if is_fd else CLASSIC_BYTES

    def boot(self, boot_nonce: int) -> None:
        """As if it had been switched off and on."""
        self._wire.boot(boot_nonce)

    def answers(self, frames: Iterable[can.Message]) -> list[can.Message]:
        """What it says to these."""
        for frame in frames:
            packet = bytes((frame.arbitration_id & 0x7F,)) + frame.data
            is_plain = not (frame.is_remote_frame or frame.is_error_frame or frame.is_extended_id)
            fits = frame.is_fd == (len(frame.data) > CLASSIC_BYTES) and len(frame.data) <= self._most_bytes
            if is_plain and fits and frame.arbitration_id < 0x80:
                self._wire.write(encode(packet, self._catalogue_hash))
        packets = self._decoder.feed(self._wire.read(0.0))
        return [can.Message(arbitration_id=each[0], is_extended_id=False, data=each[1:]) for each in packets]


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
        self._ends = threading.Event()
        self._death: LinkError | None = None
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
                if frame is not None:
                    for answer in self._device.answers([frame]):
                        self._devices_bus.send(answer)
        except LinkError as error:
            self._death = error
