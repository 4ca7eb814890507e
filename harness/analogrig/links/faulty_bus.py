"""A CAN bus with faults of its frames, its other nodes, or the controller."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from analogrig.catalogue import LAYOUTS, Hello, pack, unpack
from analogrig.links.can_bus import CanBus
from analogrig.links.can_link import BUS_OFF, CONTROLLER, NOT_ACKNOWLEDGED, PASSIVE, RESTARTED, VIOLATION
from analogrig.links.faulty_wire import STRANGERS_HASH
from analogrig.links.line import CanLine
from analogrig.links.python_can import can
from analogrig.links.wire_faults import LONGEST_DELAY_S, Direction, FaultyLine, Lane, WireFaults

_FOREIGN = range(max(layout.id for layout in LAYOUTS.values()) + 1, 0x800)
"""Identifiers with lower priority than all of the catalogue."""
_FIRST = range(min(layout.id for layout in LAYOUTS.values()))
"""Identifiers with higher priority than all of the catalogue."""
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


class FaultyBus(FaultyLine[CanBus, can.Message]):
    """A bus that applies faults to its frames."""

    def __init__(self, open_bus: Callable[[], CanBus], faults: WireFaults) -> None:
        """Open the bus. A reset of the device opens it again."""
        super().__init__(open_bus, faults)
        self.is_fd, self.line, self.unread_n = self._line.is_fd, self._line.line, self._line.unread_n
        self._ready: deque[can.Message] = deque()
        """Received frames that were not read yet."""
        self._babbled: range = range(0)
        """Identifiers of the babbling node."""
        self._off_until_s: float | None = None
        self._is_at_other_rate = False

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

    def _write(self, sent: Sequence[can.Message]) -> None:
        for frame in sent:
            self._line.send(frame)

    def _read(self, timeout_s: float) -> list[can.Message]:
        frame = self._line.receive(timeout_s)
        return [] if frame is None else [frame]

    def _noise(self, direction: Direction, passed: list[can.Message]) -> list[can.Message]:
        """Frames of another node at full bus load, in order of priority."""
        rng = self._lanes[direction].rng
        foreign = [
            can.Message(
                arbitration_id=rng.choice(self._babbled), is_extended_id=False, data=rng.randbytes(rng.randint(0, 8))
            )
            for _ in range(_BABBLED_N)
        ]
        if direction == "from":
            self._advance(_BABBLED_N * _FRAME_S)
        return foreign if self._babbled == _FIRST else [*passed, *foreign]

    def _stranger(self, sent: can.Message) -> can.Message:
        message = unpack(bytes((sent.arbitration_id & 0xFF,)) + sent.data)
        if not isinstance(message, Hello):
            return sent
        return self._with_data(sent, pack(message._replace(catalogue_hash=STRANGERS_HASH))[1:])

    def _apply_lasting(self, lane: Lane[can.Message], sent: can.Message) -> can.Message | None:
        if self._is_at_other_rate:
            self._show(_error(VIOLATION | CONTROLLER, PASSIVE))
            return None
        return None if self._off_until_s is not None else super()._apply_lasting(lane, sent)

    def _show(self, frame: can.Message) -> None:
        """Deliver a frame to the harness."""
        self._lanes["from"].put(frame, self.clock())

    def _deliver(self) -> None:
        if self._off_until_s is not None and self.clock() >= self._off_until_s:  # the controller restarts
            self._off_until_s = None
            self._show(_error(RESTARTED))
        super()._deliver()

    def _soon_s(self) -> float:
        left_s = LONGEST_DELAY_S if self._off_until_s is None else max(0.0, self._off_until_s - self.clock())
        return min(super()._soon_s(), left_s)

    @staticmethod
    def _with_data(frame: can.Message, data: bytes) -> can.Message:
        out = copy.copy(frame)
        out.data = bytearray(data)
        return out

    # ---- faults of one frame

    def _destroy(self, lane: Lane[can.Message], sent: can.Message) -> None:
        """Destroy the frame by an error frame; its controller then repeats it."""
        self._show(_error(VIOLATION))
        lane.put(sent, self.clock())

    def _ask_remotely(self, lane: Lane[can.Message], sent: can.Message) -> None:
        lane.put(
            can.Message(arbitration_id=sent.arbitration_id, is_extended_id=False, is_remote_frame=True, dlc=8),
            self.clock(),
        )
        lane.put(sent, self.clock())

    def _collide(self, lane: Lane[can.Message], sent: can.Message) -> None:
        """Insert a similar frame of another node, which both ends receive."""
        data = bytearray(sent.data)
        data[lane.rng.randrange(1, len(data))] ^= 1 << lane.rng.randrange(8)
        other = self._with_data(sent, bytes(data))
        other.is_rx = True
        lane.put(other, self.clock())
        if lane is self._lanes["to"]:
            self._show(other)
        lane.put(sent, self.clock())

    def _send_as_fd(self, lane: Lane[can.Message], sent: can.Message) -> None:
        out = copy.copy(sent)
        out.is_fd = out.bitrate_switch = True
        lane.put(out, self.clock())

    def _switch_off(self, lane: Lane[can.Message], sent: can.Message) -> None:  # noqa: ARG002 - the frame is lost
        self._show(_error(NOT_ACKNOWLEDGED | CONTROLLER, PASSIVE))
        self._show(_error(BUS_OFF))
        self._off_until_s = self.clock() + lane.rng.random() * LONGEST_DELAY_S

    def _give_way(self, lane: Lane[can.Message], sent: can.Message) -> None:
        self._babbled = _FOREIGN
        self._start_babble(lane, sent)

    def _go_first(self, lane: Lane[can.Message], sent: can.Message) -> None:
        self._babbled = _FIRST
        self._start_babble(lane, sent)

    def _change_rate(self, lane: Lane[can.Message], sent: can.Message) -> None:  # noqa: ARG002 - the frame is lost
        self._is_at_other_rate = True

    TRANSIENT: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        **FaultyLine.TRANSIENT,
        "error": _destroy,
        "remote": _ask_remotely,
        "collide": _collide,
        "fd": _send_as_fd,
        "bus-off": _switch_off,
    }
    KINDS: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        **TRANSIENT,
        **FaultyLine.LASTING,
        "babble": _give_way,
        "jam": _go_first,
        "wrong-bitrate": _change_rate,
    }
