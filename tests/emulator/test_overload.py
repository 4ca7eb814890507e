"""Overloads: the table of the background page on the circuit."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig_emulator import (
    PROGRAMS,
    Capacitor,
    Excitation,
    OpAmp,
    Pot,
    PotError,
    PotTurn,
    Resistor,
    SuspensionComputer,
)

QUIET: dict[str, float] = {}


def lit(program: str, step_v: float = 0.0, opamp: str = "tl07x", **settings: float) -> set[str]:
    """The lamps after 400 samples of a square wave of 0..10 V, or of +-step_v / 2."""
    computer = SuspensionComputer(program, opamp=opamp)
    computer.set(**settings)
    excitation = Excitation(low_v=-step_v / 2, high_v=step_v / 2) if step_v else Excitation()
    for _ in computer.play(excitation, 400):
        pass
    return {amplifier for amplifier, sample in computer.machine.lamps.items() if sample is not None}


@pytest.mark.parametrize("program", PROGRAMS)
def test_nothing_overloads_at_the_programs_own_values(program: str) -> None:
    assert lit(program) == set()


@pytest.mark.parametrize(
    ("program", "good", "bad", "lamps"),
    [
        ("front", {"step_v": 13.5}, {"step_v": 16.0}, ("U1",)),
        ("shock", {"step_v": 16.0}, {"step_v": 20.0}, ("U2", "U4")),
        ("front", {"K": 9.8e3}, {"K": 8.6e3}, ("U3",)),
        ("shock", {"K": 6e3}, {"K": 4.9e3}, ("U3",)),
        ("shock", {"B": 540.0}, {"B": 450.0}, ("U2", "U4")),
        ("front", {"B": 150.0}, QUIET, ()),
        ("front", {"M": 29.5}, QUIET, ()),
        ("shock", {"M": 1.5}, QUIET, ()),
    ],
    ids=str,
)
def test_what_overloads(program: str, good: dict[str, float], bad: dict[str, float], lamps: tuple[str, ...]) -> None:
    assert lit(program, **good) == set()  # type: ignore[arg-type]
    assert lit(program, **bad) == set(lamps)  # type: ignore[arg-type]


@pytest.mark.parametrize("program", PROGRAMS)
def test_741s_slew_so_long_at_an_edge_that_the_summers_lamp_lights(program: str) -> None:
    assert "U1" in lit(program, opamp="741")


def test_stiffness_back_as_the_force_falls_clamps_the_summer_too_shortly_for_its_lamp() -> None:
    """K x = 24500 N/m times 0.163 m are 13.6 V; at 1 MHz the swing of 13.5 V shows, less what Rout takes."""
    computer = SuspensionComputer("front", sample_rate_hz=1e6)
    changes = [PotTurn(20, {"K": 18000.0}), PotTurn(7500, {"K": 24500.0})]
    volts = np.concatenate(list(computer.play(Excitation(frequency_hz=20e3 / 300), 7600, changes)))
    assert volts[7499, 1] * 24500.0 * 0.01996 / 294.0 == pytest.approx(13.6, abs=0.05)
    clamped = np.flatnonzero(volts[:, 3] < -13.34)
    assert 2 <= len(clamped) < 10
    assert computer.machine.lamps["U1"] is None


@pytest.mark.parametrize(
    ("program", "limits"),
    [
        ("front", {"M": (29.5, 29.3), "B": (4427.0, 4429.0), "K": (29517.0, 29519.0)}),
        ("shock", {"M": (1.48, 1.46), "B": (2213.0, 2214.5), "K": (14758.0, 14760.0)}),
    ],
)
def test_the_ends_of_the_pots(program: str, limits: dict[str, tuple[float, float]]) -> None:
    computer = SuspensionComputer(program)
    for name, (within, beyond) in limits.items():
        computer.set(**{name: within})
        with pytest.raises(PotError, match="beyond the track"):
            computer.set(**{name: beyond})


@pytest.mark.parametrize(
    ("program", "op_amps", "farads", "pots", "ohms"),
    [
        ("front", 5, {1e-9: 1, 1e-8: 1}, 3, {100e3: 3, 49.9e3: 2, 10e3: 4, 33.2e3: 1}),
        ("shock", 5, {1e-9: 1, 1e-8: 1}, 3, {100e3: 2, 49.9e3: 2, 10e3: 5, 33.2e3: 1}),
    ],
)
def test_the_list_of_components(
    program: str, op_amps: int, farads: dict[float, int], pots: int, ohms: dict[float, int]
) -> None:
    circuit = SuspensionComputer(program).circuit
    assert (len(circuit.of(OpAmp)), len(circuit.of(Pot))) == (op_amps, pots)
    for found, listed in (
        ([part.farad for part in circuit.of(Capacitor)], farads),
        ([part.ohm for part in circuit.of(Resistor)], ohms),
    ):
        assert {value: found.count(value) for value in found} == listed


def test_figures_to_check_a_new_machine_with() -> None:
    for program, peak_v in (("front", 3.5), ("shock", 7.5)):
        volts = np.concatenate(list(SuspensionComputer(program).play(Excitation(), 400)))
        assert volts[45:50, 1].max() == pytest.approx(6.01, abs=0.05)
        assert volts[:, 2].max() == pytest.approx(peak_v, abs=0.1)
