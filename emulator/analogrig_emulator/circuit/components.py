"""Real components: what is soldered in where the circuit diagram says 100k.

`Components.fitted` turns a nominal netlist into one specimen of it, by rewriting elements and adding some:

    R, C, track     value (1 + tolerance) (1 + temperature coefficient (T - 25 C)) (1 + ageing sqrt(age / 1000 h))
    C               leakage resistance across it; dielectric absorption as series R-C branches across it
    op-amp          offset voltage and its drift, bandwidth and slew of the specimen; bias current through its input
                    resistance (as a voltage source behind it), input capacitance
    pot             wiper resistance, and what of the track lies beyond the end stops

so that the engine and a SPICE deck need know nothing of it. Every draw comes from the seed and the element's name:
adding an element, or a non-ideality, changes no other draw. What is left at its default is switched off, alone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import (
    GROUND,
    Capacitor,
    CurrentSource,
    DiodeLimiter,
    Element,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
    unknown,
)
from analogrig_emulator.circuit.opamp import OpAmpModel
from analogrig_emulator.circuit.pot import PotModel
from analogrig_emulator.errors import CircuitError

REFERENCE_C = 25.0
"""Temperature in Celsius at which components have the values that they were made to."""

_DRAWS = 8
"""Uniform numbers within +-1 that each element has for its own; what uses which is said by _Draw."""


class _Draw:
    """Which of an element's numbers decides what."""

    TOLERANCE, TEMPERATURE, AGEING, OFFSET, OFFSET_DRIFT, BANDWIDTH, SLEW, BIAS = range(_DRAWS)


def _require(owner: object, field_name: str, holds: object, what: str) -> None:
    if not holds:
        raise CircuitError(f"{type(owner).__name__}: {field_name} {getattr(owner, field_name)!r} {what}")


@dataclass(frozen=True)
class Grade:
    """How true a kind of component is to its value; all numbers are fractions of it.

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

    def undrawn(self) -> Grade:
        """What all of the kind have in common."""
        return Grade(temperature_per_k=self.temperature_per_k)


@dataclass(frozen=True)
class Dielectric:
    """What a capacitor does beside storing charge.

    leakage_s: its insulation resistance times its capacitance. absorption: branches in parallel, each as (fraction of
    the capacitance, time constant in s of its series R-C).
    Raises CircuitError naming the field.
    """

    leakage_s: float = math.inf
    absorption: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        _require(self, "leakage_s", self.leakage_s > 0, "must be positive")
        for fraction, tau_s in self.absorption:
            _require(self, "absorption", 0 < fraction < 1 and 0 < tau_s < math.inf, "needs 0 < fraction < 1, tau_s > 0")


def _constant_loss(tan_delta: float, taus_s: tuple[float, ...]) -> tuple[tuple[float, float], ...]:
    """Branches, one a decade, of a dielectric whose loss does not depend on frequency.

    By Kramers and Kronig its capacitance then grows by (2 / pi) ln 10 tan delta per decade of time.
    """
    return tuple((2.0 / math.pi * math.log(10.0) * tan_delta, tau_s) for tau_s in taus_s)


_TAUS_S = (1e-3, 1e-2, 1e-1)

DIELECTRICS: Mapping[str, Dielectric] = MappingProxyType(
    {
        "perfect": Dielectric(),
        "polyester": Dielectric(leakage_s=1e4, absorption=_constant_loss(2e-3, _TAUS_S)),
        "polypropylene": Dielectric(leakage_s=1e5, absorption=_constant_loss(1e-4, _TAUS_S)),
    }
)
"""Film capacitors with the typical insulation resistance and the loss at 100 Hz of their datasheets.

