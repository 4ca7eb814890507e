"""Link over a CAN bus that may have other nodes.

A frame has the identifier of its message in estimator_c/catalogue/analogrig.dbc.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import can

from analogrig.catalogue import LAYOUTS, Message, pack, unpack_any
from analogrig.links.can_bus import CanBus
from analogrig.links.can_station import CanStation
from analogrig.links.frame_bits import CLASSIC_BYTES
from analogrig.links.link import CanListener
from analogrig.links.wire_faults import FaultyLine

_HARNESS_IDS = {(layout.id, False) for layout in LAYOUTS.values() if layout.from_harness}
_DEVICE_IDS = {(layout.id, False) for layout in LAYOUTS.values() if not layout.from_harness}


class CanLink:
    """Link that carries messages as frames over a CAN bus, in order."""

    def __init__(self, bus: CanBus) -> None:
        """Take over ``bus``."""
        self.bus = bus
        self.name = bus.name
        self.clock = bus.clock
        self.line = bus.line
        self.carries_blocks = bus.is_fd
        self.unread_n = bus.unread_n
        self.unread: deque[Message] = deque()
        self._station = CanStation(bus, _HARNESS_IDS, _DEVICE_IDS)

    @property
    def counters(self) -> Mapping[str, int]:
        return self._station.counters

    @property
    def trouble(self) -> str:
        return self._station.trouble

    @property
    def line_s(self) -> float:
        return self._station.line_s

    @property
    def faulty(self) -> FaultyLine[Any, Any] | None:
        return self.bus if isinstance(self.bus, FaultyLine) else None

    def listen(self, listener: CanListener) -> None:
        self._station.listen(listener)

    def send(self, messages: Iterable[Message]) -> None:
        for message in messages:
            self._station.send(self._frame(message))

    def receive(self, timeout_s: float) -> Message | None:
        deadline_s = self.clock() + timeout_s
        while (frame := self._station.receive(max(0.0, deadline_s - self.clock()))) is not None:
            is_of_bus = self.carries_blocks or not frame.is_fd  # a bus of classic CAN carries no frame of CAN FD
            message = unpack_any(bytes((frame.arbitration_id,)) + frame.data) if is_of_bus else None
            if message is not None:
                return message
            self._station.counted["frames_dropped"] += 1
        return None

    def close(self) -> None:
        self._station.close()

    def _frame(self, message: Message) -> can.Message:
        """Frame of a message: classic, unless it is too long for that."""
        packet = pack(message)
        is_fd = len(packet) > 1 + CLASSIC_BYTES
        return can.Message(
            arbitration_id=packet[0],
            is_extended_id=False,
            data=packet[1:],
            is_fd=is_fd,
            bitrate_switch=is_fd and self.line is not None and self.line.data_bitrate is not None,
            is_rx=False,
        )
