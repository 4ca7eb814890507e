"""Circuit of a configured LUCIDAC, of ordinary elements, at +-2 V for +-1 machine unit.

    lane l         four-quadrant converter: difference amplifier UC<l> with RI<l>, RF<l> and the ladder K<l>, whose
                   dial is (1 + coefficient) / 2; then the summing resistor RS<l> into the junction of an input
    integrator i   UI<i> with CF<i> (k0 = 10,000) or CS<i> (k0 = 100) across it: summing is the sum of currents
    input 8..15    inverting summer US<j> with RM<j>; the outputs of four of them are the identities
    multiplier k   M<k>, with two summers before it
    SH<j>          current of the sample-and-hold block into a junction, which compensates offsets

anabrid publishes no schematics. The circuit follows from what is public: implicit summing, elements that invert, and
the signs of the identities. Each field of LucidacParts is an assumption unless its line says otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

from analogrig_emulator.circuit.circuit import Circuit, Element
from analogrig_emulator.circuit.components import Components, Grade, MultiplierGrade, OpAmpGrade
from analogrig_emulator.circuit.elements import GROUND, Capacitor, CurrentSource, OpAmp, Pot, Resistor, VoltageSource
from analogrig_emulator.circuit.nonlinear import Multiplier, MultiplierModel
from analogrig_emulator.circuit.opamp import OpAmpModel
from analogrig_emulator.exceptions import CircuitError
from analogrig_emulator.lucidac.configuration import (
    COEFFICIENT_STEPS,
    FAST,
    FIRST_IDENTITY,
    FIRST_PORT_LANE,
    INTEGRATORS,
    MULTIPLIERS,
    OUTPUTS,
    PORTS,
    Configuration,
    LucidacLane,
    multiplier_inputs,
    rounded_coefficient,
)

UNIT_V = 2.0
"""Volts of one machine unit, by the manual."""

FULL_SCALE = 1.25
"""End of the converter's range in machine units, by the legacy firmware."""

SUM_OHM = 10e3
FAST_FARAD, SLOW_FARAD = 10e-9, 1e-6
"""With SUM_OHM the time constants 1 / k0."""

_COEFFICIENT_OHM = 10e3

_COMPUTING = OpAmpModel(avol=1e6, gbw_hz=1e9, slew_v_per_s=300e6, swing_v=(-2.5, 2.5))
_LANE = OpAmpModel(avol=1e6)
_MULTIPLIER = MultiplierModel(full_v=UNIT_V, bandwidth_hz=250e6, slew_v_per_s=1e9, swing_v=(-2.5, 2.5))


@dataclass(frozen=True)
class LucidacParts:
    """Assumptions about the machine. No public document carries them, except where a line names its source.

    computing: op-amp of integrators and summers. lane: op-amp of a lane, without a pole: the bandwidth of lanes counts
    with that of the summers. multiplier: bandwidth and limits. components: spread of the parts, by its seed.
    Bandwidths, resistors, the nonlinearity of multipliers and multiplier_step are such that calibrated specimens stay
    within 1 % of a machine unit in the manufacturer's examples.
    coefficient_steps: steps from 0 to 1; 11 bits and sign by the manual, the size of a step is assumed.
    gain_step, offset_step, multiplier_step: resolution of the calibration, the offset in machine units. most_gain:
    largest correction of a lane's gain; by the legacy firmware a lane that needs more keeps the correction it has.
    overload: level of the overload flags, in machine units. full_scale: end of the converter's range. adc_gain,
    adc_offset: its errors, uniform within +-. adc_noise_lsb: rms noise of 16 bits.
    cables: port of the front panel at which each output of the signal generator is plugged in: "sine", "square",
    "dac0", "dac1". writes_in_op: True if coefficients may be written while the machine operates.
    """

    computing: OpAmpModel = _COMPUTING
    lane: OpAmpModel = _LANE
    multiplier: MultiplierModel = _MULTIPLIER
    components: Components = field(
        default_factory=lambda: Components(
            resistors=Grade(tolerance=2e-4),
            capacitors=Grade(tolerance=1e-2),
            op_amps=OpAmpGrade(offset_v=0.5e-3, bandwidth=0.1, slew=0.1),
            multipliers=MultiplierGrade(
                gain_error=5e-3,
                x_offset_v=5e-3,
                y_offset_v=5e-3,
                z_offset_v=5e-3,
                x_nonlinearity=5e-5,
                y_nonlinearity=5e-5,
            ),
        )
    )
    coefficient_steps: int = COEFFICIENT_STEPS
    gain_step: float = 2.0**-16
    offset_step: float = 2.0**-17
    multiplier_step: float = 2.0**-17
    most_gain: float = 0.1
    overload: float = 1.05
    full_scale: float = FULL_SCALE
    adc_gain: float = 2e-3
    adc_offset: float = 2e-3
    adc_noise_lsb: float = 1.0
    cables: Mapping[str, int] = field(default_factory=lambda: {"square": 2, "sine": 3})
    writes_in_op: bool = False

    def __post_init__(self) -> None:
        sizes = ("coefficient_steps", "gain_step", "offset_step", "multiplier_step", "overload", "full_scale")
        for name in sizes:
            if not getattr(self, name) > 0:
                raise CircuitError(f"{name} must be more than 0, not {getattr(self, name):g}")
        if not 0 <= self.most_gain < 1:
            raise CircuitError(f"most_gain must be at least 0 and below 1, not {self.most_gain:g}")
        for name in ("adc_gain", "adc_offset", "adc_noise_lsb"):
            if not 0 <= getattr(self, name) < 1e6:
                raise CircuitError(f"{name} must be at least 0 and below 1e6, not {getattr(self, name):g}")
        ports = list(self.cables.values())
        if not set(ports) <= set(range(PORTS)) or len(set(ports)) < len(ports):
            raise CircuitError(f"cables: each in one of the ports 0 to {PORTS - 1}, not {ports}")

    def quantised(self, factor: float) -> float:
        """Coefficient that the converter of a lane gives."""
        return rounded_coefficient(factor, self.coefficient_steps)