What relaxes faster than a millisecond is part of the capacitance, which is measured at 1 kHz.
"""


@dataclass(frozen=True)
class OpAmpGrade:
    """How specimens of an op-amp differ from the model in the netlist, and what their inputs draw.

    offset_v, offset_v_per_k: uniform within +-, added to the model's. bandwidth, slew: fractions, uniform within +-.
    bias_a: current into each input at 25 C, of which bias_spread, a fraction, is uniform within +-; it doubles every
    bias_doubles_k (junction FETs: 10 K). input_ohm, input_farad: from each input to ground. noise_v_per_rthz,
    noise_a_per_rthz: white input noise.
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

    def __post_init__(self) -> None:
        for name in ("offset_v", "offset_v_per_k", "bias_spread", "input_farad", "noise_v_per_rthz"):
            _require(self, name, 0 <= getattr(self, name) < math.inf, "must be finite and not negative")
        _require(self, "noise_a_per_rthz", 0 <= self.noise_a_per_rthz < math.inf, "must be finite and not negative")
        for name in ("bandwidth", "slew"):
            _require(self, name, 0 <= getattr(self, name) < 1, "must be at least 0 and less than 1")
        for name in ("bias_doubles_k", "input_ohm"):
            _require(self, name, getattr(self, name) > 0, "must be positive")
        _require(self, "bias_a", math.isfinite(self.bias_a), "must be finite")
        _require(self, "input_ohm", math.isfinite(self.input_ohm) or self.bias_a == 0, "must be finite to carry bias_a")


OP_AMP_GRADES: Mapping[str, OpAmpGrade] = MappingProxyType(
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
            noise_v_per_rthz=18e-9,
            noise_a_per_rthz=0.01e-12,
        ),
        "741": OpAmpGrade(
            offset_v=2e-3,
            offset_v_per_k=15e-6,
            bandwidth=0.2,
            slew=0.2,
            bias_a=80e-9,
            bias_spread=0.25,
            input_ohm=2e8,
            noise_v_per_rthz=20e-9,
            noise_a_per_rthz=0.5e-12,
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
            noise_v_per_rthz=5e-9,
            noise_a_per_rthz=1.6e-15,
        ),
    }
)
"""To be used with the model of the same name in opamp.py; typical values of the datasheets."""


