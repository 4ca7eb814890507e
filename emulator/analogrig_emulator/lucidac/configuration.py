"""Configuration of a LUCIDAC: elements and lanes, as its protocol describes them. Values are in machine units.

Eight integrators have the outputs 0 to 7, four multipliers 8 to 11. The inputs of the first two multipliers are also
outputs, 12 to 15 (identities). Each of 32 lanes takes an output (matrix U), multiplies it by a coefficient (matrix C)
and adds it to an input (matrix I): 0 to 7 are those of the integrators, 8 and 9 of the first multiplier, and so on.

    v = coefficient output[source]          s[target] = sum of v, or of UPSCALE v
    output 0..7:    y' = -k0 s, y(0) = -ic
    output 8..11:   s8 s9, s10 s11, s12 s13, s14 s15
    output 12..15:  -s8 ... -s11

A constant replaces output 15 on lanes 0 to 15, and output 14 on lanes 16 to 31. A port of the front panel that is set
to external replaces one of the lanes 24 to 31 behind its coefficient.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from analogrig_emulator.exceptions import CircuitError

INTEGRATORS = 8
MULTIPLIERS = 4
OUTPUTS = 16
LANES = 32
PORTS = 8
ADC_CHANNELS = 8
FIRST_PORT_LANE = 24
FIRST_IDENTITY = INTEGRATORS + MULTIPLIERS
UPSCALE = 8.0
COEFFICIENT_STEPS = 2048
"""Steps of a coefficient from 0 to 1: 11 bits and sign by the manual; the size of a step is assumed."""
FAST, SLOW = 10_000, 100
"""Time constants k0 in 1/s."""

_WAVE_FORMS = ("sine", "sine and square", "triangle")
_MOST_HZ = 1e6


def constant_output(lane: int) -> int:
    """Output that the constant replaces on a lane."""
    return 15 if lane < LANES // 2 else 14


def multiplier_inputs(multiplier: int) -> tuple[int, int]:
    """Inputs of a multiplier."""
    return INTEGRATORS + 2 * multiplier, INTEGRATORS + 2 * multiplier + 1


def rounded_coefficient(factor: float, steps: int = COEFFICIENT_STEPS) -> float:
    """Coefficient that the converter of a lane gives."""
    return round(factor * steps) / steps


@dataclass(frozen=True)
class Integrator:
    """Settings of one integrator. limiter: True clips its output at one machine unit."""

    ic: float = 0.0
    k0: int = FAST
    limiter: bool = False


@dataclass(frozen=True)
class LucidacLane:
    """Connection of an output to an input. source: None for a lane that a port of the front panel feeds."""

    source: int | None
    target: int
    factor: float = 1.0
    upscaled: bool = False
    gain_correction: float = 1.0

    @property
    def gain(self) -> float:
        """Gain behind the coefficient."""
        return UPSCALE if self.upscaled else 1.0


@dataclass(frozen=True)
class SignalGenerator:
    """Generator of the front panel: a sine or triangle, a square wave, and two constant voltages.

    phase: in degrees, at the beginning of OP.
    """

    wave_form: str = "sine"
    frequency_hz: float = 1000.0
    phase: float = 0.0
    amplitude: float = 0.0
    offset: float = 0.0
    square: tuple[float, float] = (0.0, 0.0)
    dac: tuple[float, float] = (0.0, 0.0)
    sleep: bool = True


@dataclass(frozen=True)
class Configuration:
    """All that is patched. lanes: by number; external: ports of the front panel that feed their lanes; adc: outputs
    that the channels of the converter read.

    Raises CircuitError that names what is out of range.
    """

    integrators: tuple[Integrator, ...] = (Integrator(),) * INTEGRATORS
    lanes: Mapping[int, LucidacLane] = field(default_factory=dict)
    constant: float = 0.0
    external: frozenset[int] = frozenset()
    adc: tuple[int, ...] = ()
    generator: SignalGenerator = SignalGenerator()

    def __post_init__(self) -> None:
        for i, integrator in enumerate(self.integrators):
            _require(integrator.k0 in (FAST, SLOW), f"integrator {i}: k0 must be {FAST} or {SLOW}, not {integrator.k0}")
            _require_within(integrator.ic, 1.0, f"integrator {i}: initial condition")
        for number, lane in self.lanes.items():
            self._check_lane(number, lane)
        _require(self.constant in (0.0, 1.0, -1.0, 0.1, -0.1), f"constant must be +-1, +-0.1 or 0, not {self.constant}")
        _require(len(self.adc) <= ADC_CHANNELS, f"the converter has {ADC_CHANNELS} channels, not {len(self.adc)}")
        _require_all(self.adc, OUTPUTS, "converter: output")
        _require_all(self.external, PORTS, "front panel: port")
        self._check_generator()

    def _check_lane(self, number: int, lane: LucidacLane) -> None:
        _require_all([number], LANES, "lane")
        _require_all([lane.target], OUTPUTS, f"lane {number}: input")
        _require_within(lane.factor, 1.0, f"lane {number}: coefficient")
        _require(0.5 <= lane.gain_correction <= 2.0, f"lane {number}: gain correction must be 0.5 to 2")
        if lane.source is not None:
            _require_all([lane.source], OUTPUTS, f"lane {number}: output")
        else:
            _require(number - FIRST_PORT_LANE in self.external, f"lane {number}: no output and no port feeds it")

    def _check_generator(self) -> None:
        each = self.generator
        _require(each.wave_form in _WAVE_FORMS, f"signal generator: wave form must be one of {', '.join(_WAVE_FORMS)}")
        _require(
            each.sleep or 1e-3 <= each.frequency_hz <= _MOST_HZ, "signal generator: frequency must be 1 mHz to 1 MHz"
        )
        _require(math.isfinite(each.phase), "signal generator: phase must be finite")
        for level in (each.amplitude, each.offset, *each.square, *each.dac):
            _require_within(level, 2.0, "signal generator: level")

    @property
    def used(self) -> frozenset[int]:
        """Inputs and outputs, by number, whose elements are part of the circuit."""
        ends = [lane.target for lane in self.lanes.values()]
        ends += [output for number, lane in self.lanes.items() if (output := self.element_output(number, lane)) >= 0]
        return frozenset([*ends, *self.adc])

    def element_output(self, number: int, lane: LucidacLane) -> int:
        """Output of an element that feeds a lane; -1 if the constant or a port feeds it."""
        if lane.source is None or number - FIRST_PORT_LANE in self.external:
            return -1
        return -1 if self.constant and lane.source == constant_output(number) else lane.source


def _require(holds: object, message: str) -> None:
    if not holds:
        raise CircuitError(message)


def _require_within(value: float, most: float, what: str) -> None:
    _require(abs(value) <= most, f"{what} must be within +-{most:g}, not {value:g}")


def _require_all(numbers: Iterable[int], count: int, what: str) -> None:
    for number in numbers:
        _require(0 <= number < count, f"{what} must be 0 to {count - 1}, not {number}")
