"""Accuracy of any program: ideal parts beside scipy, real parts and exported decks beside ngspice."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    Deck,
    DiodeLimiter,
    Edges,
    Excitation,
    OpAmp,
    OpAmpModel,
    Resistor,
    SuspensionComputer,
    VoltageSource,
)
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.machine.program_loader import compile_program, parse_program
from tests.emulator.plays import LSB_V, NgSpice
from tests.emulator.random_programs import REFUSED
from tests.emulator.real_parts import off_ngspice_lsb
from tests.emulator.test_compiler import RATE_HZ, compiled_random, levels_v, off_equations_lsb

MOST_LSB = 0.05
TIGHT = 1e-11
"""Relative tolerance of scipy's solver."""

TL07X = OpAmpModel(avol=2e5, gbw_hz=3e6, slew_v_per_s=13e6, swing_v=(-13.5, 13.5), rout_ohm=100.0)

GRAZING = (20, 41, 43, 50, 85, 97, 99, 118, 134, 139)
"""Seeds of programs with backlash or stops, whose contacts enlarge a leak of 1e12 ohm beyond 0.05 LSB."""

FLOWS = {
    "fitzhugh-nagumo": (1000, 2.0, 0.5, {"v": 3.0, "w": 3.0}, "v' = v - v**3/3 - w + u\nw' = (v + 0.7 - 0.8*w) / 12.5"),
    "lorenz": (
        100,
        20.0,
        10.0,
        {"x": 25.0, "y": 35.0, "z": 60.0},
        "x' = 10*(y - x) + u\ny' = 28*x - y - x*z\nz' = x*y - 2.6667*z",
    ),
}
"""Oscillating programs by name: speed, full scale and upper trial level of u, full scales, equations."""


def flow_file(name: str) -> str:
    speed, full, high, fulls, equations = FLOWS[name]
    states = "".join(f"{state} = {{ full = {each} }}\n" for state, each in fulls.items())
    return (
        f'name = "{name}"\nspeed = {speed}\nequations = """\n{equations}\n"""\n'
        f"[inputs]\nu = {{ full = {full}, trial = [0.0, {high}] }}\n[states]\n{states}"
    )


# ---- ideal parts


def test_an_open_limiter_of_ideal_parts_leaks_nothing() -> None:
    """Two masses within their gap: the equations have no force, and neither has the patch."""
    program = compiled_random(1)
    limiters = [each for each in program.elements if isinstance(each, DiodeLimiter)]
    assert limiters
    for limiter in limiters:
        assert 10.0 / limiter.off_ohm < 1e-9 * 10.0 / 100e3


@pytest.mark.heavy
@pytest.mark.parametrize("seed", sorted({*range(0, 200, 10), *GRAZING}.difference(REFUSED)))
def test_ideal_parts_play_the_equations_of_random_programs(seed: int) -> None:
    """A sample of 20 programs, and those whose contacts graze; `make programs ARGS=200` plays every one."""
    assert off_equations_lsb(compiled_random(seed), rtol=TIGHT) < MOST_LSB


# ---- real parts


@pytest.mark.heavy
@pytest.mark.parametrize("seed", [5, 10, 15, 30])
def test_real_parts_of_random_programs_agree_with_ngspice(seed: int) -> None:
    """A sample of 4 programs; `make programs` plays 100. That of the seed 15 is driven into overload."""
    assert off_ngspice_lsb(compiled_random(seed), seed, 2.5 if seed % 4 == 3 else 1.0) < MOST_LSB


# ---- decks


def integrator(ohm: float, farad: float, *others: Resistor | DiodeLimiter | Multiplier | Function) -> Circuit:
    return Circuit(
        [
            VoltageSource("F", "in"),
            Resistor("R1", "in", "s", ohm),
            Capacitor("C1", "s", "u", farad),
            OpAmp("U1", "0", "s", "u", TL07X),
            *others,
        ]
    )


