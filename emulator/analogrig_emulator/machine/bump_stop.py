"""The program bump-stop is the front suspension with a second spring, which it meets towards the end of its travel.

    M x'' + B x' + K x + K_stop max(0, x - x_stop) = F

A diode limiter from the summer's input to -e_x does it: beyond its threshold it draws (e_x - e_stop) / R_on, as one
more input of the summer. Everything else is the suspension it is added to, with its scales.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from analogrig_emulator.circuit.circuit import DiodeLimiter
from analogrig_emulator.errors import CircuitError
from analogrig_emulator.machine.program import Scales

__all__ = ["BumpStop"]


@dataclass(frozen=True)
class BumpStop:
    """Where the stop is met, and how stiff it is; off_ohm: of its limiter before it is met.

    The defaults suit the front suspension: 60 kN/m from 0.1 m on, in the machine 24.55k from 5.01 V on.
    Raises CircuitError for values that are not positive and finite.
    """

    stop_m: float = 0.1
    stiffness_n_per_m: float = 60e3
    off_ohm: float = 1e9

    def __post_init__(self) -> None:
        for name in ("stop_m", "stiffness_n_per_m", "off_ohm"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise CircuitError(f"bump stop: {name} must be positive and finite, got {value!r}")

    def limiter(self, scales: Scales, feedback_ohm: float) -> DiodeLimiter:
        """The element between the nodes of a suspension on these scales, its summer fed back by feedback_ohm."""
        spring_at_feedback_n_per_m = scales.full("force") / scales.full("displacement")
        on_ohm = feedback_ohm * spring_at_feedback_n_per_m / self.stiffness_n_per_m
        return DiodeLimiter("STOP", "s1", "u3", self.stop_m * scales.volts("displacement"), on_ohm, self.off_ohm)
