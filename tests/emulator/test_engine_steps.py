"""Voltages do not depend on how the engine steps, on the processor, or on the options of the compiler."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Callable
from ctypes import CDLL
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Card,
    Circuit,
    Edges,
    Engine,
    Excitation,
    OpAmp,
    OpAmpModel,
    SuspensionComputer,
    VoltageSource,
    piecewise_linear,
    sample_plays,
)
from analogrig_emulator.engine import binding
from tests.emulator.plays import Volts
from tests.emulator.programs import circuit_of

OVERLOAD = Excitation(low_v=-10.0, high_v=10.0)
PRBS = Excitation(shape="prbs", frequency_hz=7e3, clock="free", phase=0.3)
LOUD = Excitation(shape="prbs", low_v=-12.0, high_v=12.0, frequency_hz=9e3, clock="free")
FREE = Excitation(clock="free", phase=0.137, drift_ppm=20.0, frequency_hz=333.0)


def played(program: str, opamp: str, excitation: Excitation, samples: int, ahead_ticks: int = 0) -> Volts:
    computer = SuspensionComputer(circuit_of(program), opamp=opamp, rng=np.random.default_rng(3))
    return np.concatenate(list(computer.play(excitation, samples, ahead_ticks=ahead_ticks)))


@pytest.mark.parametrize("program", ["front", "shock", "two-mass"])
def test_a_machine_without_events_follows_the_matrix_exponential_at_every_sample(program: str) -> None:
    """Edges of 10 mV at any instant: nothing slews or clamps."""
    excitation = Excitation(clock="free", phase=0.3, low_v=-5e-3, high_v=5e-3, frequency_hz=1171.0)
    computer = SuspensionComputer(circuit_of(program))
    system = piecewise_linear(computer.circuit)
    states = len(system.states)
    slopes = np.array([kink.slopes[1] for kink in system.kinks])
    generator = np.zeros((states + 2, states + 2))
    generator[:states] = system.abc + (system.g * slopes) @ system.cde
    edges = excitation.edges(0, 40 * TICKS_PER_SAMPLE, 20e3)
    level_v = dict(zip(edges.ticks.tolist(), edges.levels_v.tolist(), strict=True))
    z, now, rows = np.append(np.zeros(states + 1), 1.0), 0, []
    reading = np.array(system.readings(computer.program.channel_nodes))
    for tick in sorted({*level_v, *range(0, 40 * TICKS_PER_SAMPLE, TICKS_PER_SAMPLE)}):
        z = scipy.linalg.expm(generator * ((tick - now) / TICKS_PER_SAMPLE * 50e-6)) @ z
        z[states], now = level_v.get(tick, z[states]), tick
        if tick % TICKS_PER_SAMPLE == 0:
            rows.append(reading @ z)
    volts = np.concatenate(list(computer.play(excitation, 40))) * computer.program.channel_signs
    np.testing.assert_allclose(volts, rows, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("program", "opamp", "excitation", "displacement_v", "net_force_v"),
    [
        ("front", "tl07x", OVERLOAD, (1.70885833290501, -5.94629477046024), (0.0606992647458811, 13.3602289773438)),
        ("front", "tl07x", PRBS, (1.708858332905014, 3.326310472674324), (0.06069926474588112, 2.32752516665547)),
        ("limited", "741", LOUD, (1.95956840810641, -3.88090310450470), (0.227115955726201, -5.13084572316338)),
    ],
)
def test_voltages_are_those_of_steps_that_grow_from_one_tick(
    program: str,
    opamp: str,
    excitation: Excitation,
    displacement_v: tuple[float, float],
    net_force_v: tuple[float, float],
) -> None:
    """Samples 7 and 101 as computed by another search for events: steps of 1, 1, 2, 4 ... ticks, and bisection."""
    volts = played(program, opamp, excitation, 102)[[7, 101]]
    np.testing.assert_allclose(volts[:, 1], displacement_v, rtol=0, atol=1e-12)
    np.testing.assert_allclose(volts[:, 3], net_force_v, rtol=0, atol=1e-12)


def test_a_faster_sample_rate_changes_no_voltage_and_still_steps_slow_states_alone() -> None:
    """At 1 MHz every state matters a sample period after an edge; the amplifiers' are forgotten 12 us later."""
    system, volts = piecewise_linear(SuspensionComputer("front").circuit), []
    for rate_hz, samples in ((20e3, 200), (1e6, 10_000)):
        engine = Engine(system, ["u5", "u1"], rate_hz)
        volts.append(engine.run(samples, {"F": Excitation().edges(*engine.window(samples), rate_hz)}))
    assert engine.counts.quiet > samples / 2
    np.testing.assert_allclose(volts[1][::50], volts[0], rtol=0, atol=1e-11)  # a tick is 50 times shorter


