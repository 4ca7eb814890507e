"""One program of the analogue computer: a quarter-car suspension, M x'' + B x' + K x = F, at 200 times its own speed.

    U1 summer        -> -e_N = -(e_F - beta e_v - kappa e_x)
    pot M, U2        -> +e_v     integrator, R1 C1
    U3               -> -e_x     integrator, R2 C2
    U4, pot B        -> inverts e_v for the summer
    U5               -> +e_x     inverts for the card
    pot K            feeds -e_x to the summer

The summer puts out net force and not acceleration, so that a jump of M moves one pot. README.md draws the circuit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from .circuit import GROUND, Capacitor, Circuit, Element, OpAmp, Pot, Resistor, VoltageSource
from .components import NOMINAL, Components
from .errors import CircuitError, EngineError, PotError
from .excitation import Excitation
from .machine import AnalogComputer, Mode
from .opamp import OpAmpModel, preset
from .pot import PotModel, checked_dial

__all__ = [
    "CHANNELS",
    "FRONT",
    "PROGRAMS",
    "SHOCK",
    "Program",
    "Scales",
    "SuspensionComputer",
    "SuspensionParts",
    "Tweak",
]

Tweak = tuple[int, Mapping[str, float]]
"""(sample, settings): the settings of SuspensionComputer.set that apply after that sample is taken."""

CHANNELS = ("force", "displacement", "velocity", "net_force")
"""What the card's four channels read, in order."""

CHANNEL_NODES = ("in", "u5", "u2", "u1")
# U1 puts out -e_N: the card's differential input for the net force is wired the other way round.
CHANNEL_SIGNS = np.array((1.0, 1.0, 1.0, -1.0))

# The integrators: velocity and displacement.
_AT_REST_V = MappingProxyType({"U2": 0.0, "U3": 0.0})

SOURCE = "F"
"""Name of the circuit's input, and its node is "in"."""

BLOCK_SAMPLES = 32768
"""1 MB: in smaller blocks the calls cost more than a quiet stretch."""

_PARAMETERS = {"M_kg": "M", "B_n_s_per_m": "B", "K_n_per_m": "K"}
_DIALS = {"M_dial": "M", "B_dial": "B", "K_dial": "K"}
_LOADS = {"M": "R1", "B": "RB", "K": "RK"}
"""Which resistor each pot drives, its far end being at virtual ground."""


@dataclass(frozen=True)
class SuspensionParts:
    """Component values, in ohm and farad.

    rf, rfb, rb, rk: the summer; r1, c1 and r2, c2: the integrators; r4 and r5, in and feedback: the inverters;
    pot_m, pot_b, pot_k: the tracks.
    """

    rf_ohm: float = 100e3
    rfb_ohm: float = 100e3
    rb_ohm: float = 33.2e3
    rk_ohm: float = 49.9e3
    r1_ohm: float = 100e3
    c1_farad: float = 1e-9
    r2_ohm: float = 49.9e3
    c2_farad: float = 10e-9
    r4_in_ohm: float = 10e3
    r4_fb_ohm: float = 10e3
    r5_in_ohm: float = 10e3
    r5_fb_ohm: float = 10e3
    pot_m_ohm: float = 10e3
    pot_b_ohm: float = 10e3
    pot_k_ohm: float = 10e3


@dataclass(frozen=True)
class Scales:
    """What 10 V stand for on the force, velocity and displacement channels.

    time: how much faster the machine runs than what it models. displacement_m = time velocity R2 C2.
    """

    force_n: float
    velocity_m_per_s: float = 2.0
    displacement_m: float = 0.1996
    time: float = 200.0

    def volts(self, channel: str) -> float:
        """Volts per unit (N, m, m/s) of a channel."""
        full = {
            "force": self.force_n,
            "displacement": self.displacement_m,
            "velocity": self.velocity_m_per_s,
            "net_force": self.force_n,
        }
        return 10.0 / full[channel]


@dataclass(frozen=True)
class Program:
    """A set of parameters with the scaling and the nominal parts that suit it."""

    name: str
    M_kg: float
    B_n_s_per_m: float
    K_n_per_m: float
    scales: Scales
    parts: SuspensionParts

    def coefficient(self, pot: str, value: float) -> float:
        """The coefficient k_M, k_B or k_K that makes the machine show a parameter of that value (kg, N s/m, N/m).

        It may exceed 1, which is for the pot to refuse. Raises PotError for a value that is not positive and finite.
        """
        if not (math.isfinite(value) and value > 0):
            raise PotError(f"pot {pot}: {pot} must be positive and finite, got {value!r}")
        scales, parts = self.scales, self.parts
        if pot == "M":
            return scales.time * scales.force_n * parts.r1_ohm * parts.c1_farad / (value * scales.velocity_m_per_s)
        if pot == "B":
            return (value * scales.velocity_m_per_s / scales.force_n) * (parts.rb_ohm / parts.rfb_ohm)
        return (value * scales.displacement_m / scales.force_n) * (parts.rk_ohm / parts.rfb_ohm)


