"""ECU of the example: recursive least squares with a cumulative sum, behind the messages of ecu.dbc.

It stands for a control unit on a desk: `python ecu.py` listens on the bus until it is interrupted.
"""

from __future__ import annotations

import sys
from typing import Any

import can
import cantools
import numpy as np

WARM_UP_N, HOLD_OFF_N, LIMIT = 150, 60, 10.0


class LeastSquares:
    """Least squares of y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k) + b1 u(k-1) + b2 u(k-2) + d, in N and m."""

    def __init__(self) -> None:
        self.theta, self.p = np.zeros(6), 1e6 * np.eye(6)
        self.past = np.zeros(4)
        self.noise, self.sum = 1e-4, 0.0
        self.unarmed_n = WARM_UP_N

    def step(self, force: float, travel: float) -> bool:
        """Take a sample; return True for an alarm."""
        y1, y2, u1, u2 = self.past
        self.past = np.array([travel, y1, force, u1])
        x = np.array([-y1, -y2, 1e-3 * force, 1e-3 * u1, 1e-3 * u2, 0.1])
        error = travel - x @ self.theta
        gain = self.p @ x / (0.99 + x @ self.p @ x)
        self.theta = self.theta + gain * error
        self.p = (self.p - np.outer(gain, x @ self.p)) / 0.99
        if self.unarmed_n:
            self.unarmed_n -= 1
            self.sum = 0.0
        else:
            self.sum = max(0.0, self.sum + abs(error) / self.noise - 2.5)
        self.noise += 0.02 * (min(abs(error), 3.0 * self.noise) - self.noise)
        if self.sum < LIMIT:
            return False
        self.unarmed_n, self.p = HOLD_OFF_N, self.p + 10.0 * np.eye(6)
        return True


def answers(database: Any, counter: int, estimator: LeastSquares, *, alarm: bool) -> list[can.Message]:
    """Frames of the answer to the sample with this counter."""
    a1, a2, b0, b1 = estimator.theta[:4] * (1.0, 1.0, 1e-3, 1e-3)
    limits = np.clip((a1, a2, 1e4 * b0, 1e4 * b1), -8.0, 8.0) * (1.0, 1.0, 1e-4, 1e-4)
    a1, a2, b0, b1 = limits.tolist()
    status = {"Fault": alarm, "Armed": estimator.unarmed_n == 0, "Statistic": min(655.0, estimator.sum)}
    parts = [
        ("Model", {"Page": 0, "A1": a1, "A2": a2}),
        ("Model", {"Page": 1, "B0": b0, "B1": b1}),
        ("Status", status),
    ]
    return [frame(database, name, Counter=counter, **values) for name, values in parts]


def frame(database: Any, name: str, **values: float) -> can.Message:
    """Frame of a message of the DBC."""
    message = database.get_message_by_name(name)
    return can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=message.encode(values))


def serve(bus: can.BusABC) -> None:
    """Answer every sample on the bus."""
    database: Any = cantools.database.load_file("ecu.dbc")
    names = {message.frame_id: message.name for message in database.messages}
    estimator, force = LeastSquares(), 0.0
    for received in bus:
        name = names.get(received.arbitration_id)
        if name not in {"Force", "Travel", "Command"}:
            continue
        values = database.decode_message(name, received.data)
        if name == "Command":
            estimator = LeastSquares()
            bus.send(frame(database, "Ready", Restarted=1))
        elif name == "Force":
            force = values["Value"]
        else:
            alarm = bool(values["Valid"]) and estimator.step(force, values["Value"])
            for answer in answers(database, values["Counter"], estimator, alarm=alarm):
                bus.send(answer)


if __name__ == "__main__":
    interface, channel = sys.argv[1:] or ("udp_multicast", "239.74.163.2")
    with can.Bus(interface=interface, channel=channel) as bus:
        sys.stdout.write("ECU is listening\n")
        sys.stdout.flush()
        serve(bus)
