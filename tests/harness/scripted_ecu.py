"""ECU with a DBC of its own: it reads and writes frames with cantools alone, and runs the core of the project."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Self

import can
import cantools
import numpy as np

from analogrig.devices.library import Estimator
from analogrig.estimator_config import EstimatorConfig

PARAMETERS = 6

DBC = f"""VERSION ""
NS_ :
BS_:
BU_: Bench Ecu
BO_ 256 HIL_Force: 4 Bench
 SG_ Force : 7|16@0- (0.25,-100) [0|0] "N" Ecu
 SG_ Ctr : 23|8@0+ (1,0) [0|0] "" Ecu
BO_ 257 HIL_Travel: 8 Bench
 SG_ Mode M : 0|4@1+ (1,0) [0|0] "" Ecu
 SG_ Valid : 4|1@1+ (1,0) [0|0] "" Ecu
 SG_ Ctr : 8|8@1+ (1,0) [0|0] "" Ecu
 SG_ Travel m3 : 16|32@1- (1,0) [0|0] "" Ecu
 SG_ Speed m2 : 16|16@1- (1,0) [0|0] "" Ecu
BO_ 258 HIL_Control: 1 Bench
 SG_ Restart : 0|1@1+ (1,0) [0|0] "" Ecu
BO_ 2147484160 EST_Par: 8 Ecu
 SG_ Index M : 0|4@1+ (1,0) [0|0] "" Bench
 SG_ Ctr : 8|8@1+ (1,0) [0|0] "" Bench
{"".join(f' SG_ V{i} m{i} : 16|32@1- (1,0) [0|0] "" Bench{chr(10)}' for i in range(PARAMETERS))}
BO_ 513 EST_Status: 8 Ecu
 SG_ Fault : 0|1@1+ (1,0) [0|0] "" Bench
 SG_ Armed : 1|1@1+ (1,0) [0|0] "" Bench
 SG_ Ctr : 8|8@1+ (1,0) [0|0] "" Bench
 SG_ Stat : 39|32@0- (1,0) [0|0] "" Bench
BO_ 514 EST_State: 1 Ecu
 SG_ Ready : 0|1@1+ (1,0) [0|0] "" Bench
SIG_VALTYPE_ 257 Travel : 1;
{"".join(f"SIG_VALTYPE_ 2147484160 V{i} : 1;{chr(10)}" for i in range(PARAMETERS))}
SIG_VALTYPE_ 513 Stat : 1;
"""

TOML = f"""kind = "can-dbc"
dbc = "ecu.dbc"
interface = "virtual"
channel = "CHANNEL"
timeout_s = 5.0

[send]
u = "HIL_Force.Force"
y = "HIL_Travel.Travel"
valid = "HIL_Travel.Valid"
counter = ["HIL_Force.Ctr", "HIL_Travel.Ctr"]
order = ["HIL_Force", "HIL_Travel"]

[send.units]
u = [0.25, -100.0]

[send.constant]
"HIL_Travel.Mode" = 3

[receive]
theta = [{", ".join(f'"EST_Par.V{i}"' for i in range(PARAMETERS))}]
statistic = "EST_Status.Stat"
alarm = "EST_Status.Fault"
counter = ["EST_Par.Ctr", "EST_Status.Ctr"]
complete = "EST_Status"

[start]
message = "HIL_Control"
signals = {{ Restart = 1 }}
answer = "EST_State"
answered = {{ Ready = 1 }}

[datasheet]
model = {{ na = 2, nb = 3, offset = true }}
"""


def write(folder: Path, channel: str) -> Path:
    """Device file and DBC in ``folder``."""
    (folder / "ecu.dbc").write_text(DBC, encoding="utf-8")
    file = folder / "ecu.toml"
    file.write_text(TOML.replace("CHANNEL", channel), encoding="utf-8")
    return file


Answer = list[can.Message]
"""Frames of the answer to one sample."""


class NodeOnBus:
    """Node in a thread on a bus of python-can. A context manager."""

    def __init__(self, channel: str, interface: str = "virtual") -> None:
        self.bus = can.Bus(interface=interface, channel=channel)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._thread.join()
        self.bus.shutdown()

    def _serve(self) -> None:
        while not self._ends.is_set():
            frame = self.bus.recv(0.05)
            if frame is not None:
                self._receive(frame)

    def _receive(self, frame: can.Message) -> None:
        raise NotImplementedError


class ScriptedEcu(NodeOnBus):
    """ECU in a thread on a bus of python-can.

    ``answering`` maps the index of a sample and the frames of its answer to the frames that are sent. ``hearing`` maps
    the number of a received frame and the frame to the frames that the ECU takes.
    """

    def __init__(
        self,
        channel: str,
        config: EstimatorConfig | None = None,
        *,
        interface: str = "virtual",
        answering: Callable[[int, Answer], Iterable[can.Message]] = lambda _, frames: frames,
        hearing: Callable[[int, can.Message], Iterable[can.Message]] = lambda _, frame: (frame,),
    ) -> None:
        super().__init__(channel, interface)
        self._database: Any = cantools.database.load_string(DBC, "dbc")
        self._estimator = Estimator(config)
        self._answering, self._hearing = answering, hearing
        self._index, self._received = 0, 0
        self.forces: list[float] = []
        """Forces received, in newtons."""

    def _receive(self, frame: can.Message) -> None:
        self._received += 1
        for heard in self._hearing(self._received - 1, frame):
            self._take(heard)

    def _take(self, frame: can.Message) -> None:
        values = self._database.decode_message(frame.arbitration_id, frame.data)
        if "Restart" in values:
            self._estimator.restart()
            self._index = self._received = 0
            self._send([self.frame("EST_State", Ready=1)])
        elif "Force" in values:
            self.forces.append(values["Force"])
        else:
            answer = self._step(values)
            self._send(self._answering(self._index, answer))
            self._index += 1

    def _step(self, travel: dict[str, Any]) -> Answer:
        """Answer to a sample; the core takes codes, of 0.25 N and -100 N at 0."""
        force = (self.forces[-1] + 100.0) / 0.25
        out = self._estimator.run([force], [travel["Travel"]], np.array([travel["Valid"]]))
        parts = [
            self.frame("EST_Par", Index=i, Ctr=travel["Ctr"], **{f"V{i}": float(out.theta[0, i])})
            for i in range(PARAMETERS)
        ]
        status = {"Fault": len(out.alarms), "Armed": 1, "Stat": float(out.statistic[0])}
        return [*parts, self.frame("EST_Status", Ctr=travel["Ctr"], **status)]

    def frame(self, name: str, **values: float) -> can.Message:
        """Frame of a message of the DBC."""
        message = self._database.get_message_by_name(name)
        return can.Message(
            arbitration_id=message.frame_id, is_extended_id=message.is_extended_frame, data=message.encode(values)
        )

    def _send(self, frames: Iterable[can.Message]) -> None:
        for frame in frames:
            self.bus.send(frame)