@dataclass(frozen=True)
class PotGrade:
    """Coefficient pots: the track's grade, the resistance of the wiper, of the ends beyond each stop, and the windings.

    windings: turns of wire on the track, on one of which the wiper rests; 0 for a continuous track. wiper_noise_ohm: by
    how much the wiper's resistance rises at most while it moves, differently from place to place (drawn).
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
        """The pot of this grade whose track between the stops has track_ohm."""
        return PotModel(track_ohm, self.wiper_ohm, self.end_ohm, self.windings, self.wiper_noise_ohm)


@dataclass(frozen=True)
class Components:
    """What a machine is built of. The defaults are perfect and change nothing.

    given: by element name, the deviation of a resistor, capacitor or track from its value (a fraction), or the offset
    of an op-amp in V, instead of the drawn one. given_bandwidth, given_slew: by op-amp, the deviation from the model's.
    temperature_c: of all components; age_h: hours since they were new; seed: of all draws.
    Raises CircuitError naming the field.
    """

    resistors: Grade = field(default_factory=Grade)
    capacitors: Grade = field(default_factory=Grade)
    dielectric: Dielectric = field(default_factory=Dielectric)
    op_amps: OpAmpGrade = field(default_factory=OpAmpGrade)
    pots: PotGrade = field(default_factory=PotGrade)
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

    def fitted(self, elements: Iterable[Element]) -> tuple[Element, ...]:
        """One specimen of a netlist: each element with its real value, followed by what comes with it.

        What is added to element E is called E_..., its nodes too. Raises CircuitError for a given name that is not
        there, or a deviation that leaves no value.
        """
        elements = tuple(elements)
        if self._perfect:
            return elements
        self._check_given(elements)
        return tuple(part for element in elements for part in self._parts(element))

    def undrawn(self) -> Components:
        """The same with nothing drawn: what is not given is as the diagram and the models say.

        The tracks are continuous then: on which winding a wiper rests hangs on track and load more finely than they are
        known.
        """
        return replace(
            self,
            resistors=self.resistors.undrawn(),
            capacitors=self.capacitors.undrawn(),
            op_amps=replace(self.op_amps, offset_v=0.0, offset_v_per_k=0.0, bandwidth=0.0, slew=0.0, bias_spread=0.0),
            pots=replace(self.pots, track=self.pots.track.undrawn(), windings=0),
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
    def _perfect(self) -> bool:
        """Whether nothing would change: most machines are nominal, and drawing takes longer than solving them."""
        given = self.given or self.given_bandwidth or self.given_slew
        return not given and self._kinds == NOMINAL._kinds

    @property
    def _kinds(self) -> tuple[object, ...]:
        return self.resistors, self.capacitors, self.dielectric, self.op_amps, self.pots

    def _parts(self, element: Element) -> Iterator[Element]:
        draws = self._draws(element.name)
        match element:
            case Resistor():
                yield replace(element, ohm=element.ohm * self._factor(element.name, self.resistors, draws))
            case Capacitor():
                real = replace(element, farad=element.farad * self._factor(element.name, self.capacitors, draws))
                yield real
                yield from _losses(real, self.dielectric)
            case Pot():
                factor = self._factor(element.name, self.pots.track, draws)
                yield from _mounted(replace(element, track_ohm=element.track_ohm * factor), self.pots)
            case OpAmp():
                yield replace(element, model=self._specimen(element, draws))
                yield from self._inputs(element, draws)
            case VoltageSource() | CurrentSource() | DiodeLimiter() | Switch():
                yield element
            case _:
                raise unknown(element)

    def _draws(self, name: str) -> NDArray[np.float64]:
        return np.random.default_rng([self.seed, *name.lower().encode()]).uniform(-1.0, 1.0, _DRAWS)

    @property
    def _warming_k(self) -> float:
        return self.temperature_c - REFERENCE_C

    def _factor(self, name: str, grade: Grade, draws: NDArray[np.float64]) -> float:
        """Real value over nominal value. A factor of exactly 1 is what the perfect grade gives."""
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
            if grade.input_farad > 0:
                yield Capacitor(f"{amp.name}_{side}_farad", node, GROUND, grade.input_farad)


def _losses(capacitor: Capacitor, dielectric: Dielectric) -> Iterator[Element]:
    name, a, b = capacitor.name, capacitor.a, capacitor.b
    if math.isfinite(dielectric.leakage_s):
        yield Resistor(f"{name}_leak", a, b, dielectric.leakage_s / capacitor.farad)
    for i, (fraction, tau_s) in enumerate(dielectric.absorption, start=1):
        farad, inner = fraction * capacitor.farad, f"{name}_soak{i}"
        yield Resistor(f"{name}_soak{i}_ohm", a, inner, tau_s / farad)
        yield Capacitor(f"{name}_soak{i}", inner, b, farad)


_NOWHERE_OHM = 1e12
"""What leads to it leads nowhere."""


def contact_of(pot: str) -> str:
    """Name of the rheostat that is the noisy contact of a pot's wiper: all of it at dial 0, nothing at dial 1."""
    return f"{pot}_contact"


def _mounted(pot: Pot, grade: PotGrade) -> Iterator[Element]:
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
        yield Resistor(f"{contact}_ohm", f"{contact}_end", GROUND, _NOWHERE_OHM)
    yield replace(pot, top=top, wiper=wiper, bottom=bottom)


_ADDED = re.compile(r"leak|soak\d+(_ohm)?|(plus|minus)_(bias|ohm|farad)|(wiper|top|bottom)_ohm|contact(_ohm)?")
"""What fitted() adds to the name of an element for those that make it real."""


def is_part_of(element: Element, owner: str) -> bool:
    """Whether an element is one of those that fitted() adds to make another real: by its name, C1_leak for C1."""
    return element.name.startswith(f"{owner}_") and _ADDED.fullmatch(element.name, len(owner) + 1) is not None


NOMINAL = Components()
"""Perfect components: fitted() gives back what it was given."""

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
        ),
        "polypropylene": Components(
            resistors=_METAL_FILM,
            capacitors=Grade(0.01, temperature_per_k=-200e-6, temperature_spread_per_k=50e-6, ageing=2e-3),
            dielectric=DIELECTRICS["polypropylene"],
            op_amps=OP_AMP_GRADES["tl07x"],
            pots=_TEN_TURN,
        ),
    }
)
"""Machines as one could build them: 1 % metal film, ten-turn wire-wound pots, TL07x, and 5 % or 1 % film capacitors."""
