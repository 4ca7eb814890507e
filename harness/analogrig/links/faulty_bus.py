"""A CAN bus with faults of its frames, its other nodes, or the controller."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Sequence

import can

from analogrig.catalogue import LAYOUTS, Hello, pack, unpack
from analogrig.links.can_bus import CanBus
from analogrig.links.can_station import BUS_OFF, CONTROLLER, NOT_ACKNOWLEDGED, PASSIVE, RESTARTED, VIOLATION
from analogrig.links.line import CanLine
from analogrig.links.wire_faults import LONGEST_DELAY_S, STRANGERS_HASH, Direction, FaultyLine, Lane, WireFaults

_IDENTIFIERS = {
    "babble": range(max(layout.id for layout in LAYOUTS.values()) + 1, 0x800),
    "jam": range(min(layout.id for layout in LAYOUTS.values())),
}
"""Identifiers of a babbling node: of lower priority than all of the catalogue, or of higher."""
_FRAME_S = CanLine(1_000_000).message_s(Hello)
"""Duration of a frame of another node [s]."""
_BABBLED_N = 3
"""Frames of another node for each frame of the exchange."""


def _error(classes: int, controller: int = 0) -> can.Message:
    """Error frame in SocketCAN's encoding."""
    return can.Message(
        arbitration_id=classes,
        is_extended_id=False,
        is_error_frame=True,
        data=bytes((0, controller, 0, 0, 0, 0, 0, 0)),
    )


def _copy_with(frame: can.Message, **fields: object) -> can.Message:
    """Copy of the frame with other values of these fields."""
    out = copy.copy(frame)
    for name, value in fields.items():
        setattr(out, name, value)
    return out


class FaultyBus(FaultyLine[CanBus, can.Message]):
    """A bus that applies faults to its frames."""

    TRANSIENT = (*FaultyLine.TRANSIENT, "error", "remote", "collide", "fd", "bus-off")
    KINDS = (*TRANSIENT, *FaultyLine.LASTING, "jam", "wrong-bitrate")

    def __init__(self, open_bus: Callable[[], CanBus], faults: WireFaults) -> None:
        """Open the bus. A reset of the device opens it again."""
        super().__init__(open_bus, faults)
        self.is_fd, self.line, self.unread_n = self._line.is_fd, self._line.line, self._line.unread_n
        self._ready: deque[can.Message] = deque()
        """Received frames that were not read yet."""
        self._off_until_s: float | None = None

    @property
    def damaged(self) -> int:
        return self._line.damaged

    def send(self, frame: can.Message) -> None:
        self._send([frame])

    def receive(self, timeout_s: float) -> can.Message | None:
        if not self._ready:
            self._ready += self._receive(timeout_s)
        return self._ready.popleft() if self._ready else None

    @property
    def waiting(self) -> int:
        return super().waiting + len(self._ready)

    @property
    def _is_intact(self) -> bool:
        return super()._is_intact and self._off_until_s is None

    def mend(self) -> None:
        super().mend()
        self._off_until_s = None
        self._ready.clear()

    def _write(self, sent: Sequence[can.Message]) -> None:
        for frame in sent:
            self._line.send(frame)

    def _read(self, timeout_s: float) -> list[can.Message]:
        frame = self._line.receive(timeout_s)
        return [] if frame is None else [frame]

    def _noise(self, direction: Direction, passed: list[can.Message]) -> list[can.Message]:
        """Frames of another node at full bus load, in order of priority."""
        rng, kind = self._lanes[direction].rng, self._lanes[direction].babble
        foreign = [
            can.Message(
                arbitration_id=rng.choice(_IDENTIFIERS[kind]),
                is_extended_id=False,
                data=rng.randbytes(rng.randint(0, 8)),
            )
            for _ in range(_BABBLED_N)
        ]
        if direction == "from":
            self._advance(_BABBLED_N * _FRAME_S)
        return foreign if kind == "jam" else [*passed, *foreign]

    def _stranger(self, sent: can.Message) -> can.Message:
        message = unpack(bytes((sent.arbitration_id & 0xFF,)) + sent.data)
        if not isinstance(message, Hello):
            return sent
        return _copy_with(sent, data=bytearray(pack(message._replace(catalogue_hash=STRANGERS_HASH))[1:]))

    def _show(self, *frames: can.Message) -> None:
        """Deliver frames to the harness."""
        self._lanes["from"].put(*frames)

    def _deliver(self) -> None:
        if self._off_until_s is not None and self.clock() >= self._off_until_s:  # the controller restarts
            self._off_until_s = None
            self._show(_error(RESTARTED))
        super()._deliver()

    def _soon_s(self) -> float:
        left_s = LONGEST_DELAY_S if self._off_until_s is None else max(0.0, self._off_until_s - self.clock())
        return min(super()._soon_s(), left_s)

    def _apply_lasting(self, lane: Lane[can.Message], sent: can.Message) -> can.Message | None:
        if "wrong-bitrate" in self._lasting:
            self._show(_error(VIOLATION | CONTROLLER, PASSIVE))
            return None
        return None if self._off_until_s is not None else super()._apply_lasting(lane, sent)

    def _apply(self, kind: str, lane: Lane[can.Message], sent: can.Message) -> Sequence[can.Message]:
        match kind:
            case "error":  # an error frame destroys the frame, and its controller repeats it
                self._show(_error(VIOLATION))
                return (sent,)
            case "remote":
                identifier = sent.arbitration_id
                return can.Message(arbitration_id=identifier, is_extended_id=False, is_remote_frame=True, dlc=8), sent
            case "collide":  # another node sends a similar frame, which both ends receive
                data = bytearray(sent.data)
                data[lane.rng.randrange(1, len(data))] ^= 1 << lane.rng.randrange(8)
                other = _copy_with(sent, data=data, is_rx=True)
                if lane is self._lanes["to"]:
                    self._show(other)
                return other, sent
            case "fd":
                return (_copy_with(sent, is_fd=True, bitrate_switch=True),)
            case "bus-off":
                self._show(_error(NOT_ACKNOWLEDGED | CONTROLLER, PASSIVE), _error(BUS_OFF))
                self._off_until_s = self.clock() + lane.rng.random() * LONGEST_DELAY_S
                return ()
        return super()._apply(kind, lane, sent)
