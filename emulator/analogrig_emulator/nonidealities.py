"""Effect of each non-ideality alone on the displacement, in LSB of 12 bits.

The figure of a row is max |x - x_ideal| over SAMPLES samples of a 200 Hz square wave of 0..10 V at the converter's
input, in LSB of 10 V / 4096; for random effects, the median over DRAWS seeds. The front suspension plays the four
changes of the thesis. The shock absorber plays the same in proportion, without M / 4, which is beyond its mass pot.
Rows of the multiplier have a spring that hardens with the cube of the displacement, which takes two multipliers.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.acquisition import Playable, acquired, probes_per_sample
from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.card.sampler import Card, Sampler, drawn_levels
from analogrig_emulator.circuit.components import (
    DIELECTRICS,
    FINE_OP_AMP_GRADES,
    MULTIPLIER_GRADES,
    NOMINAL,
    REFERENCE_C,
    Components,
    Dielectric,
    Grade,
    OpAmpGrade,
    PotGrade,
)
from analogrig_emulator.circuit.nonlinear import MULTIPLIERS, MultiplierModel
from analogrig_emulator.circuit.opamp import IDEAL, PRESETS, OpAmpModel
from analogrig_emulator.circuit.pot import PotTurn
from analogrig_emulator.machine.noise import ABSOLUTE_ZERO_C, QUIET, NoisySuspension, Supply
from analogrig_emulator.machine.program_circuit import CHANNELS, ProgramCircuit
from analogrig_emulator.machine.program_loader import compile_program, parse_program
from analogrig_emulator.machine.quarter_car import FRONT, SHOCK
from analogrig_emulator.machine.suspension import PROGRAMS, SuspensionComputer

SAMPLES = 800
DRAWS = 25
_FEW_DRAWS = 5
"""Number of draws for slow rows."""

_CARD = Card(ranges_v=((-1.0, 9.0),) * len(CHANNELS))
_DISPLACEMENT = CHANNELS.index("displacement")


@dataclass(frozen=True)
class Effect:
    """Row of the table: median and largest of `draws` figures, in LSB."""

    name: str
    median_lsb: float
    largest_lsb: float
    draws: int


FRONT_CHANGES: Sequence[PotTurn] = (
    PotTurn(200, {"K": 18000.0}),
    PotTurn(400, {"B": 3453.0}),
    PotTurn(500, {"B": 2123.0, "K": 20000.0}),
    PotTurn(600, {"M": 30.0}),
)


_CHANGES: Mapping[str, Sequence[PotTurn]] = {
    "shock": tuple(
        PotTurn(k, {name: SHOCK.values[name] * value / FRONT.values[name] for name, value in settings.items()})
        for k, settings, _ in FRONT_CHANGES[:-1]
    ),
    "front": FRONT_CHANGES,
}

_SLOW_CHANGE_N = 100
"""Samples of the ramp of K to four fifths, for effects of a turning pot."""

_Operator = Callable[[SuspensionComputer, Mapping[str, float], np.random.Generator], Mapping[str, float]]
"""Operator: maps wanted values of M, B, K to the settings made."""


def _set_exactly(
    _machine: SuspensionComputer, wanted: Mapping[str, float], _rng: np.random.Generator
) -> Mapping[str, float]:
    return wanted


def _set_without_load(
    machine: SuspensionComputer, wanted: Mapping[str, float], _rng: np.random.Generator
) -> dict[str, float]:
    """Set each dial to the coefficient wanted under load."""
    program = machine.program
    return {f"{program.parameters[key].pot}_dial": program.coefficient(key, value) for key, value in wanted.items()}


def _set_to_a_thousandth(
    machine: SuspensionComputer, wanted: Mapping[str, float], rng: np.random.Generator
) -> dict[str, float]:
    """Miss each dial by up to 0.1 % of full scale."""
    dials = machine.dials_for(**wanted)
    return {f"{pot}_dial": min(dial + rng.uniform(-1e-3, 1e-3), 1.0) for pot, dial in dials.items()}


@dataclass(frozen=True)
class _Setup:
    """Machine and card, ideal by default.

    quantised: compare codes instead of converter inputs. turning: play one ramp instead of the usual changes. added:
    compare with the same op-amps without the components.
    """

    op_amp: OpAmpModel = IDEAL
    multiplier: MultiplierModel = MULTIPLIERS["ideal"]
    components: Components = NOMINAL
    noise: OpAmpGrade | None = None
    card: Card = _CARD
    operator: _Operator = _set_exactly
    quantised: bool = False
    turning: bool = False
    added: bool = False
    temperature_c: float = REFERENCE_C
    supply: Supply = QUIET

    def figure_lsb(self, program: ProgramCircuit, seed: int, ideal_lsb: NDArray[np.float64]) -> float:
        """Largest difference of the displacement from the ideal machine's, or from that without the effect."""
        reference_lsb = ideal_lsb
        if self.turning or self.added:
            reference_lsb = dataclasses.replace(self, components=NOMINAL).displacement_lsb(program, seed)
        elif self.noise is not None:
            reference_lsb = dataclasses.replace(self, noise=None).displacement_lsb(program, seed)
        return float(np.abs(self.displacement_lsb(program, seed) - reference_lsb).max())

    def displacement_lsb(self, program: ProgramCircuit, seed: int) -> NDArray[np.float64]:
        """Converter input or code of the displacement at every sample: (SAMPLES,), LSB."""
        rate_hz = self.card.true_rate_hz * probes_per_sample(self.card)
        components = dataclasses.replace(self.components, seed=seed)
        machine = SuspensionComputer(
            program,
            opamp=self.op_amp,
            multiplier=self.multiplier,
            components=components,
            sample_rate_hz=rate_hz,
        )
        rng = np.random.default_rng(seed)
        machine.set(**self.operator(machine, program.values, rng))
        slow = [PotTurn(200, {"K": 0.8 * program.values["K"]}, _SLOW_CHANGE_N)]
        wanted = slow if self.turning else _CHANGES[program.name]
        changes = [PotTurn(k, self.operator(machine, values, rng), n) for k, values, n in wanted]
        played: Playable = machine
        if self.noise is not None:
            played = NoisySuspension(
                machine, rng, op_amps=self.noise, temperature_c=self.temperature_c, supply=self.supply
            )
        volts = np.concatenate(list(acquired(played, self.card, Excitation(), SAMPLES, changes, rng=rng)))
        sampler = Sampler(self.card, rng)
        seen_lsb = sampler.seen_lsb(volts)
        return (sampler.convert(seen_lsb)[0] if self.quantised else seen_lsb)[:, _DISPLACEMENT].astype(np.float64)


