"""Real components: tolerances, drift, ageing and parasitics of one specimen of a circuit.

`Components.fit` rewrites the elements of a nominal netlist and adds parasitic ones:

    R, C, track     value (1 + tolerance) (1 + temperature coefficient (T - 25 C)) (1 + ageing sqrt(age / 1000 h))
    C               leakage resistance across it; dielectric absorption as series R-C branches across it
    op-amp          offset voltage and its drift, bandwidth and slew of the specimen; bias current through its input
                    resistance (as a voltage source behind it), input capacitance; common-mode rejection, limit of the
                    output current, recovery from overload
    multiplier      scale error, offsets and non-linearity of the specimen
    pot             wiper resistance, and resistance beyond the end stops

Engine and SPICE deck see ordinary elements only. Every draw comes from the seed and the element's name: adding an
element or a non-ideality changes no other draw. Each default switches its non-ideality off.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import Element, unknown_kind_error
from analogrig_emulator.circuit.elements import (
    GROUND,
    Capacitor,
    CurrentSource,
    DiodeLimiter,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
)
from analogrig_emulator.circuit.nonlinear import Function, Multiplier, MultiplierModel
from analogrig_emulator.circuit.opamp import OpAmpModel
from analogrig_emulator.circuit.pot import PotModel
from analogrig_emulator.engine.system import Law
from analogrig_emulator.exceptions import CircuitError

REFERENCE_C = 25.0
"""Temperature in Celsius at which components have their marked values."""

_DRAWS = 8
"""Uniform numbers within +-1 drawn for each element, numbered by _Draw."""


@functools.lru_cache(maxsize=4096)  # a fit wires the same specimen thousands of times
def _draws(seed: int, name: str) -> NDArray[np.float64]:
    """(_DRAWS,) uniform numbers of an element; not to be written to."""
    draws = np.random.default_rng([seed, *name.encode()]).uniform(-1.0, 1.0, _DRAWS)
    draws.flags.writeable = False
    return draws


class _Draw:
    """Index of each quantity among the numbers drawn for an element."""

    TOLERANCE, TEMPERATURE, AGEING, OFFSET, OFFSET_DRIFT, BANDWIDTH, SLEW, BIAS = range(_DRAWS)


class _MultiplierDraw:
    """Index of each quantity among the numbers drawn for a multiplier."""

    GAIN, X_OFFSET, Y_OFFSET, Z_OFFSET, X_NONLINEARITY, Y_NONLINEARITY = range(6)


def _require(owner: object, field_name: str, holds: object, what: str) -> None:
    if not holds:
        raise CircuitError(f"{type(owner).__name__}: {field_name} {getattr(owner, field_name)!r} {what}")


@dataclass(frozen=True)
class Grade:
    """Accuracy of a kind of component; all numbers are fractions of its value.

    tolerance: uniform within +- when new, at 25 C. temperature_per_k: coefficient of the kind;
    temperature_spread_per_k: uniform within +- about it. ageing: change after 1000 h, uniform within +-; it grows with
    the square root of time.
    Raises CircuitError naming the field.
    """

    tolerance: float = 0.0
    temperature_per_k: float = 0.0
    temperature_spread_per_k: float = 0.0
    ageing: float = 0.0

    def __post_init__(self) -> None:
        for name in ("tolerance", "temperature_spread_per_k", "ageing"):
            _require(self, name, 0.0 <= getattr(self, name) < 1.0, "must be at least 0 and less than 1")
        _require(self, "temperature_per_k", abs(self.temperature_per_k) < 0.01, "must be within +-0.01 per kelvin")

    def without_draws(self) -> Grade:
        """The grade without its random part."""
        return Grade(temperature_per_k=self.temperature_per_k)


@dataclass(frozen=True)
class Dielectric:
    """Leakage and dielectric absorption of a capacitor.

    leakage_s: its insulation resistance times its capacitance. absorption: branches in parallel, each as (fraction of
    the capacitance, time constant in s of its series R-C). marked_hz: frequency at which the capacitance is the marked
    one; branches that follow it are part of that.
    Raises CircuitError naming the field.
    """

    leakage_s: float = math.inf
    absorption: tuple[tuple[float, float], ...] = ()
    marked_hz: float = math.inf

    def __post_init__(self) -> None:
        _require(self, "leakage_s", self.leakage_s > 0, "must be positive")
        _require(self, "marked_hz", self.marked_hz > 0, "must be positive")
        for fraction, tau_s in self.absorption:
            _require(self, "absorption", 0 < fraction < 1 and 0 < tau_s < math.inf, "needs 0 < fraction < 1, tau_s > 0")

    @property
    def instantaneous(self) -> float:
        """Part of the marked capacitance that is free of absorption."""
        turns = [2.0 * math.pi * self.marked_hz * tau_s for _, tau_s in self.absorption]
        return 1.0 / (1.0 + sum(part / (1.0 + turn**2) for (part, _), turn in zip(self.absorption, turns, strict=True)))


_TAUS_S = (4.64e-5, 1e-3, 2.15e-2)
"""Time constants of the branches: the middles of three even parts of 10 us to 0.1 s on a logarithmic scale."""


def _constant_loss(tan_delta: float) -> tuple[tuple[float, float], ...]:
    """Branches of a dielectric whose loss does not depend on the frequency: within 18 % from 10 Hz to 3 kHz.

    By Kramers and Kronig its capacitance grows by (2 / pi) ln 10 tan delta per decade of time; a branch stands for 4/3.
    """
    return tuple((4.0 / 3.0 * (2.0 / math.pi) * math.log(10.0) * tan_delta, tau_s) for tau_s in _TAUS_S)


_MARKED_HZ = 1e3

DIELECTRICS: Mapping[str, Dielectric] = MappingProxyType(
    {
        "perfect": Dielectric(),
        "polyester": Dielectric(1e4, _constant_loss(2e-3), _MARKED_HZ),
        "polypropylene": Dielectric(1e5, _constant_loss(1e-4), _MARKED_HZ),
    }
)
"""Film capacitors with the typical insulation resistance and the loss at 100 Hz of their datasheets.

