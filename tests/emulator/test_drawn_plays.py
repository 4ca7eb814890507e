"""Full scales hold the square wave of a run as well as that of the trial play; drawn programs play on every rig."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from analogrig_emulator.exceptions import ProgramError, UnfitError
from analogrig_emulator.machine.compiler import compile_equations
from analogrig_emulator.machine.program_loader import compile_program, equations_of
from tests.emulator.drawn_plays import RIGS, failures, scenario_of, table_of
from tests.emulator.poor_programs import mended
from tests.emulator.random_programs import REFUSED, random_program

_RUN_HZ = 200.0

RESONANT = [
    (damping, period_s, harmonic)
    for damping in (0.05, 0.1, 0.3)
    for period_s, harmonic in ((20.0, 1), (20.0, 3), (1.0, 1), (200.0, 1), (2.5, 5))
]
"""Damping, period of the trial play, and harmonic of a run's square wave that meets the resonance."""


def resonator(damping: float, period_s: float, harmonic: int, force: str = "x") -> dict[str, object]:
    """Resonator of 1 rad/s, at a speed at which the harmonic of a run's square wave meets it."""
    speed = 2 * np.pi * harmonic * _RUN_HZ
    return tomllib.loads(
        f"name = 'resonant'\nchannels = ['u', 'x', 'v']\nspeed = {speed}\nperiod_s = {period_s}\n"
        f"equations = '''\nx' = v\nv' = u - {damping}*v - {force}\n'''\n"
        "[inputs]\nu = { full = 1.0, trial = [-0.5, 0.5] }\n[states]\nx = {}\nv = {}\n"
    )


@pytest.mark.parametrize(("damping", "period_s", "harmonic"), RESONANT)
def test_full_scales_hold_the_square_wave_of_a_run(damping: float, period_s: float, harmonic: int) -> None:
    """The steady state under that wave follows from the frequency response."""
    fulls = compile_program(equations_of(resonator(damping, period_s, harmonic))).fulls
    run_s = 2 * np.pi * harmonic
    orders = np.arange(1, 400, 2)[:, None]
    at = 2 * np.pi * orders / run_s
    instants_s = np.linspace(0.0, run_s, 4001)
    waves = (2 / (np.pi * orders)) * np.exp(1j * at * instants_s) / (1 - at**2 + 1j * damping * at)
    assert fulls["x"] >= np.abs(waves.imag.sum(axis=0)).max()
    assert fulls["v"] >= np.abs((1j * at * waves).imag.sum(axis=0)).max()


@pytest.mark.parametrize("force", ["x*(1 + 0.2*x*x)", "x*(1 + 0.1*abs(x))", "x + 0.3*max(0, x - 0.5)"])
@pytest.mark.parametrize("damping", [0.1, 0.2])
def test_a_resonance_of_a_run_plays(force: str, damping: float) -> None:
    scenario = scenario_of(resonator(damping, 50.0, 1, force))
    assert not [*failures(scenario, "emulator-real", range(2))]


@pytest.mark.heavy
@pytest.mark.parametrize("seed", [19, 23, 38, 73, 107, 113, 130])
def test_drawn_programs_play_on_every_emulated_rig(seed: int) -> None:
    """A sample of 7 programs; `make drawn-plays` plays 200.

    Among them are integrators that wind up (38, 73) and a flow that plays with smaller inputs (130).
    """
    scenario = scenario_of(table_of(seed))
    assert not {rig: found for rig in RIGS if (found := [*failures(scenario, rig, range(5))])}


def test_full_scales_hold_an_integrator_that_winds_up() -> None:
    """The trial play is too short for it: a slow card plays 300 periods."""
    scenario = scenario_of(table_of(73))
    assert not [*failures(scenario, "emulator-slow", range(2))]


def test_a_flow_that_real_parts_drive_to_infinity_is_refused() -> None:
    with pytest.raises(UnfitError, match="real parts drive the program to infinity"):
        compile_equations(equations_of(tomllib.loads(random_program(REFUSED[2]))))


@pytest.mark.heavy
@pytest.mark.parametrize("seed", REFUSED)
def test_no_advice_on_a_refused_program_plays(seed: int) -> None:
    with pytest.raises(ProgramError, match=r"real parts drive the program to infinity|below one winding of a pot"):
        table_of(seed)


def test_declared_full_scales_hold_as_written() -> None:
    """A flow that real parts drive to infinity still has a patch, for ideal parts."""
    table = tomllib.loads(random_program(151))
    for name, full in {"x": 15.0, "y": 15.0, "z": 30.0, "f3": 30.0}.items():
        table["states"][name]["full"] = full
    program = compile_program(equations_of(table))
    assert program.fulls["z"] == 30.0


@pytest.mark.heavy
@pytest.mark.parametrize("seed", range(7))
def test_advice_on_drawn_programs_with_poor_scales_or_speeds_is_followed(seed: int) -> None:
    assert mended(seed)