_Make = Callable[[int], _Setup]
"""Makes the setup of a draw."""


def measure_effects(program: str) -> Iterator[Effect]:
    """Yield the rows for a program ("shock" or "front"), about 4 s in all."""
    linear = (_value_rows, _pot_rows, _op_amp_rows, _dielectric_rows, _card_rows)
    every = itertools.chain.from_iterable(rows() for rows in linear)
    for chosen, rows in ((PROGRAMS[program], every), (hardening(program), _multiplier_rows())):
        ideal_lsb = _Setup().displacement_lsb(chosen, 0)
        for name, draws, make in rows:
            figures = [make(seed).figure_lsb(chosen, seed, ideal_lsb) for seed in range(draws)]
            yield Effect(name, float(np.median(figures)), max(figures), draws)


def hardening(program: str, cubic_per_m2: float = 15.0) -> ProgramCircuit:
    """The suspension with a spring of force K x + cubic_per_m2 K x^3, K the program's value: a fifth more at 0.12 m."""
    base = PROGRAMS[program]
    fulls, values = base.scales, base.values
    least = {"M": 0.25 if program == "front" else 1.0, "B": 0.7, "K": 0.7}
    rows = "\n".join(
        f"{name} = {{ value = {value}, range = [{least[name] * value}, {1.2 * value}] }}"
        for name, value in values.items()
    )
    return compile_program(
        parse_program(
            f"""
name = "{program}"
speed = {fulls.time}
channels = ["force", "displacement", "velocity", "net_force"]
equations = '''
displacement' = velocity
net_force = force - B*velocity - K*displacement - cubic*displacement**3
velocity' = net_force / M
'''
[inputs]
force = {{ full = {fulls.full("force")} }}
[states]
displacement = {{ full = {fulls.full("displacement")} }}
velocity = {{}}
[parameters]
cubic = {{ value = {cubic_per_m2 * values["K"]} }}
{rows}
""",
            program,
        )
    )