FRONT = Program("front", 115.0, 3021.0, 24500.0, Scales(force_n=2940.0), SuspensionParts())
"""The front suspension of the thesis."""

SHOCK = Program("shock", 2.0, 900.0, 12250.0, Scales(force_n=1470.0), SuspensionParts(r1_ohm=10e3))
"""The shock absorber of the thesis; its mass pot feeds the integrator's gain-of-ten input."""

PROGRAMS: Mapping[str, Program] = MappingProxyType({program.name: program for program in (FRONT, SHOCK)})


class SuspensionComputer:
    """The wired machine: it knows M, B and K, sets pots, and is played.

    program: "front", "shock" or a Program. opamp: the name of a preset ("tl07x", "741", "ideal") or a model.
    parts: the component values of the diagram, the program's own when None; components: what is fitted for them.
    Pots are set from the program's own values, with the real load connected.
    rng, offset_v: when an rng is given, each op-amp has an offset of its own, uniform within +-offset_v (drawn U1 to
    U5).
    machine: the AnalogComputer on which it is patched, to be operated by hand: U2 and U3 are integrators, at +velocity
    and -displacement, and its lamps are those of the last play.
    Raises CircuitError, PotError.
    """

    def __init__(
        self,
        program: str | Program = "front",
        *,
        opamp: str | OpAmpModel = "tl07x",
        parts: SuspensionParts | None = None,
        components: Components = NOMINAL,
        rng: np.random.Generator | None = None,
        offset_v: float = 3e-3,
        sample_rate_hz: float = 20e3,
    ) -> None:
        self.program = _program(program)
        self.parts = self.program.parts if parts is None else parts
        self.sample_rate_hz = sample_rate_hz
        model = preset(opamp) if isinstance(opamp, str) else opamp
        models = [model] * 5 if rng is None else [_offset(model, rng.uniform(-offset_v, offset_v)) for _ in range(5)]
        circuit = Circuit(components.fitted(_netlist(self.parts, models)))
        self._pots = _pots(circuit, components)
        self.machine = AnalogComputer(circuit, CHANNEL_NODES, initial_v=_AT_REST_V, sample_rate_hz=sample_rate_hz)
        self.set(M_kg=self.program.M_kg, B_n_s_per_m=self.program.B_n_s_per_m, K_n_per_m=self.program.K_n_per_m)
        self._plays = 0

    @property
    def circuit(self) -> Circuit:
        """The netlist, its pots as they are set now."""
        return self.machine.circuit

    @property
    def scales(self) -> Scales:
        """What the voltages stand for."""
        return self.program.scales

    @property
    def dials(self) -> dict[str, float]:
        """Where the pots M, B and K stand, 0..1."""
        return self.machine.dials

    @property
    def coefficients(self) -> dict[str, float]:
        """What the pots M, B and K pass under their load."""
        return {pot: self._pots[pot].coefficient(dial) for pot, dial in self.dials.items()}

    def set(self, **settings: float) -> None:
        """Turns pots to show M_kg, B_n_s_per_m, K_n_per_m, or to stand at M_dial, B_dial, K_dial (0..1).

        The former set the coefficient under load, as an operator in pot-set mode does. A running machine keeps its
        voltages. Raises PotError naming the pot, with nothing turned.
        """
        self.machine.turn(self._resolve(settings))

    def dials_for(self, **settings: float) -> dict[str, float]:
        """The dials to which set(**settings) would turn the pots."""
        return self._resolve(settings)

    def play(
        self, excitation: Excitation, samples: int, tweaks: Sequence[Tweak] = (), block_samples: int = BLOCK_SAMPLES
    ) -> Iterator[NDArray[np.float64]]:
        """Plays from rest; yields the volts of CHANNELS in blocks, float64 (block_samples or, last, fewer; 4).

        The excitation's first level is applied at sample 0. A tweak (k, settings) takes effect right after sample k is
        taken, so sample k + 1 is the first that can show it. Pots stay where the tweaks leave them. set() between two
        blocks acts likewise.
        Raises PotError, ExcitationError and EngineError; for arguments that cannot be, before anything is played.
        """
        if samples < 0 or block_samples < 1:
            raise EngineError(f"cannot play {samples} samples in blocks of {block_samples}")
        turns = self._plan(tweaks, samples)
        excitation.edges(0, 1, self.sample_rate_hz)
        self.machine.restart(Mode.OPERATE)
        self._plays += 1
        return self._blocks(self._plays, excitation, samples, turns, block_samples)

    # ---- playing

    def _plan(self, tweaks: Sequence[Tweak], samples: int) -> list[tuple[int, dict[str, float]]]:
        """The tweaks as (samples to be recorded before, dials), in order of time."""
        turns = []
        for sample, settings in sorted(tweaks, key=lambda tweak: tweak[0]):
            if not 0 <= sample < samples:
                raise PotError(
                    f"tweak of {', '.join(settings)} at sample {sample}: the run has samples 0 to {samples - 1}"
                )
            turns.append((sample + 1, self._resolve(settings)))
        return turns

    def _blocks(
        self,
        play: int,
        excitation: Excitation,
        samples: int,
        turns: list[tuple[int, dict[str, float]]],
        block_samples: int,
    ) -> Iterator[NDArray[np.float64]]:
        for start in range(0, samples, block_samples):
            stop = min(start + block_samples, samples)
            parts = []
            while play == self._plays and self.machine.recorded < stop:
                until = min(stop, turns[0][0]) if turns else stop
                parts.append(self._advance(excitation, until - self.machine.recorded))
                while turns and turns[0][0] == self.machine.recorded:
                    self.machine.turn(turns.pop(0)[1])
            if play != self._plays:
                raise EngineError("this play was ended by a newer one on the same machine")
            yield parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _advance(self, excitation: Excitation, samples: int) -> NDArray[np.float64]:
        edges = excitation.edges(*self.machine.window(samples), self.sample_rate_hz)
        volts = self.machine.run(samples, {SOURCE: edges})
        volts *= CHANNEL_SIGNS
        return volts

    # ---- pots

    def _resolve(self, settings: Mapping[str, float]) -> dict[str, float]:
        dials: dict[str, float] = {}
        for key, value in settings.items():
            pot = _PARAMETERS.get(key) or _DIALS.get(key)
            if pot is None:
                raise PotError(f"unknown setting {key!r}; there are {', '.join((*_PARAMETERS, *_DIALS))}")
            if pot in dials:
                raise PotError(f"pot {pot}: set twice at the same time")
            dial = checked_dial(value, pot) if key in _DIALS else self._dial_showing(pot, key, value)
            dials[pot] = self._pots[pot].model.resting(dial)
        return dials

    def _dial_showing(self, pot: str, key: str, value: float) -> float:
        try:
            return self._pots[pot].dial(self.program.coefficient(pot, value))
        except PotError as cause:
            raise PotError(f"{cause}; {key} = {value:g} cannot be set on program {self.program.name}") from cause


