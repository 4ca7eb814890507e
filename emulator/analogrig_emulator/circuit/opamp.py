"""Op-amps by their datasheet numbers.

The law of every op-amp here, with v the voltage behind the output resistance (SI units throughout):

    dv/dt = clip(2 pi GBW (d + Vos) - v / tau, -SR, +SR) - CLAMP_RATE (deadzone(v; swing) + deadzone(Rout i; Rout Imax))
    d = v+ - v- + (v+ + v-) / (2 CMRR),   tau = Avol / (2 pi GBW)

The clamp is a spring and not a wall: overdriven at full slew rate, v settles SR / CLAMP_RATE beyond the swing (13 mV
for a TL07x). The field is therefore continuous, and the mode of an amplifier follows from the state alone.
The current i from v through Rout is limited likewise. With a recovery time, v is let SR times it further beyond
the swing, and what is behind Rout is v within the swing: after an overload v has to slew back first.
Inputs draw no current; the supply is not modelled beyond the swing and its hum (machine/noise.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from analogrig_emulator.exceptions import CircuitError

CLAMP_RATE = 1e9
"""Rate in 1/s at which an output beyond its swing is pulled back."""


LEAST_GBW_HZ = 1.0


class OutputStage:
    """Output of an active element: a pole, limits of slew rate and swing, a resistance.

    Both models of active elements are dataclasses with these fields; gain_rate is the rate in 1/s at which the output
    moves for each volt that drives it.
    """

    slew_v_per_s: float
    swing_v: tuple[float, float]
    rout_ohm: float

    @property
    def gain_rate(self) -> float:
        """2 pi bandwidth, in 1/s."""
        raise NotImplementedError

    @property
    def has_state(self) -> bool:
        """True if the output has a pole, and so a state."""
        return math.isfinite(self.gain_rate)

    @property
    def limits_current(self) -> bool:
        """True if the output current is limited."""
        return False

    @property
    def bounds_v(self) -> tuple[float, float]:
        """Voltages to which the state is clamped."""
        return self.swing_v

    @property
    def slews(self) -> bool:
        """True if the slew rate is finite."""
        return math.isfinite(self.slew_v_per_s)

    @property
    def clamps(self) -> bool:
        """True if the output swing is finite on either side."""
        low, high = self.swing_v
        return math.isfinite(low) or math.isfinite(high)

    def require_limits(self, element: str, bandwidth: str) -> None:
        """Raise CircuitError naming the element and the field, unless the limits make sense together."""
        if not (math.isfinite(self.rout_ohm) and self.rout_ohm >= 0):
            raise CircuitError(f"{element}: rout_ohm must be finite and not negative, got {self.rout_ohm!r}")
        low, high = self.swing_v
        if not low < 0 < high:
            raise CircuitError(f"{element}: swing_v must lie on both sides of 0 V, got {self.swing_v!r}")
        if not self.has_state and (self.slews or self.clamps):
            raise CircuitError(f"{element}: slew_v_per_s and swing_v need a finite {bandwidth}")


@dataclass(frozen=True)
class OpAmpModel(OutputStage):
    """One type of op-amp. The defaults are ideal: v+ = v-, no state. Each field switches one non-ideality on.

    avol: open-loop gain at DC (V/V); gbw_hz: gain-bandwidth product; slew_v_per_s: slew rate; swing_v: (lowest,
    highest) output in V; rout_ohm: open-loop output resistance; vos_v: input offset voltage, added to v+ - v-; cmrr:
    common-mode rejection (V/V); current_limit_a: largest output current; recovery_s: time for which the output stays
    at its swing after an overload.

    Raises CircuitError naming the field. Slew and swing need a finite gbw_hz: they act on its state. So does
    current_limit_a, with a rout_ohm through which the current flows; recovery_s needs slew and swing.
    """

    avol: float = math.inf
    gbw_hz: float = math.inf
    slew_v_per_s: float = math.inf
    swing_v: tuple[float, float] = (-math.inf, math.inf)
    rout_ohm: float = 0.0
    vos_v: float = 0.0
    cmrr: float = math.inf
    current_limit_a: float = math.inf
    recovery_s: float = 0.0

    def __post_init__(self) -> None:
        for field in ("avol", "gbw_hz", "slew_v_per_s", "cmrr", "current_limit_a"):
            value = getattr(self, field)
            if not value > 0:
                raise CircuitError(f"op-amp: {field} must be positive, got {value!r}")
        if not math.isfinite(self.vos_v):
            raise CircuitError(f"op-amp: vos_v must be finite, got {self.vos_v!r}")
        self.require_limits("op-amp", "gbw_hz")
        if self.gbw_hz < LEAST_GBW_HZ:
            raise CircuitError(f"op-amp: gbw_hz {self.gbw_hz!r} is below {LEAST_GBW_HZ:g} Hz")
        if not 0 <= self.recovery_s < math.inf:
            raise CircuitError(f"op-amp: recovery_s must be finite and not negative, got {self.recovery_s!r}")
        if self.limits_current and not self.has_current:
            raise CircuitError("op-amp: current_limit_a needs a finite gbw_hz and a rout_ohm")
        if self.recovery_s and not self.saturates:
            raise CircuitError("op-amp: recovery_s needs a finite slew_v_per_s and a swing_v")

    @property
    def gain_rate(self) -> float:
        """2 pi GBW, in 1/s."""
        return 2.0 * math.pi * self.gbw_hz

    @property
    def leak_rate(self) -> float:
        """1 / tau = 2 pi GBW / Avol, in 1/s; 0 for an infinite gain."""
        return self.gain_rate / self.avol

    @property
    def has_current(self) -> bool:
        """True if the output current can be limited."""
        return self.has_state and self.rout_ohm > 0

    @property
    def limits_current(self) -> bool:
        """True if the output current is limited."""
        return math.isfinite(self.current_limit_a)

    @property
    def saturates(self) -> bool:
        """True if an overload ends after a time to be recovered from."""
        return self.slews and self.clamps

    @property
    def recovers(self) -> bool:
        """True if recovery from an overload takes time."""
        return self.recovery_s > 0

    @property
    def bounds_v(self) -> tuple[float, float]:
        """Voltages to which the state is clamped: the swing, and beyond it a slew for the time of recovery."""
        if not self.recovers:
            return self.swing_v
        (low, high), beyond_v = self.swing_v, self.slew_v_per_s * self.recovery_s
        return low - beyond_v, high + beyond_v


IDEAL = OpAmpModel()
"""Op-amp without any limit: v+ = v-."""

PRESETS: Mapping[str, OpAmpModel] = MappingProxyType(
    {
        "ideal": IDEAL,
        "tl07x": OpAmpModel(avol=2e5, gbw_hz=3e6, slew_v_per_s=13e6, swing_v=(-13.5, 13.5), rout_ohm=100.0),
        "741": OpAmpModel(avol=2e5, gbw_hz=1e6, slew_v_per_s=0.5e6, swing_v=(-13.5, 13.5), rout_ohm=75.0),
        "opa627": OpAmpModel(avol=1e6, gbw_hz=16e6, slew_v_per_s=55e6, swing_v=(-12.3, 12.3), rout_ohm=55.0),
    }
)
"""Typical values on +-15 V, from the datasheets of the TL071 family, of the uA741, and of the OPA627."""


def preset(name: str) -> OpAmpModel:
    """Preset of a name (any case). Raises CircuitError that lists the presets."""
    try:
        return PRESETS[name.lower()]
    except KeyError:
        raise CircuitError(f"unknown op-amp {name!r}; there are {', '.join(PRESETS)}") from None