Relaxation faster than 10 us is part of the capacitance.
"""


@dataclass(frozen=True)
class OpAmpGrade:
    """Spread of op-amp specimens about the netlist's model, and their input currents, capacitances and noise.

    offset_v, offset_v_per_k: uniform within +-, added to the model's. bandwidth, slew: fractions, uniform within +-.
    bias_a: current into each input at 25 C, of which bias_spread, a fraction, is uniform within +-; it doubles every
    bias_doubles_k (junction FETs: 10 K). input_ohm, input_farad: from each input to ground; an op-amp without a pole or
    an output resistance has no input_farad. noise_v_per_rthz, noise_a_per_rthz: white input noise. flicker_hz:
    frequency at which the 1/f noise is as dense as the white one. cmrr, current_limit_a, recovery_s: as in OpAmpModel,
    of which the worse holds. psrr: rejection of the supply, V/V.
    Raises CircuitError naming the field.
    """

    offset_v: float = 0.0
    offset_v_per_k: float = 0.0
    bandwidth: float = 0.0
    slew: float = 0.0
    bias_a: float = 0.0
    bias_spread: float = 0.0
    bias_doubles_k: float = math.inf
    input_ohm: float = 1e12
    input_farad: float = 0.0
    noise_v_per_rthz: float = 0.0
    noise_a_per_rthz: float = 0.0
    flicker_hz: float = 0.0
    cmrr: float = math.inf
    psrr: float = math.inf
    current_limit_a: float = math.inf
    recovery_s: float = 0.0

    def __post_init__(self) -> None:
        finite = ("offset_v", "offset_v_per_k", "bias_spread", "input_farad", "noise_v_per_rthz", "noise_a_per_rthz")
        for name in (*finite, "flicker_hz", "recovery_s"):
            _require(self, name, 0 <= getattr(self, name) < math.inf, "must be finite and not negative")
        for name in ("bandwidth", "slew"):
            _require(self, name, 0 <= getattr(self, name) < 1, "must be at least 0 and less than 1")
        for name in ("bias_doubles_k", "input_ohm", "cmrr", "psrr", "current_limit_a"):
            _require(self, name, getattr(self, name) > 0, "must be positive")
        _require(self, "bias_a", math.isfinite(self.bias_a), "must be finite")
        _require(self, "input_ohm", math.isfinite(self.input_ohm) or self.bias_a == 0, "must be finite to carry bias_a")

    @property
    def coarse(self) -> OpAmpGrade:
        """The grade without its effects below 0.1 LSB of 12 bits on the suspension, which make a play slower.

        They are an input capacitance below 5 pF, 1/f noise, common mode and the limit of the output current.
        """
        input_farad = self.input_farad if self.input_farad >= _LEAST_FARAD else 0.0
        return replace(self, input_farad=input_farad, flicker_hz=0.0, cmrr=math.inf, current_limit_a=math.inf)


_LEAST_FARAD = 5e-12
"""Smallest input capacitance of a coarse grade; 3 pF make 0.08 LSB."""

FINE_OP_AMP_GRADES: Mapping[str, OpAmpGrade] = MappingProxyType(
    {
        "ideal": OpAmpGrade(),
        "tl07x": OpAmpGrade(
            offset_v=3e-3,
            offset_v_per_k=18e-6,
            bandwidth=0.2,
            slew=0.2,
            bias_a=65e-12,
            bias_spread=0.5,
            bias_doubles_k=10.0,
            input_farad=3e-12,
            noise_v_per_rthz=18e-9,
            noise_a_per_rthz=0.01e-12,
            flicker_hz=100.0,
            cmrr=1e5,
            psrr=1e5,
            current_limit_a=40e-3,
        ),
        "741": OpAmpGrade(
            offset_v=2e-3,
            offset_v_per_k=15e-6,
            bandwidth=0.2,
            slew=0.2,
            bias_a=80e-9,
            bias_spread=0.25,
            input_ohm=2e8,
            input_farad=1.4e-12,
            noise_v_per_rthz=20e-9,
            noise_a_per_rthz=0.5e-12,
            flicker_hz=200.0,
            cmrr=3.2e4,
            psrr=6.3e4,
            current_limit_a=25e-3,
        ),
        "opa627": OpAmpGrade(
            offset_v=0.1e-3,
            offset_v_per_k=0.8e-6,
            bandwidth=0.1,
            slew=0.1,
            bias_a=1e-12,
            bias_spread=0.5,
            bias_doubles_k=10.0,
            input_ohm=1e13,
            input_farad=15e-12,
            noise_v_per_rthz=5e-9,
            noise_a_per_rthz=1.6e-15,
            flicker_hz=100.0,
            cmrr=6.3e5,
            psrr=1e6,
            current_limit_a=55e-3,
        ),
    }
)
"""Grades for the models of the same name in opamp.py, with all effects; harness/docs/background/circuit.md has the
sources."""

OP_AMP_GRADES: Mapping[str, OpAmpGrade] = MappingProxyType(
    {name: grade.coarse for name, grade in FINE_OP_AMP_GRADES.items()}
)
"""The same without their effects below 0.1 LSB."""


@dataclass(frozen=True)
class MultiplierGrade:
    """Spread of multiplier specimens about the netlist's model; each field is uniform within +- and adds to it.

    gain_error, x_nonlinearity, y_nonlinearity: fractions; x_offset_v, y_offset_v, z_offset_v: V, as in MultiplierModel.
    Raises CircuitError naming the field.
    """

    gain_error: float = 0.0
    x_offset_v: float = 0.0
    y_offset_v: float = 0.0
    z_offset_v: float = 0.0
    x_nonlinearity: float = 0.0
    y_nonlinearity: float = 0.0

    def __post_init__(self) -> None:
        for name in ("gain_error", "x_nonlinearity", "y_nonlinearity"):
            _require(self, name, 0 <= getattr(self, name) < 1, "must be at least 0 and less than 1")
        for name in ("x_offset_v", "y_offset_v", "z_offset_v"):
            _require(self, name, 0 <= getattr(self, name) < math.inf, "must be finite and not negative")

    def specimen(self, model: MultiplierModel, draws: NDArray[np.float64]) -> MultiplierModel:
        """Model of one specimen, from numbers within +-1."""
        return replace(
            model,
            gain_error=model.gain_error + self.gain_error * float(draws[_MultiplierDraw.GAIN]),
            x_offset_v=model.x_offset_v + self.x_offset_v * float(draws[_MultiplierDraw.X_OFFSET]),
            y_offset_v=model.y_offset_v + self.y_offset_v * float(draws[_MultiplierDraw.Y_OFFSET]),
            z_offset_v=model.z_offset_v + self.z_offset_v * float(draws[_MultiplierDraw.Z_OFFSET]),
            x_nonlinearity=model.x_nonlinearity + self.x_nonlinearity * float(draws[_MultiplierDraw.X_NONLINEARITY]),
            y_nonlinearity=model.y_nonlinearity + self.y_nonlinearity * float(draws[_MultiplierDraw.Y_NONLINEARITY]),
        )


MULTIPLIER_GRADES: Mapping[str, MultiplierGrade] = MappingProxyType(
    {
        "ideal": MultiplierGrade(),
        "ad633": MultiplierGrade(
            gain_error=2.5e-3,
            x_offset_v=5e-3,
            y_offset_v=5e-3,
            z_offset_v=5e-3,
            x_nonlinearity=4e-3,
            y_nonlinearity=1e-3,
        ),
    }
)
"""Grades for the models of the same name in nonlinear.py; typical values of the data sheet."""


_pot_model = functools.lru_cache(maxsize=64)(PotModel)


@dataclass(frozen=True)
class PotGrade:
    """Coefficient pots: grade of the track, resistances of wiper and ends, and windings.

    windings: turns of wire on the track, on one of which the wiper rests; 0 for a continuous track. wiper_noise_ohm:
    largest rise of the wiper's resistance while it moves; drawn for each place.
    Raises CircuitError naming the field.
    """

    track: Grade = field(default_factory=Grade)
    wiper_ohm: float = 0.0
    end_ohm: float = 0.0
    windings: int = 0
    wiper_noise_ohm: float = 0.0

    def __post_init__(self) -> None:
        self.model(1.0)

    def model(self, track_ohm: float) -> PotModel:
        """Pot of this grade with track_ohm between the stops."""
        return _pot_model(track_ohm, self.wiper_ohm, self.end_ohm, self.windings, self.wiper_noise_ohm)


@dataclass(frozen=True)
class Components:
    """Component grades, temperature, age and seed of a machine. The defaults are perfect and change nothing.

    given: by element name, the deviation of a resistor, capacitor or track from its value (a fraction), or the offset
    of an op-amp in V, instead of the drawn one. given_bandwidth, given_slew: by op-amp, the deviation from the model's.
    temperature_c: temperature of all components; age_h: hours in service; seed: seed of all draws.
    Raises CircuitError naming the field.
    """

    resistors: Grade = field(default_factory=Grade)
    capacitors: Grade = field(default_factory=Grade)
    dielectric: Dielectric = field(default_factory=Dielectric)
    op_amps: OpAmpGrade = field(default_factory=OpAmpGrade)
    pots: PotGrade = field(default_factory=PotGrade)
    multipliers: MultiplierGrade = field(default_factory=MultiplierGrade)
    given: Mapping[str, float] = field(default_factory=dict)
    given_bandwidth: Mapping[str, float] = field(default_factory=dict)
    given_slew: Mapping[str, float] = field(default_factory=dict)
    temperature_c: float = REFERENCE_C
    age_h: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        _require(self, "temperature_c", -55 <= self.temperature_c <= 125, "must be within -55..125")
        _require(self, "age_h", 0 <= self.age_h < math.inf, "must be finite and not negative")
        _require(self, "seed", self.seed >= 0, "must not be negative")

    def contact(self, pot: Pot) -> NDArray[np.float64]:
        """PotModel.contact of one pot, drawn from the seed and the pot's name."""
        rng = np.random.default_rng([self.seed, *contact_of(pot.name).lower().encode()])
        return self.pots.model(pot.track_ohm).contact(rng)

    def fit(self, elements: Iterable[Element]) -> tuple[Element, ...]:
        """One specimen of a netlist: each element with its real value, followed by its parasitic elements.

        Elements and nodes added to element E are named E_... Raises CircuitError for an unknown given name, or a
        deviation that leaves no positive value.
        """
        elements = tuple(elements)
        if self.is_perfect:
            return elements
        self._check_given(elements)
        return tuple(part for element in elements for part in self._parts(element))

    def without_draws(self) -> Components:
        """The same components without random parts: values not given are those of the diagram and the models.

        The tracks become continuous: track and load are not known well enough to tell the winding of a wiper.
        """
        return replace(
            self,
            resistors=self.resistors.without_draws(),
            capacitors=self.capacitors.without_draws(),
            op_amps=replace(self.op_amps, offset_v=0.0, offset_v_per_k=0.0, bandwidth=0.0, slew=0.0, bias_spread=0.0),
            pots=replace(self.pots, track=self.pots.track.without_draws(), windings=0),
            multipliers=MultiplierGrade(),
        )

    def _check_given(self, elements: Sequence[Element]) -> None:
        every = {element.name for element in elements}
        amplifiers = {element.name for element in elements if isinstance(element, OpAmp)}
        for field_name, known, what in (
            ("given", every, "element"),
            ("given_bandwidth", amplifiers, "op-amp"),
            ("given_slew", amplifiers, "op-amp"),
        ):
            if unknown := set(getattr(self, field_name)) - known:
                raise CircuitError(f"components: {field_name}: no {what} is called {min(unknown)!r}")

    @property
    def is_perfect(self) -> bool:
        """True if fit() changes nothing. Most machines are nominal, and drawing takes longer than solving them."""
        given = self.given or self.given_bandwidth or self.given_slew
        return not given and self._kinds == NOMINAL._kinds

    @property
    def _kinds(self) -> tuple[object, ...]:
        return self.resistors, self.capacitors, self.dielectric, self.op_amps, self.pots, self.multipliers

    def _parts(self, element: Element) -> Iterator[Element]:
        draws = _draws(self.seed, element.name.lower())
        match element:
            case Resistor():
                yield replace(element, ohm=element.ohm * self._factor(element.name, self.resistors, draws))
            case Capacitor():
                factor = self._factor(element.name, self.capacitors, draws) * self.dielectric.instantaneous
                real = replace(element, farad=element.farad * factor)
                yield real
                yield from _loss_parts(real, self.dielectric)
            case Pot():
                factor = self._factor(element.name, self.pots.track, draws)
                yield from _pot_parts(replace(element, track_ohm=element.track_ohm * factor), self.pots)
            case OpAmp():
                yield replace(element, model=self._specimen(element, draws))
                yield from self._inputs(element, draws)
            case Multiplier(law=Law.PRODUCT):
                yield replace(element, model=self.multipliers.specimen(element.model, draws))
            case VoltageSource() | CurrentSource() | DiodeLimiter() | Switch() | Function() | Multiplier():
                yield element
            case _:
                raise unknown_kind_error(element)

    @property
    def _warming_k(self) -> float:
        return self.temperature_c - REFERENCE_C

    def _factor(self, name: str, grade: Grade, draws: NDArray[np.float64]) -> float:
        """Real value over nominal value; exactly 1 for the perfect grade."""
        deviation = self.given.get(name, grade.tolerance * float(draws[_Draw.TOLERANCE]))
        per_k = grade.temperature_per_k + grade.temperature_spread_per_k * float(draws[_Draw.TEMPERATURE])
        aged = grade.ageing * float(draws[_Draw.AGEING]) * math.sqrt(self.age_h / 1000.0)
        factor = (1.0 + deviation) * (1.0 + per_k * self._warming_k) * (1.0 + aged)
        if not 0 < factor < math.inf:
            raise CircuitError(f"components: {name} would have {factor:g} times its nominal value")
        return factor

    def _specimen(self, amp: OpAmp, draws: NDArray[np.float64]) -> OpAmpModel:
        grade, model = self.op_amps, amp.model
        offset_v = self.given.get(amp.name, grade.offset_v * float(draws[_Draw.OFFSET]))
        bandwidth = self.given_bandwidth.get(amp.name, grade.bandwidth * float(draws[_Draw.BANDWIDTH]))
        slew = self.given_slew.get(amp.name, grade.slew * float(draws[_Draw.SLEW]))
        drift_v = grade.offset_v_per_k * float(draws[_Draw.OFFSET_DRIFT]) * self._warming_k
        return replace(
            model,
            vos_v=model.vos_v + offset_v + drift_v,
            gbw_hz=model.gbw_hz * (1.0 + bandwidth),
            slew_v_per_s=model.slew_v_per_s * (1.0 + slew),
            cmrr=min(model.cmrr, grade.cmrr),
            current_limit_a=min(model.current_limit_a, grade.current_limit_a) if model.has_current else math.inf,
            recovery_s=max(model.recovery_s, grade.recovery_s) if model.saturates else 0.0,
        )

    def _inputs(self, amp: OpAmp, draws: NDArray[np.float64]) -> Iterator[Element]:
        grade = self.op_amps
        bias_a = grade.bias_a * (1.0 + grade.bias_spread * float(draws[_Draw.BIAS]))
        bias_a *= 2.0 ** (self._warming_k / grade.bias_doubles_k)
        for side, node in (("plus", amp.plus), ("minus", amp.minus)):
            if node == GROUND:
                continue
            if bias_a != 0:
                behind = f"{amp.name}_{side}_bias"
                yield VoltageSource(behind, behind, dc_v=-bias_a * grade.input_ohm)
                yield Resistor(f"{amp.name}_{side}_ohm", node, behind, grade.input_ohm)
            if grade.input_farad > 0 and amp.model.has_current:
                yield Capacitor(f"{amp.name}_{side}_farad", node, GROUND, grade.input_farad)