@dataclass(frozen=True)
class _LoadedPot:
    """A pot in its place: model, name, and the ohms to a virtual ground that it drives."""

    model: PotModel
    name: str
    load_ohm: float

    def coefficient(self, dial: float) -> float:
        return self.model.coefficient(dial, self.load_ohm)

    def dial(self, coefficient: float) -> float:
        return self.model.dial(coefficient, self.load_ohm, self.name)


def _pots(circuit: Circuit, components: Components) -> dict[str, _LoadedPot]:
    loads_ohm = {resistor.name: resistor.ohm for resistor in circuit.of(Resistor)}
    return {
        pot.name: _LoadedPot(components.pots.model(pot.track_ohm), pot.name, loads_ohm[_LOADS[pot.name]])
        for pot in circuit.of(Pot)
    }


def _program(program: str | Program) -> Program:
    if isinstance(program, Program):
        return program
    if program not in PROGRAMS:
        raise CircuitError(f"unknown program {program!r}; there are {', '.join(PROGRAMS)}")
    return PROGRAMS[program]


def _offset(model: OpAmpModel, vos_v: float) -> OpAmpModel:
    return replace(model, vos_v=model.vos_v + vos_v)


def _netlist(parts: SuspensionParts, models: Sequence[OpAmpModel]) -> list[Element]:
    """The diagram, its pots at 0."""
    u1, u2, u3, u4, u5 = models
    return [
        VoltageSource(SOURCE, "in"),
        Resistor("RF", "in", "s1", parts.rf_ohm),
        Resistor("RFB", "s1", "u1", parts.rfb_ohm),
        Resistor("RB", "wb", "s1", parts.rb_ohm),
        Resistor("RK", "wk", "s1", parts.rk_ohm),
        OpAmp("U1", GROUND, "s1", "u1", u1),
        Pot("M", "u1", "wm", GROUND, parts.pot_m_ohm, 0.0),
        Resistor("R1", "wm", "s2", parts.r1_ohm),
        Capacitor("C1", "s2", "u2", parts.c1_farad),
        OpAmp("U2", GROUND, "s2", "u2", u2),
        Resistor("R2", "u2", "s3", parts.r2_ohm),
        Capacitor("C2", "s3", "u3", parts.c2_farad),
        OpAmp("U3", GROUND, "s3", "u3", u3),
        Resistor("R4", "u2", "s4", parts.r4_in_ohm),
        Resistor("R4FB", "s4", "u4", parts.r4_fb_ohm),
        OpAmp("U4", GROUND, "s4", "u4", u4),
        Pot("B", "u4", "wb", GROUND, parts.pot_b_ohm, 0.0),
        Pot("K", "u3", "wk", GROUND, parts.pot_k_ohm, 0.0),
        Resistor("R5", "u3", "s5", parts.r5_in_ohm),
        Resistor("R5FB", "s5", "u5", parts.r5_fb_ohm),
        OpAmp("U5", GROUND, "s5", "u5", u5),
    ]
