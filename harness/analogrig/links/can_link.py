"""Link over a CAN bus that may have other nodes.

A frame has the identifier of its message in estimator_c/catalogue/analogrig.dbc. Frames of other nodes are counted and
skipped; another sender of the harness's own identifiers ends the run.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Iterable, Mapping

from analogrig.catalogue import LAYOUTS, Message, pack, unpack_any
from analogrig.errors import LinkError
from analogrig.links.can_bus import CanBus
from analogrig.links.frame_bits import CLASSIC_BYTES
from analogrig.links.link import CanListener
from analogrig.links.python_can import can
from analogrig.wording import number_of

_HARNESS_IDS = {layout.id for layout in LAYOUTS.values() if layout.from_harness}
_DEVICE_IDS = {layout.id for layout in LAYOUTS.values() if not layout.from_harness}

# Error classes of include/uapi/linux/can/error.h. The identifier of an error frame is a set of them.
TRANSMIT_TIMEOUT, LOST_ARBITRATION, CONTROLLER, VIOLATION, TRANSCEIVER = 0x01, 0x02, 0x04, 0x08, 0x10
NOT_ACKNOWLEDGED, BUS_OFF, BUS_ERROR, RESTARTED = 0x20, 0x40, 0x80, 0x100
_WORDS = {
    TRANSMIT_TIMEOUT: "transmission timed out",
    LOST_ARBITRATION: "arbitration lost",
    CONTROLLER: "controller",
    VIOLATION: "protocol violated",
    TRANSCEIVER: "transceiver",
    NOT_ACKNOWLEDGED: "not acknowledged",
    BUS_OFF: "bus-off",
    BUS_ERROR: "bus error",
    RESTARTED: "restarted",
}
RECEIVE_OVERFLOW, PASSIVE, ACTIVE = 0x01, 0x30, 0x40
"""Bits of byte 1 of an error frame of the class CONTROLLER."""


class CanLink:
    """Link that carries messages as frames over a CAN bus, in order."""

    def __init__(self, bus: CanBus) -> None:
        """Take over ``bus``."""
        self.bus = bus
        self.name = bus.name
        self.clock = bus.clock
        self.line = bus.line
        self.line_s = 0.0
        self.carries_blocks = bus.is_fd
        self.unread_n = bus.unread_n
        self._counted: Counter[str] = Counter()
        self._state = ""
        self._last_error = ""
        self._sent: dict[int, bytes] = {}
        """Latest packet sent, by sequence number."""
        self._listeners: list[CanListener] = []

    @property
    def counters(self) -> Mapping[str, int]:
        dropped = self._counted["frames_dropped"] + self.bus.damaged
        none = {"frames_dropped": 0, "frames_foreign": 0, "error_frames": 0}
        return none | self._counted | {"frames_dropped": dropped}

    @property
    def trouble(self) -> str:
        problems = [f"the bus is {self._state}"] if self._state else []
        if errors := self._counted["error_frames"]:
            problems.append(f"{number_of(errors, 'error frame')} (the last: {self._last_error})")
        if foreign := self._counted["frames_foreign"]:
            problems.append(number_of(foreign, "frame of others", "frames of others"))
        return ", ".join(problems)

    def listen(self, listener: CanListener) -> None:
        self._listeners.append(listener)

    def send(self, messages: Iterable[Message]) -> None:
        for message in messages:
            frame = self._frame(message)
            self._sent[message.seq] = bytes((frame.arbitration_id,)) + frame.data
            self.bus.send(frame)
            self._report(frame, is_rx=False)

    def receive(self, timeout_s: float) -> Message | None:
        deadline_s = self.clock() + timeout_s
        while True:
            frame = self.bus.receive(max(0.0, deadline_s - self.clock()))
            if frame is not None:
                message = self._message(frame)
                if message is not None:
                    return message
            if self.clock() >= deadline_s:
                return None

    def close(self) -> None:
        self.bus.close()

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

    def _message(self, frame: can.Message) -> Message | None:
        """Message of the device; None for any other frame.

        :raises LinkError: another node has sent a frame of the harness.
        """
        is_echo = self._is_echo(frame)
        if not is_echo:
            self._report(frame, is_rx=True)
        if frame.is_error_frame:
            self._note_error(frame)
        elif frame.is_extended_id or frame.is_remote_frame or frame.arbitration_id not in _HARNESS_IDS | _DEVICE_IDS:
            self._counted["frames_foreign"] += 1
        elif frame.arbitration_id in _DEVICE_IDS:
            packet = bytes((frame.arbitration_id,)) + frame.data
            message = unpack_any(packet) if self.carries_blocks or not frame.is_fd else None
            self._counted["frames_dropped"] += message is None
            return message
        elif not is_echo:
            raise LinkError(
                f"{self.name}: another node uses the harness's identifiers (frame {frame.arbitration_id:#05x}"
                f" with {frame.data.hex() or 'no data'}): another harness on the same bus?"
            )
        return None

    def _is_echo(self, frame: can.Message) -> bool:
        """True for a frame of this link that the interface returns. Not all interfaces mark them."""
        if not frame.is_rx:
            return True
        if frame.is_extended_id or frame.is_remote_frame or frame.is_error_frame or not frame.data:
            return False
        if frame.arbitration_id not in _HARNESS_IDS:
            return False
        return self._sent.get(frame.data[0]) == bytes((frame.arbitration_id,)) + frame.data

    def _note_error(self, frame: can.Message) -> None:
        self._counted["error_frames"] += 1
        classes = frame.arbitration_id
        self._last_error = ", ".join(word for bit, word in _WORDS.items() if classes & bit) or f"{classes:#x}"
        controller = frame.data[1] if classes & CONTROLLER and len(frame.data) > 1 else 0
        if classes & BUS_OFF:
            self._enter_state("bus-off")
        elif classes & RESTARTED or controller & ACTIVE:
            self._state = ""
        elif controller & PASSIVE:
            self._enter_state("error-passive")
        if controller & RECEIVE_OVERFLOW:
            self._counted["receive_overflows"] += 1

    def _enter_state(self, state: str) -> None:
        self._state = state
        self._counted[state.replace("-", "_")] += 1

    def _report(self, frame: can.Message, *, is_rx: bool) -> None:
        if self.line is not None:
            self.line_s += self.line.frame_s(frame)
        for listener in self._listeners:
            reported = copy.copy(frame)
            reported.timestamp, reported.is_rx = self.clock(), is_rx
            listener(reported)