def test_slewing_ends_where_the_law_says_so_in_a_circuit_faster_than_a_tick() -> None:
    """A follower with a time constant of 0.16 ps, an eightieth of a tick: it slews, and then it is at its input."""
    model = OpAmpModel(gbw_hz=1e12, slew_v_per_s=0.5e6)
    system = piecewise_linear(Circuit([VoltageSource("V1", "in"), OpAmp("U1", "in", "out", "out", model)]))
    engine = Engine(system, ["out"], sample_rate_hz=1e6)
    volts = engine.run(30, {"V1": Edges(np.array([0]), np.array([10.0]))})[:, 0]
    np.testing.assert_allclose(volts, np.minimum(0.5 * np.arange(30), 10.0), rtol=0, atol=1e-8)
    assert engine.counts.events == 1
    assert math.isclose(volts[-1], 10.0, abs_tol=1e-12)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., CDLL]:
    """The engine, compiled with these options."""

    def compile_with(*options: str) -> CDLL:
        product = tmp_path_factory.mktemp("engine") / "_engine.so"
        sources = sorted(Path(binding.__file__).parent.rglob("*.c"))
        fixed = ("-std=c99", "-shared", "-fPIC", "-ffp-contract=off")
        subprocess.run(["cc", *options, *fixed, "-o", product, *sources], check=True)
        return binding.load_from(product)

    return compile_with


@pytest.mark.parametrize(
    "options",
    [
        ("-O1", "-DENGINE_NARROW"),
        pytest.param(("-O3", "-march=native"), marks=pytest.mark.heavy, id="-O3 -march=native"),
        ("-O1", "-fsanitize=undefined", "-fsanitize-undefined-trap-on-error"),  # undefined behaviour ends the process
    ],
    ids=" ".join,
)
def test_bits_do_not_depend_on_the_width_of_registers_or_the_compilers_options(
    options: tuple[str, ...], compiled: Callable[..., CDLL], monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = (
        ("front", "tl07x", LOUD),
        ("shock", "opa627", FREE),
        ("two-mass", "741", OVERLOAD),
        ("van-der-pol", "tl07x", FREE),
        ("two-tanks", "ideal", FREE),
    )
    volts, normals = 8.0 * np.random.default_rng(1).standard_normal((2, 3, 51, 4))
    cards = [Card(noise_lsb=(0.3,) * 4, stuck_high=1), Card(bits=16, ranges_v=((0.0, 10.0),), noise_lsb=(0.3,))]

    def all_bits() -> list[bytes]:
        plays = [played(*case, 200, ahead_ticks) for case in cases for ahead_ticks in (0, 1000)]
        codes = [sample_plays(card, volts[..., : card.channels], normals[..., : card.channels]) for card in cards]
        return [array.tobytes() for arrays in (plays, *codes) for array in arrays]

    usual = all_bits()
    other = compiled(*options)
    monkeypatch.setattr(binding, "load", lambda: other)
    assert all_bits() == usual