def _constant(setup: _Setup) -> _Make:
    return lambda _seed: setup


def _with_components(components: Components) -> _Make:
    return _constant(_Setup(components=components))


def _value_rows() -> Iterator[tuple[str, int, _Make]]:
    for percent in (5, 1):
        parts = Components(resistors=Grade(0.01), capacitors=Grade(percent / 100))
        yield f"R 1 %, C {percent} %, not calibrated", DRAWS, _with_components(parts)
    film = Grade(temperature_spread_per_k=50e-6)
    for name, per_k, spread_per_k in (("polyester", 400e-6, 100e-6), ("polypropylene", -200e-6, 50e-6)):
        warm = Components(
            resistors=film,
            capacitors=Grade(temperature_per_k=per_k, temperature_spread_per_k=spread_per_k),
            temperature_c=35.0,
        )
        yield f"+10 C, {name}", DRAWS, _with_components(warm)


def _pot_rows() -> Iterator[tuple[str, int, _Make]]:
    yield "pot loading ignored", 1, _constant(_Setup(operator=_set_without_load))
    yield "pots set to 0.1 % of full scale", DRAWS, _constant(_Setup(operator=_set_to_a_thousandth))
    yield "pots of 5000 windings", 1, _with_components(Components(pots=PotGrade(windings=5000)))
    noisy = Components(pots=PotGrade(wiper_noise_ohm=100.0))
    yield "wiper noise 100 ohm, K turned", _FEW_DRAWS, _constant(_Setup(components=noisy, turning=True))


def _op_amp_rows() -> Iterator[tuple[str, int, _Make]]:
    tl07x, offset = PRESETS["tl07x"], OpAmpGrade(offset_v=3e-3)
    yield "offsets of +-3 mV", DRAWS, _with_components(Components(op_amps=offset))
    models = {
        "GBW 3 MHz": OpAmpModel(gbw_hz=tl07x.gbw_hz),
        "GBW 3 MHz, slew 13 V/us": OpAmpModel(gbw_hz=tl07x.gbw_hz, slew_v_per_s=tl07x.slew_v_per_s),
        "Avol 106 dB": OpAmpModel(avol=2e5),
        "741": PRESETS["741"],
        "OPA627": PRESETS["opa627"],
    }
    for name, model in models.items():
        yield name, 1, _constant(_Setup(op_amp=model))
    yield (
        "noise of TL07x and resistors",
        DRAWS,
        _constant(_Setup(op_amp=tl07x, noise=dataclasses.replace(FINE_OP_AMP_GRADES["tl07x"], flicker_hz=0.0))),
    )
    yield from _supply_rows()
    for name in ("tl07x", "741"):
        grade = FINE_OP_AMP_GRADES[name]
        bias = OpAmpGrade(bias_a=grade.bias_a, input_ohm=grade.input_ohm)
        yield f"bias current, {name} ({1e9 * grade.bias_a:g} nA)", 1, _with_components(Components(op_amps=bias))
    grade = FINE_OP_AMP_GRADES["tl07x"]
    parts = {
        f"input capacitance {1e12 * grade.input_farad:g} pF": OpAmpGrade(input_farad=grade.input_farad),
        "common-mode rejection 100 dB": OpAmpGrade(cmrr=grade.cmrr),
        "output current to 40 mA": OpAmpGrade(current_limit_a=grade.current_limit_a),
        "output current to 1 mA": OpAmpGrade(current_limit_a=1e-3),
        "recovery from overload 5 us": OpAmpGrade(recovery_s=5e-6),
    }
    for name, part in parts.items():
        yield name, 1, _constant(_Setup(op_amp=tl07x, components=Components(op_amps=part), added=True))


def _supply_rows() -> Iterator[tuple[str, int, _Make]]:
    # The same 1/f density beside a white one of no account; resistors without noise.
    cold = _Setup(op_amp=PRESETS["tl07x"], temperature_c=ABSOLUTE_ZERO_C)
    grade = FINE_OP_AMP_GRADES["tl07x"]
    pink = OpAmpGrade(noise_v_per_rthz=1e-6 * grade.noise_v_per_rthz, flicker_hz=1e12 * grade.flicker_hz)
    yield "1/f noise of TL07x", DRAWS, _constant(dataclasses.replace(cold, noise=pink))
    humming = dataclasses.replace(cold, noise=OpAmpGrade(psrr=grade.psrr), supply=Supply(hum_v=0.1))
    yield "hum of 0.1 V, rejected by 100 dB", 1, _constant(humming)


