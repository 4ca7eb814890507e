"""The harness's station on a CAN bus that may have other nodes.

Frames of other nodes are counted and skipped; another sender of the harness's own identifiers ends the run.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable, Collection, Mapping

import can

from analogrig.errors import LinkError
from analogrig.links.can_bus import CanBus
from analogrig.links.link import CanListener, Identifier
from analogrig.wording import number_of

__all__ = ["CanStation"]
"""Names for packages beside the core."""

_REMEMBERED_N = 256
"""Sent frames that are recognised when the interface returns them."""

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


class CanStation:
    """Station that sends the harness's frames, receives those of the device, and counts all others."""

    def __init__(self, bus: CanBus, own: Collection[Identifier], device: Collection[Identifier]) -> None:
        """Take over ``bus``, on which harness and device send the identifiers ``own`` and ``device``."""
        self.bus = bus
        self.name = bus.name
        self.clock = bus.clock
        self.line = bus.line
        self.line_s = 0.0
        self.counted: Counter[str] = Counter()
        """Counts of frames that were not used, by name."""
        self._own, self._device = frozenset(own), frozenset(device)
        self._known = self._own | self._device
        self._state = ""
        self._last_error = ""
        self._sent: dict[tuple[int, bytes], None] = {}
        """Identifiers and data of the latest frames sent, in order."""
        self._listeners: list[CanListener] = []
        self.on_other: Callable[[can.Message], object] = lambda _: None
        """Function that is called with each frame that is neither of the harness nor of the device."""

    @property
    def counters(self) -> Mapping[str, int]:
        dropped = self.counted["frames_dropped"] + self.bus.damaged
        none = {"frames_dropped": 0, "frames_foreign": 0, "error_frames": 0}
        return none | self.counted | {"frames_dropped": dropped}

    @property
    def trouble(self) -> str:
        """Known problems of the bus, which may explain a silent device; may be empty."""
        problems = [f"the bus is {self._state}"] if self._state else []
        if errors := self.counted["error_frames"]:
            problems.append(f"{number_of(errors, 'error frame')} (the last: {self._last_error})")
        if foreign := self.counted["frames_foreign"]:
            problems.append(number_of(foreign, "frame of others", "frames of others"))
        return ", ".join(problems)

    def listen(self, listener: CanListener) -> None:
        """Report all frames to the listener from now on."""
        self._listeners.append(listener)

    def send(self, frame: can.Message) -> None:
        """Send one frame; errors as of the bus."""
        key = frame.arbitration_id, bytes(frame.data)
        self._sent.pop(key, None)  # the latest frames are the last of the dictionary
        self._sent[key] = None
        if len(self._sent) > _REMEMBERED_N:
            del self._sent[next(iter(self._sent))]
        self.bus.send(frame)
        self._report(frame, is_rx=False)

    def receive(self, timeout_s: float) -> can.Message | None:
        """The next frame of the device, or None after the time-out.

        :raises LinkClosed: the bus is gone.
        :raises LinkError: another node has sent a frame of the harness.
        """
        deadline_s = self.clock() + timeout_s
        while True:
            frame = self.bus.receive(max(0.0, deadline_s - self.clock()))
            if frame is not None and self._is_of_device(frame):
                return frame
            if self.clock() >= deadline_s:
                return None

    def close(self) -> None:
        """Close the bus."""
        self.bus.close()

    def _is_of_device(self, frame: can.Message) -> bool:
        """True for a frame of the device; counts any other.

        :raises LinkError: another node has sent a frame of the harness.
        """
        is_echo = self._is_echo(frame)
        if not is_echo:
            self._report(frame, is_rx=True)
        identifier = frame.arbitration_id, frame.is_extended_id
        if frame.is_error_frame:
            self._note_error(frame)
        elif frame.is_remote_frame or identifier not in self._known:
            self.counted["frames_foreign"] += 1
            self.on_other(frame)
        elif identifier in self._device:
            return True
        elif not is_echo:
            raise LinkError(
                f"{self.name}: another node uses the harness's identifiers (frame {frame.arbitration_id:#05x}"
                f" with {frame.data.hex() or 'no data'}): another harness on the same bus?"
            )
        return False

    def _is_echo(self, frame: can.Message) -> bool:
        """True for a frame of this station that the interface returns. Not all interfaces mark them."""
        if not frame.is_rx:
            return True
        if frame.is_remote_frame or frame.is_error_frame:
            return False
        if (frame.arbitration_id, frame.is_extended_id) not in self._own:
            return False
        return (frame.arbitration_id, bytes(frame.data)) in self._sent

    def _note_error(self, frame: can.Message) -> None:
        self.counted["error_frames"] += 1
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
            self.counted["receive_overflows"] += 1

    def _enter_state(self, state: str) -> None:
        self._state = state
        self.counted[state.replace("-", "_")] += 1

    def _report(self, frame: can.Message, *, is_rx: bool) -> None:
        if self.line is not None:
            self.line_s += self.line.frame_s(frame)
        for listener in self._listeners:
            reported = copy.copy(frame)
            reported.timestamp, reported.is_rx = self.clock(), is_rx
            listener(reported)
