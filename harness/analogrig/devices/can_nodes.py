"""CAN buses with a device on them that the harness starts: in memory, in a thread, or in a child process."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import can

from analogrig.devices.child import Child
from analogrig.devices.library import LIBRARY, MemoryBus
from analogrig.errors import LinkClosed
from analogrig.links.can_bus import PythonCanBus

BUS_INPUT_BLOCKS = 64
"""Input blocks of a device with a connection of its own. The system buffers more frames than these for it."""

_POLL_S = 0.05
"""Time between two checks of a device's thread for its end."""


class InhabitedBus(PythonCanBus):
    """A bus with a device in this process, which a thread serves over a connection of its own."""

    def __init__(self, config: Mapping[str, Any], library: Path = LIBRARY) -> None:
        """Open two connections to the same bus, and boot the device.

        :raises ConfigurationError, LinkError: as for ``PythonCanBus``, or the project's library was not built.
        """
        super().__init__(config)
        try:
            self._device = MemoryBus(
                secrets.randbits(32), is_fd=self.is_fd, input_blocks=BUS_INPUT_BLOCKS, library=library
            )
            self._devices_bus = PythonCanBus(config)
        except BaseException:
            super().close()
            raise
        self._sent: dict[tuple[int, int], bytes] = {}
        """Latest data from the device, by identifier and sequence number."""
        self._ends = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._serve, name=f"device on {self.name}", daemon=True)
        self._thread.start()

    def receive(self, timeout_s: float) -> can.Message | None:
        frame = super().receive(timeout_s)
        if frame is None and self._error is not None:
            raise LinkClosed(f"the device in this process lost its bus: {self._error}") from self._error
        return frame

    def close(self) -> None:
        self._ends.set()
        self._thread.join()
        self._devices_bus.close()
        super().close()

    def _serve(self) -> None:
        try:
            while not self._ends.is_set():
                frame = self._devices_bus.receive(_POLL_S)
                if frame is not None and not self._is_echo(frame):
                    self._device.send(frame)
                    while (answer := self._device.receive(0.0)) is not None:
                        self._sent[answer.arbitration_id, answer.data[0]] = bytes(answer.data)
                        self._devices_bus.send(answer)
        except Exception as error:  # noqa: BLE001 - ``receive`` reports any end of the thread
            self._error = error

    def _is_echo(self, frame: can.Message) -> bool:
        """True for the device's own frame: interfaces such as udp_multicast return them to the sender."""
        if frame.is_extended_id or frame.is_remote_frame or frame.is_error_frame or not frame.data:
            return False
        return self._sent.get((frame.arbitration_id, frame.data[0])) == bytes(frame.data)


class ChildBus(PythonCanBus):
    """A bus to a child process, which ends when the bus is closed."""

    def __init__(self, config: Mapping[str, Any], start: Callable[[PythonCanBus], Child]) -> None:
        """Open the bus, and take over the process that ``start`` returns for it; errors as of both."""
        super().__init__(config)
        try:
            self.child = start(self)
        except BaseException:
            super().close()
            raise

    def send(self, frame: can.Message) -> None:
        with self.child.reports_exit():
            super().send(frame)

    def receive(self, timeout_s: float) -> can.Message | None:
        with self.child.reports_exit():
            frame = super().receive(timeout_s)
        if frame is None and self.child.has_ended:
            raise LinkClosed(self.child.exit_report())
        return frame

    def close(self) -> None:
        super().close()
        self.child.end()