def _multiplier_rows() -> Iterator[tuple[str, int, _Make]]:
    ad633, errors = MULTIPLIERS["ad633"], MULTIPLIER_GRADES["ad633"]
    pole = MultiplierModel(bandwidth_hz=ad633.bandwidth_hz)
    models = {
        "scale error 0.25 %": MultiplierModel(gain_error=errors.gain_error),
        "offset of x 5 mV": MultiplierModel(x_offset_v=errors.x_offset_v),
        "offset of y 5 mV": MultiplierModel(y_offset_v=errors.y_offset_v),
        "offset of output 5 mV": MultiplierModel(z_offset_v=errors.z_offset_v),
        "non-linearity of x 0.4 %": MultiplierModel(x_nonlinearity=errors.x_nonlinearity),
        "non-linearity of y 0.1 %": MultiplierModel(y_nonlinearity=errors.y_nonlinearity),
        "1 MHz": pole,
        "1 MHz, slew 20 V/us": dataclasses.replace(pole, slew_v_per_s=ad633.slew_v_per_s),
        "1 MHz, swing +-11 V": dataclasses.replace(pole, swing_v=ad633.swing_v),
    }
    for name, model in models.items():
        yield f"AD633, {name}", 1, _constant(_Setup(multiplier=model))
    drawn = Components(multipliers=errors)
    yield "AD633, all errors drawn", DRAWS, _constant(_Setup(multiplier=ad633, components=drawn))
    noisy = _Setup(multiplier=ad633, noise=OpAmpGrade(), temperature_c=ABSOLUTE_ZERO_C)
    yield "AD633, noise 0.8 uV/rtHz", DRAWS, _constant(noisy)


def _dielectric_rows() -> Iterator[tuple[str, int, _Make]]:
    for name in ("polyester", "polypropylene"):
        absorption = dataclasses.replace(DIELECTRICS[name], leakage_s=math.inf)
        yield f"dielectric absorption, {name}", 1, _with_components(Components(dielectric=absorption))
        fastest = dataclasses.replace(absorption, absorption=absorption.absorption[:1])
        yield f"absorption 10 to 215 us, {name}", 1, _with_components(Components(dielectric=fastest))
    leakage = Dielectric(leakage_s=DIELECTRICS["polyester"].leakage_s)
    yield "capacitor leakage, polyester", 1, _with_components(Components(dielectric=leakage))


def _card_rows() -> Iterator[tuple[str, int, _Make]]:
    channels = (0.0,) * len(CHANNELS)
    faults: dict[str, Card] = {
        "10 us channel skew": dataclasses.replace(_CARD, skew_s=tuple(10e-6 * (i == _DISPLACEMENT) for i in range(4))),
        "aperture delay 50 ns": dataclasses.replace(_CARD, aperture_delay_s=50e-9),
        "acquisition to 12 time constants": dataclasses.replace(_CARD, acquisition=12.0),
        "droop 0.5 V/s, one conversion": dataclasses.replace(_CARD, throughput_hz=100e3, droop_v_per_s=0.5),
        "gain error 0.01 %": dataclasses.replace(_CARD, gain_error=tuple(1e-4 for _ in channels)),
    }
    for name, card in faults.items():
        yield name, 1, _constant(_Setup(card=card))
    yield "jitter 1 ns", DRAWS, _constant(_Setup(card=dataclasses.replace(_CARD, aperture_jitter_s=1e-9)))
    yield (
        "card noise 1 LSB rms",
        DRAWS,
        _constant(_Setup(card=dataclasses.replace(_CARD, noise_lsb=(1.0,) * 4))),
    )
    yield "quantisation", 1, _constant(_Setup(quantised=True))
    yield "INL 1/2 LSB, and quantisation", DRAWS, lambda seed: _Setup(card=_bent_card(seed), quantised=True)


def _bent_card(seed: int) -> Card:
    levels_lsb = drawn_levels(_CARD.bits, np.random.default_rng(seed), inl_lsb=0.5)
    return dataclasses.replace(_CARD, levels_lsb=levels_lsb)
