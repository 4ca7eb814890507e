"""Node on a CAN bus that runs the bundled estimator: big-endian floats, one multiplexed page for each quantity."""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass, field

import can
import numpy as np

from analogrig.devices.library import Estimator
from analogrig.estimator_config import EstimatorConfig
from tests.harness.scripted_ecu import NodeOnBus

QUANTITIES = ("a1", "a2", "b0", "b1", "b2", "offset", "innovation", "statistic")

U, Y, COMMAND, PAGE, STATE, READY = range(0x300, 0x306)

DBC = f"""VERSION ""
BU_: Bench Node
BO_ {U} BENCH_U: 3 Bench
 SG_ U : 7|16@0+ (0.25,-100) [0|0] "N" Node
 SG_ Ctr : 23|8@0+ (1,0) [0|0] "" Node
BO_ {Y} BENCH_Y: 4 Bench
 SG_ Y : 7|16@0+ (1,0) [0|0] "" Node
 SG_ Ctr : 23|8@0+ (1,0) [0|0] "" Node
 SG_ Valid : 31|1@0+ (1,0) [0|0] "" Node
BO_ {COMMAND} BENCH_COMMAND: 1 Bench
 SG_ Restart : 7|1@0+ (1,0) [0|0] "" Node
BO_ {PAGE} NODE_PAGE: 6 Node
 SG_ Page M : 7|8@0+ (1,0) [0|0] "" Bench
 SG_ Ctr : 15|8@0+ (1,0) [0|0] "" Bench
{"".join(f' SG_ {name} m{i} : 23|32@0- (1,0) [0|0] "" Bench{chr(10)}' for i, name in enumerate(QUANTITIES))}
BO_ {STATE} NODE_STATE: 2 Node
 SG_ Alarm : 7|1@0+ (1,0) [0|0] "" Bench
 SG_ Ctr : 15|8@0+ (1,0) [0|0] "" Bench
BO_ {READY} NODE_READY: 1 Node
 SG_ Ready : 7|1@0+ (1,0) [0|0] "" Bench
{"".join(f"SIG_VALTYPE_ {PAGE} {name} : 1;{chr(10)}" for name in QUANTITIES)}"""

TOML = f"""kind = "can-dbc"
dbc = "node.dbc"
interface = "virtual"
channel = "CHANNEL"
timeout_s = 5.0

[send]
u = "BENCH_U.U"
y = "BENCH_Y.Y"
valid = "BENCH_Y.Valid"
counter = ["BENCH_U.Ctr", "BENCH_Y.Ctr"]
order = ["BENCH_U", "BENCH_Y"]
units = {{ u = [0.25, -100.0] }}

[receive]
theta = [{", ".join(f'"NODE_PAGE.{name}"' for name in QUANTITIES[:6])}]
innovation = "NODE_PAGE.innovation"
statistic = "NODE_PAGE.statistic"
alarm = "NODE_STATE.Alarm"
counter = ["NODE_PAGE.Ctr", "NODE_STATE.Ctr"]
complete = "NODE_STATE"

[start]
message = "BENCH_COMMAND"
signals = {{ Restart = 1 }}
answer = "NODE_READY"
answered = {{ Ready = 1 }}

[estimator]
"""

Pages = list[float]


@dataclass
class State:
    """Memory of the node in which the defects leave their traces."""

    index: int = 0
    u: deque[float] = field(default_factory=lambda: deque([0.0, 0.0], 2))
    """Inputs, the newest first."""
    pages: Pages = field(default_factory=lambda: [0.0] * len(QUANTITIES))
    alarms: deque[int] = field(default_factory=lambda: deque([0] * 10, 10))


class Node(NodeOnBus):
    """Node in a thread on a virtual bus. ``bug`` is the number of its planted defect."""

    def __init__(self, channel: str, bug: int = 0) -> None:
        super().__init__(channel)
        self._bug = bug
        config = {
            13: EstimatorConfig(warm_up_n=150),
            15: EstimatorConfig(p0=100.0),
        }.get(bug)
        self._estimator = Estimator(config)
        self._state = State()

    def _receive(self, frame: can.Message) -> None:
        self._take(frame.arbitration_id, bytes(frame.data))

    def _send(self, identifier: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def _take(self, identifier: int, data: bytes) -> None:
        state = self._state
        if identifier == COMMAND:
            if self._bug != 4:
                self._estimator.restart()
            self._state = State(pages=state.pages)
            self._send(READY, b"\x80")
        elif identifier == U:
            state.u.appendleft(int.from_bytes(data[:2]) - (400.0 if self._bug == 10 else 0.0))
        elif identifier == Y:
            self._sample(int.from_bytes(data[:2]), bool(data[3] & 0x80), data[2])

    def _sample(self, y: float, valid: bool, counter: int) -> None:  # noqa: FBT001
        state, bug, index = self._state, self._bug, self._state.index
        state.index += 1
        u = state.u[1] if bug == 2 and index else state.u[0]
        if bug == 11 and y >= 2048:
            y -= 4096
        if bug == 5:
            valid = True
        is_dropped = (bug == 7 and index == 0) or (bug == 9 and index and counter == 0)
        is_dropped = is_dropped or (bug == 8 and index > 0 and index % 65536 == 0)
        pages = state.pages
        alarm = 0
        if not is_dropped:
            out = self._estimator.run([u], [y], np.array([valid]))
            pages = [*map(float, out.theta[0]), float(out.innovation[0]), float(out.statistic[0])]
            alarm = len(out.alarms)
        self._answer(counter, pages, alarm)
        state.pages = pages

    def _answer(self, counter: int, pages: Pages, alarm: int) -> None:
        bug, state = self._bug, self._state
        shown = list(pages)
        if bug == 1:
            shown[4:6] = state.pages[4:6]
        if bug == 12:
            shown[2], shown[3] = shown[3], shown[2]
        for page, value in enumerate(shown):
            packed = struct.pack("<f" if bug == 3 and page == 6 else ">f", value)
            if bug == 14 and page == 5:
                packed = packed[:2] + b"\0\0"
            self._send(PAGE, bytes([page, counter]) + packed)
        state.alarms.appendleft(alarm)
        is_alarm = any(state.alarms) if bug == 6 else alarm
        self._send(STATE, bytes([0x80 if is_alarm else 0, counter]))