LIMITER = DiodeLimiter("D1", "u", "0", 1.0, 1e4, 1e12)
MULTIPLIER = Multiplier("M1", "u", "u", "square", scale_v=10.0)
FUNCTION = Function("N1", "u", "bent", ((-1.0, -1.0), (0.0, 0.0), (1.0, 0.5)))
STEPS = {
    "a limiter": (integrator(100e3, 1e-9, LIMITER), 1e-6),
    "a multiplier": (integrator(100e3, 1e-9, MULTIPLIER), 1e-6),
    "a function": (integrator(100e3, 1e-9, FUNCTION), 1e-6),
    "a smaller resistor": (integrator(10e3, 1e-9, LIMITER), 1e-7),
    "a larger capacitor": (integrator(10e3, 5e-9, LIMITER), 5e-7),
    "a second input": (integrator(100e3, 1e-9, MULTIPLIER, Resistor("R2", "square", "s", 100e3)), 5e-7),
    "feedback": (integrator(50e3, 1e-9, FUNCTION, Resistor("R2", "u", "s", 50e3)), 2.5e-7),
    "a load at the output": (integrator(50e3, 1e-9, LIMITER, Resistor("R2", "u", "0", 1e3)), 5e-7),
    "a fast product": (integrator(20e3, 1e-9, MULTIPLIER, Resistor("R2", "square", "s", 20e3)), 1e-7),
    "two nonlinear elements": (integrator(30e3, 2e-9, FUNCTION, MULTIPLIER), 6e-7),
    "a slow integrator": (integrator(100e3, 1e-6, LIMITER), 1e-5),
    "no nonlinear element": (integrator(100e3, 1e-9), 1e-5),
    "a stray capacitor": (integrator(100e3, 47e-12, LIMITER), 1e-5),
}
"""Circuits, and a hundredth of the shortest time constant of their integrators in s, at most 10 us."""


@pytest.mark.parametrize("name", STEPS)
def test_the_step_of_a_deck_follows_from_its_circuit(name: str) -> None:
    circuit, step_s = STEPS[name]
    (line,) = [line for line in Deck(circuit, samples=2).text().splitlines() if line.startswith(".tran")]
    assert float(line.split()[4]) == pytest.approx(step_s, rel=1e-9)


@pytest.mark.parametrize("tick", [0.5, 1.0, 7.25, 200.0])
def test_a_source_has_stepped_by_the_instant_of_its_edge(tick: float) -> None:
    edges = {"F": Edges(np.array([int(tick * TICKS_PER_SAMPLE)]), np.array([5.0]))}
    text = Deck(integrator(100e3, 1e-6), samples=300, edges=edges).text()
    points = text.partition("PWL(")[2].partition(")")[0].replace("+", "").split()
    assert [float(each) for each in points[1::2]] == [0.0, 0.0, 5.0]
    before_s, after_s = (float(each) for each in points[2::2])
    assert after_s == pytest.approx(tick * 5e-5, abs=1e-17)
    assert 0.0 < after_s - before_s < 2e-12


def test_a_sample_in_a_deck_follows_the_edge_at_its_instant(ngspice: NgSpice) -> None:
    """The output of a summer without feedback capacitor steps with its input."""
    gain = Circuit([VoltageSource("F", "in"), Resistor("R1", "in", "out", 1e3), Resistor("R2", "out", "0", 1e3)])
    deck = Deck(gain, samples=12, edges={"F": Edges(np.array([4, 9]) * TICKS_PER_SAMPLE, np.array([8.0, -8.0]))})
    assert np.abs(deck.volts(["out"]) - ngspice(deck.text(["out"]), ["out"], 12)).max() < MOST_LSB * LSB_V


@pytest.mark.heavy
@pytest.mark.parametrize("name", FLOWS)
def test_an_oscillating_program_agrees_with_its_deck_as_exported(ngspice: NgSpice, name: str) -> None:
    program = compile_program(parse_program(flow_file(name), name))
    low_v, high_v = levels_v(program)
    edges = Excitation(low_v=low_v, high_v=high_v).edges(0, 300 * TICKS_PER_SAMPLE, RATE_HZ)
    deck = Deck(SuspensionComputer(program).circuit, 300, RATE_HZ, {"F": edges})
    outputs = [each.out for each in deck.circuit.of(OpAmp)]
    assert np.abs(deck.volts(outputs) - ngspice(deck.text(outputs), outputs, 300)).max() < MOST_LSB * LSB_V