@dataclass(frozen=True)
class Trims:
    """Corrections that a calibration found: gains by lane, currents in A by input, initial conditions in V by
    integrator, the errors left to multipliers by number. A gain replaces the correction that the client set."""

    gains: Mapping[int, float] = field(default_factory=dict)
    offsets_a: Mapping[int, float] = field(default_factory=dict)
    initial_v: Mapping[int, float] = field(default_factory=dict)
    multipliers: Mapping[int, Mapping[str, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class LucidacCircuit:
    """Circuit of a configuration on one specimen of the machine."""

    configuration: Configuration
    parts: LucidacParts
    trims: Trims = Trims()

    def circuit(self, *, charging: bool = False) -> Circuit:
        """Netlist in OP, or while the integrators charge to their initial conditions."""
        fitted = self.parts.components.fit(self._elements())
        return Circuit(part for element in fitted for part in self._trimmed(element, charging=charging))

    def specimen(self) -> dict[str, Element]:
        """Real elements by name, without trims."""
        return {element.name: element for element in self.parts.components.fit(self._elements())}

    def output_node(self, output: int) -> str:
        """Node of an element's output."""
        return f"n{output - FIRST_IDENTITY + INTEGRATORS}" if output >= FIRST_IDENTITY else f"o{output}"

    @property
    def computing_nodes(self) -> dict[tuple[str, int], str]:
        """Nodes whose voltage must stay within a machine unit, by block and index in the block."""
        nodes = {("M0", i): f"o{i}" for i in self._integrators}
        return (
            nodes
            | {("M1", j - INTEGRATORS): f"n{j}" for j in self._summers}
            | {("M1", INTEGRATORS + k): f"o{INTEGRATORS + k}" for k in self._multipliers}
        )

    @property
    def port_sources(self) -> dict[int, str]:
        """Names of the voltage sources that stand for the ports in use, by port."""
        return {n - FIRST_PORT_LANE: f"PORT{n - FIRST_PORT_LANE}" for n in self._lanes if self._is_external(n)}

    # ---- elements in use

    @property
    def _lanes(self) -> Mapping[int, LucidacLane]:
        return dict(sorted(self.configuration.lanes.items()))

    def _is_external(self, number: int) -> bool:
        return number - FIRST_PORT_LANE in self.configuration.external

    @property
    def _integrators(self) -> list[int]:
        return [i for i in range(INTEGRATORS) if i in self.configuration.used]

    @property
    def _multipliers(self) -> list[int]:
        """Multipliers with an input in use, or whose output is."""
        used = self.configuration.used
        return [
            k
            for k in range(MULTIPLIERS)
            if INTEGRATORS + k in self._outputs_used or not used.isdisjoint(multiplier_inputs(k))
        ]

    @property
    def _outputs_used(self) -> set[int]:
        lanes = self.configuration.lanes.items()
        return {self.configuration.element_output(number, lane) for number, lane in lanes} | set(self.configuration.adc)

    @property
    def _summers(self) -> list[int]:
        of_multipliers = {j for k in self._multipliers for j in multiplier_inputs(k)}
        identities = {INTEGRATORS + each - FIRST_IDENTITY for each in self._outputs_used if each >= FIRST_IDENTITY}
        return sorted(of_multipliers | identities)

    # ---- netlist

    def _elements(self) -> Iterator[Element]:
        yield from self._references()
        for number, lane in self._lanes.items():
            yield from self._lane(number, lane)
        for i in self._integrators:
            integrator = self.configuration.integrators[i]
            fast = integrator.k0 == FAST
            model = self.parts.computing
            if integrator.limiter:
                model = replace(model, swing_v=(-UNIT_V, UNIT_V))
            yield Capacitor(f"CF{i}" if fast else f"CS{i}", f"s{i}", f"o{i}", FAST_FARAD if fast else SLOW_FARAD)
            yield OpAmp(f"UI{i}", GROUND, f"s{i}", f"o{i}", model)
        for j in self._summers:
            yield Resistor(f"RM{j}", f"s{j}", f"n{j}", SUM_OHM)
            yield OpAmp(f"US{j}", GROUND, f"s{j}", f"n{j}", self.parts.computing)
        for k in self._multipliers:
            x, y = multiplier_inputs(k)
            yield Multiplier(f"M{k}", f"n{x}", f"n{y}", f"o{INTEGRATORS + k}", UNIT_V, self.parts.multiplier)

    def _references(self) -> Iterator[Element]:
        constant = self.configuration.constant
        fed = {
            lane.source
            for number, lane in self._lanes.items()
            if not self._is_external(number) and self.configuration.element_output(number, lane) < 0
        }
        for output in sorted(source for source in fed if source is not None):
            yield VoltageSource(f"REF{output}", f"ref{output}", dc_v=constant * UNIT_V)

    def _lane(self, number: int, lane: LucidacLane) -> Iterator[Element]:
        out = f"c{number}"
        if self._is_external(number):
            yield VoltageSource(f"PORT{number - FIRST_PORT_LANE}", out)
        else:
            output = self.configuration.element_output(number, lane)
            source = f"ref{lane.source}" if output < 0 else self.output_node(output)
            dial = 0.5 + 0.5 * self.parts.quantised(lane.factor)
            yield Resistor(f"RI{number}", source, f"m{number}", _COEFFICIENT_OHM)
            yield Resistor(f"RF{number}", f"m{number}", out, _COEFFICIENT_OHM)
            yield Pot(f"K{number}", source, f"p{number}", GROUND, _COEFFICIENT_OHM, dial)
            yield OpAmp(f"UC{number}", f"p{number}", f"m{number}", out, self.parts.lane)
        yield Resistor(f"RS{number}", out, f"s{lane.target}", SUM_OHM / lane.gain)

    def _trimmed(self, element: Element, *, charging: bool) -> Iterator[Element]:
        """The element with its trims, and the current of the sample-and-hold block at its junction."""
        kind, number = element.name[:2], element.name[2:]
        if kind == "RS" and isinstance(element, Resistor):
            lane = self.configuration.lanes[int(number)]
            ohm = element.ohm / self.trims.gains.get(int(number), lane.gain_correction)
            lifted = charging and lane.target < INTEGRATORS
            yield replace(element, ohm=ohm, b=GROUND if lifted else element.b)
            return
        if isinstance(element, Multiplier):
            trims: Mapping[str, Any] = self.trims.multipliers.get(int(element.name[1:]), {})
            yield replace(element, model=replace(element.model, **trims))
            return
        yield element
        if kind in ("UI", "US"):
            current_a = self.trims.offsets_a.get(int(number), 0.0)
            if charging and kind == "UI":  # an inverter of the initial condition, with the capacitor across it
                initial = self.configuration.integrators[int(number)].ic * UNIT_V
                initial_v = initial + self.trims.initial_v.get(int(number), 0.0)
                yield VoltageSource(f"IC{number}", f"i{number}", dc_v=initial_v)
                yield Resistor(f"RA{number}", f"i{number}", f"s{number}", SUM_OHM)
                yield Resistor(f"RB{number}", f"s{number}", f"o{number}", SUM_OHM)
            else:
                yield CurrentSource(f"SH{number}", GROUND, f"s{number}", dc_a=current_a)


def calibrated(wiring: LucidacCircuit, *, gain: bool, offset: bool) -> Trims:
    """Trims that bring every path of a configuration to its nominal gain and offset, to their resolution.

    The gain of a lane covers its converter, its summing resistor and what follows up to the element's output, the
    capacitor of an integrator included. A multiplier is corrected in scale and offsets; its bend stays.
    """
    found = _Calibration(wiring, wiring.specimen())
    gains = found.gains() if gain else wiring.trims.gains
    return Trims(
        gains,
        found.offsets_a(gains) if offset else wiring.trims.offsets_a,
        found.initial_v() if offset else wiring.trims.initial_v,
        found.multipliers(gain=gain, offset=offset),
    )


@dataclass(frozen=True)
class _Calibration:
    wiring: LucidacCircuit
    specimen: Mapping[str, Element]

    def gains(self) -> dict[int, float]:
        """Corrections by lane, without those that would be too large."""
        parts, gains = self.wiring.parts, {number: self._gain(number) for number in self.wiring.configuration.lanes}
        return {
            number: 1.0 + parts.gain_step * round((1.0 / gain - 1.0) / parts.gain_step)
            for number, gain in gains.items()
            if abs(1.0 - gain) <= parts.most_gain * gain
        }

    def _gain(self, number: int) -> float:
        """Real gain of a lane without correction over its nominal one, from its source to the element that it feeds.

        Errors of the resistors weigh the more, the smaller the coefficient: a small one may even change its sign.
        """
        configuration = self.wiring.configuration
        lane = configuration.lanes[number]
        gain = SUM_OHM / lane.gain / self._value(f"RS{number}")
        if lane.target < INTEGRATORS:
            fast = configuration.integrators[lane.target].k0 == FAST
            name, nominal = (f"CF{lane.target}", FAST_FARAD) if fast else (f"CS{lane.target}", SLOW_FARAD)
            gain *= nominal / self._value(name)
        else:
            gain *= self._value(f"RM{lane.target}") / SUM_OHM
        if f"K{number}" in self.specimen and (wanted := self.wiring.parts.quantised(lane.factor)):
            ratio = self._value(f"RF{number}") / self._value(f"RI{number}")
            gain *= (0.5 * (1.0 + wanted) * (1.0 + ratio) - ratio) / wanted
        return gain

    def offsets_a(self, gains: Mapping[int, float]) -> dict[int, float]:
        """Currents into the junctions that bring an element without signals to zero."""
        step_a = self.wiring.parts.offset_step * UNIT_V / SUM_OHM
        out = {}
        for j in range(OUTPUTS):
            amplifier = self.specimen.get(f"UI{j}" if j < INTEGRATORS else f"US{j}")
            if not isinstance(amplifier, OpAmp):
                continue
            own_v = amplifier.model.vos_v
            current_a = sum(
                (self._lane_offset_v(number) - own_v)
                * gains.get(number, lane.gain_correction)
                / self._value(f"RS{number}")
                for number, lane in self.wiring.configuration.lanes.items()
                if lane.target == j
            )
            wanted_a = (own_v / self._value(f"RM{j}") if j >= INTEGRATORS else 0.0) - current_a
            out[j] = step_a * round(wanted_a / step_a)
        return out

    def initial_v(self) -> dict[int, float]:
        """Voltages at the charging circuits that bring integrators to zero, which double the offset of the op-amp."""
        step_v = self.wiring.parts.offset_step * UNIT_V
        amplifiers = {i: self.specimen.get(f"UI{i}") for i in range(INTEGRATORS)}
        return {
            i: step_v * round(2.0 * amplifier.model.vos_v / step_v)
            for i, amplifier in amplifiers.items()
            if isinstance(amplifier, OpAmp)
        }

    def _lane_offset_v(self, number: int) -> float:
        amplifier = self.specimen.get(f"UC{number}")
        if not isinstance(amplifier, OpAmp):
            return 0.0
        return amplifier.model.vos_v * (1.0 + self._value(f"RF{number}") / self._value(f"RI{number}"))

    def multipliers(self, *, gain: bool, offset: bool) -> dict[int, dict[str, float]]:
        """Errors that stay, by field of the model."""
        step = self.wiring.parts.multiplier_step
        errors = {"gain_error": step} if gain else {}
        if offset:
            errors |= dict.fromkeys(("x_offset_v", "y_offset_v", "z_offset_v"), step * UNIT_V)
        out = {k: dict(trims) for k, trims in self.wiring.trims.multipliers.items()}
        for element in self.specimen.values():
            if isinstance(element, Multiplier):
                trims = out.setdefault(int(element.name[1:]), {})
                for name, size in errors.items():
                    error = getattr(element.model, name)
                    trims[name] = error - size * round(error / size)
        return out

    def _value(self, name: str) -> float:
        """Real ohms or farads of an element."""
        element = self.specimen[name]
        return element.ohm if isinstance(element, Resistor) else cast(Capacitor, element).farad
