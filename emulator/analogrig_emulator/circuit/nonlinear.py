"""Non-linear computing elements: multiplier and diode function generator.

Their inputs draw no current and their outputs are voltages against ground. With f the product below and z the voltage
behind the output resistance, the law of a multiplier is (SI units throughout):

    f = (1 + gain error) X(v(x) + x offset) Y(v(y) + y offset) / scale + z offset
    X(p) = p + x nonlinearity N(p),   N(p) = 3 sqrt(3) / 2 p (1 - (p / full)^2), and Y likewise
    dz/dt = clip(2 pi bandwidth (f - z), -SR, +SR) - CLAMP_RATE deadzone(z; swing)

N is 0 at 0 and at both ends of the scale, and within +-full between them. Without a bandwidth z is f.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import ClassVar

from analogrig_emulator.circuit.elements import GROUND, CircuitPart
from analogrig_emulator.circuit.opamp import OutputStage
from analogrig_emulator.engine.system import Kink, Law, Product
from analogrig_emulator.exceptions import CircuitError

_CUBIC = 1.5 * math.sqrt(3.0)
"""Factor that makes the largest p (1 - p^2) on 0..1 one."""


@dataclass(frozen=True)
class MultiplierModel(OutputStage):
    """One type or specimen of a multiplier. The defaults are ideal; each field switches one non-ideality on.

    gain_error: relative error of the scale; x_offset_v, y_offset_v: added to the inputs; z_offset_v: added to the
    product; x_nonlinearity, y_nonlinearity: largest deviation from a straight line, as a fraction of full_v with the
    other input at full_v; bandwidth_hz: of the output; slew_v_per_s, swing_v: limits of the output; rout_ohm: its
    resistance; noise_v_per_rthz: white noise of the product, within the bandwidth (machine/noise.py).

    Raises CircuitError naming the field. Slew and swing need a finite bandwidth_hz: they act on its state.
    """

    gain_error: float = 0.0
    x_offset_v: float = 0.0
    y_offset_v: float = 0.0
    z_offset_v: float = 0.0
    x_nonlinearity: float = 0.0
    y_nonlinearity: float = 0.0
    full_v: float = 10.0
    bandwidth_hz: float = math.inf
    slew_v_per_s: float = math.inf
    swing_v: tuple[float, float] = (-math.inf, math.inf)
    rout_ohm: float = 0.0
    noise_v_per_rthz: float = 0.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name in ("bandwidth_hz", "slew_v_per_s") and not value > 0:
                raise CircuitError(f"multiplier: {each.name} must be positive, got {value!r}")
            if each.name in _FINITE and not math.isfinite(value):
                raise CircuitError(f"multiplier: {each.name} must be finite, got {value!r}")
        if not 0 <= self.noise_v_per_rthz < math.inf:
            raise CircuitError(f"multiplier: noise_v_per_rthz must not be negative, got {self.noise_v_per_rthz!r}")
        if not self.full_v > 0:
            raise CircuitError(f"multiplier: full_v must be positive, got {self.full_v!r}")
        self.require_limits("multiplier", "bandwidth_hz")

    @property
    def gain_rate(self) -> float:
        """2 pi bandwidth, in 1/s."""
        return 2.0 * math.pi * self.bandwidth_hz

    @property
    def leak_rate(self) -> float:
        """Rate in 1/s at which the output follows the product."""
        return self.gain_rate

    def product(self, scale_v: float, element: str = "") -> Product:
        """The product of the inputs, offsets added, without the offset of the output."""
        gain = (1.0 + self.gain_error) / scale_v
        x, y = self._factor(self.x_nonlinearity), self._factor(self.y_nonlinearity)
        return Product(tuple(gain * term for term in x), y, element)

    def _factor(self, nonlinearity: float) -> tuple[float, ...]:
        if nonlinearity == 0:
            return 0.0, 1.0
        bend = _CUBIC * nonlinearity
        return 0.0, 1.0 + bend, 0.0, -bend / self.full_v**2


_FINITE = frozenset(
    ("gain_error", "x_offset_v", "y_offset_v", "z_offset_v", "x_nonlinearity", "y_nonlinearity", "full_v")
)

MULTIPLIERS: Mapping[str, MultiplierModel] = MappingProxyType(
    {
        "ideal": MultiplierModel(),
        "ad633": MultiplierModel(bandwidth_hz=1e6, slew_v_per_s=20e6, swing_v=(-11.0, 11.0), noise_v_per_rthz=0.8e-6),
    }
)
"""Multipliers by name, with the typical bandwidth, limits and noise of the data sheet; errors belong to specimens."""


@dataclass(frozen=True)
class Multiplier(CircuitPart):
    """Four-quadrant multiplier: v(out) = v(x) v(y) / scale_v, but for the errors of its model.

    scale_v: 10 V in a usual machine. A negative scale is a differential x input with its two ends exchanged. The same
    node at both inputs makes a squarer. In the feedback of an op-amp it divides.

    law: that of a multiplier; or of an ideal divider, v(out) = scale_v v(x) / v(y), or an ideal root,
    v(out) = sign sqrt(max(0, scale_v v(x))), whose input y does nothing and may be its x.
    """

    finite: ClassVar[tuple[str, ...]] = ("scale_v",)

    x: str
    y: str
    out: str
    scale_v: float = 10.0
    model: MultiplierModel = MULTIPLIERS["ideal"]
    law: Law = Law.PRODUCT
    sign: int = 1

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.x, self.y, self.out

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.out, GROUND),)

    @property
    def rigid_bonds(self) -> tuple[tuple[str, str], ...]:
        return () if self.model.has_state and self.model.rout_ohm > 0 else self.bonds

    @property
    def output(self) -> str | None:
        return self.out

    @property
    def fault(self) -> str | None:
        if self.law is not Law.PRODUCT and self.model != MULTIPLIERS["ideal"]:
            return "an element that divides or takes roots by itself is ideal"
        return "scale_v must not be 0" if self.scale_v == 0 else None

    @property
    def product(self) -> Product:
        """Product of the inputs, or what the law makes of them."""
        if self.law is Law.QUOTIENT:
            return Product((0.0, self.scale_v), (0.0, 1.0), self.name, self.law)
        if self.law is Law.ROOT:
            return Product((0.0, self.scale_v), (float(self.sign),), self.name, self.law)
        return self.model.product(self.scale_v, self.name)


@dataclass(frozen=True)
class Function(CircuitPart):
    """Diode function generator: v(out) is a function of v(x) in straight pieces.

    breakpoints: at least two pairs (v(x), v(out)) in V, with v(x) ascending. The first and the last piece go on beyond
    the ends.
    """

    x: str
    out: str
    breakpoints: tuple[tuple[float, float], ...]

    @classmethod
    def comparator(cls, name: str, x: str, out: str, levels_v: tuple[float, float], width_v: float = 1e-3) -> Function:
        """Comparator: levels_v below and above 0 V, on a straight line within width_v about it.

        A multiplier with this output at one input, levels_v = (0, 10), is an electronic switch.
        """
        low, high = levels_v
        half = 0.5 * width_v
        return cls(name, x, out, ((-2 * half, low), (-half, low), (half, high), (2 * half, high)))

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.x, self.out

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.out, GROUND),)

    @property
    def rigid_bonds(self) -> tuple[tuple[str, str], ...]:
        return self.bonds

    @property
    def output(self) -> str | None:
        return self.out

    @property
    def fault(self) -> str | None:
        if len(self.breakpoints) < 2:
            return f"needs at least two breakpoints, got {len(self.breakpoints)}"
        if not all(math.isfinite(number) for pair in self.breakpoints for number in pair):
            return "breakpoints must be finite"
        if any(later <= earlier for (earlier, _), (later, _) in itertools.pairwise(self.breakpoints)):
            return "v(x) of the breakpoints must ascend"
        return None

    @property
    def slopes(self) -> tuple[float, ...]:
        """Slopes of the pieces."""
        return tuple((d - b) / (c - a) for (a, b), (c, d) in itertools.pairwise(self.breakpoints))

    @property
    def line(self) -> tuple[float, float]:
        """Slope of the middle piece, and its voltage at v(x) = 0."""
        middle = self._middle
        x, y = self.breakpoints[middle]
        return self.slopes[middle], y - self.slopes[middle] * x

    @property
    def kinks(self) -> tuple[Kink, ...]:
        """Functions of v(x) whose sum with the line is v(out); each bends on either side of the middle piece."""
        slopes, bends = self.slopes, [x for x, _ in self.breakpoints]
        below = [(bends[k], slopes[k - 1] - slopes[k]) for k in range(self._middle, 0, -1)]
        above = [(bends[k], slopes[k] - slopes[k - 1]) for k in range(self._middle + 1, len(slopes))]
        pairs = itertools.zip_longest(_bent(below), _bent(above))
        nowhere = ((-math.inf, 0.0), (math.inf, 0.0))
        return tuple(
            Kink(low[0], high[0], (low[1], 0.0, high[1]), self.name)
            for low, high in ((pair[0] or nowhere[0], pair[1] or nowhere[1]) for pair in pairs)
        )

    @property
    def _middle(self) -> int:
        return (len(self.breakpoints) - 1) // 2


def _bent(bends: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Bends whose slopes differ."""
    return [bend for bend in bends if bend[1] != 0]