def _loss_parts(capacitor: Capacitor, dielectric: Dielectric) -> Iterator[Element]:
    name, a, b = capacitor.name, capacitor.a, capacitor.b
    if math.isfinite(dielectric.leakage_s):
        yield Resistor(f"{name}_leak", a, b, dielectric.leakage_s / capacitor.farad)
    for i, (fraction, tau_s) in enumerate(dielectric.absorption, start=1):
        farad, inner = fraction * capacitor.farad, f"{name}_soak{i}"
        yield Resistor(f"{name}_soak{i}_ohm", a, inner, tau_s / farad)
        yield Capacitor(f"{name}_soak{i}", inner, b, farad)


_OPEN_OHM = 1e12
"""Resistance of an open end."""


def contact_of(pot: str) -> str:
    """Name of the rheostat that models a wiper's noisy contact: full resistance at dial 0, none at dial 1."""
    return f"{pot}_contact"


def _pot_parts(pot: Pot, grade: PotGrade) -> Iterator[Element]:
    wiper, top, bottom = pot.wiper, pot.top, pot.bottom
    if grade.wiper_ohm > 0:
        wiper = f"{pot.name}_wiper"
        yield Resistor(f"{pot.name}_wiper_ohm", wiper, pot.wiper, grade.wiper_ohm)
    if grade.end_ohm > 0:
        top, bottom = f"{pot.name}_top", f"{pot.name}_bottom"
        yield Resistor(f"{pot.name}_top_ohm", pot.top, top, grade.end_ohm)
        yield Resistor(f"{pot.name}_bottom_ohm", bottom, pot.bottom, grade.end_ohm)
    if grade.wiper_noise_ohm > 0:
        contact, rest, wiper = contact_of(pot.name), wiper, f"{pot.name}_track"
        yield Pot(contact, wiper, rest, f"{contact}_end", grade.wiper_noise_ohm, 1.0)
        yield Resistor(f"{contact}_ohm", f"{contact}_end", GROUND, _OPEN_OHM)
    yield replace(pot, top=top, wiper=wiper, bottom=bottom)


_ADDED = re.compile(r"leak|soak\d+(_ohm)?|(plus|minus)_(bias|ohm|farad)|(wiper|top|bottom)_ohm|contact(_ohm)?")
"""Suffixes of the elements that fit() adds."""


def is_part_of(element: Element, owner: str) -> bool:
    """True if fit() added the element to its owner; its name shows it, C1_leak for C1."""
    return element.name.startswith(f"{owner}_") and _ADDED.fullmatch(element.name, len(owner) + 1) is not None


NOMINAL = Components()
"""Perfect components: fit() returns its argument."""

_METAL_FILM = Grade(tolerance=0.01, temperature_spread_per_k=50e-6, ageing=2e-3)
_TEN_TURN = PotGrade(Grade(tolerance=0.03, temperature_spread_per_k=50e-6), wiper_ohm=2.0, end_ohm=5.0, windings=5000)

COMPONENTS: Mapping[str, Components] = MappingProxyType(
    {
        "nominal": NOMINAL,
        "polyester": Components(
            resistors=_METAL_FILM,
            capacitors=Grade(0.05, temperature_per_k=400e-6, temperature_spread_per_k=100e-6, ageing=5e-3),
            dielectric=DIELECTRICS["polyester"],
            op_amps=OP_AMP_GRADES["tl07x"],
            pots=_TEN_TURN,
            multipliers=MULTIPLIER_GRADES["ad633"],
        ),
        "polypropylene": Components(
            resistors=_METAL_FILM,
            capacitors=Grade(0.01, temperature_per_k=-200e-6, temperature_spread_per_k=50e-6, ageing=2e-3),
            dielectric=DIELECTRICS["polypropylene"],
            op_amps=OP_AMP_GRADES["tl07x"],
            pots=_TEN_TURN,
            multipliers=MULTIPLIER_GRADES["ad633"],
        ),
    }
)
"""Components by name: 1 % metal film, ten-turn wire-wound pots, TL07x, AD633, and 5 % or 1 % film capacitors."""
