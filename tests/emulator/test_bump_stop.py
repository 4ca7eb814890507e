"""The suspension with a bump stop, against its equation and against ngspice."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    BumpStop,
    CircuitError,
    Deck,
    Excitation,
    OpAmp,
    PotTurn,
    SuspensionComputer,
)

NgSpice = Callable[[str, Sequence[str], int], NDArray[np.float64]]

LSB_V = 10.0 / 4096
RATE_HZ = 20e3
TIME_SCALE = 200.0
STOP = BumpStop()


def deck_of(computer: SuspensionComputer, excitation: Excitation, samples: int, **dials: float) -> Deck:
    edges = excitation.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)
    turns = [PotTurn(samples // 2, dials)] if dials else []
    return Deck(computer.circuit, samples, RATE_HZ, {"F": edges}, turns, title="bump stop")


def by_equation(force_n: float, samples: int) -> NDArray[np.float64]:
    """X in m and x' in m/s at the samples after a step of the force, from rest."""

    def slope(_: float, state: NDArray[np.float64]) -> list[float]:
        x, v = state
        spring_n = 24500.0 * x + STOP.stiffness_n_per_m * max(0.0, x - STOP.stop_m)
        return [v, (force_n - 3021.0 * v - spring_n) / 115.0]

    instants_s = np.arange(samples) * TIME_SCALE / RATE_HZ
    solved = solve_ivp(
        slope, (0.0, instants_s[-1]), [0.0, 0.0], "DOP853", instants_s, rtol=1e-11, atol=1e-13, max_step=1e-3
    )
    states: NDArray[np.float64] = solved.y.T
    return states


def test_with_ideal_amplifiers_it_solves_its_equation() -> None:
    computer = SuspensionComputer("bump-stop", opamp="ideal")
    volts = deck_of(computer, Excitation(frequency_hz=1.0), 60).volts(["u5", "u2"])
    expected = by_equation(2940.0, 60) * [computer.scales.volts("displacement"), computer.scales.volts("velocity")]
    # 1.5 N/m of the limiter's off_ohm are a ppm of its displacement.
    assert np.abs(volts - expected).max() < 0.2 * LSB_V
    assert expected[:, 0].max() > STOP.stop_m * computer.scales.volts("displacement")


def test_at_rest_on_the_stop_both_springs_carry_the_force() -> None:
    computer = SuspensionComputer("bump-stop")
    volts = deck_of(computer, Excitation(frequency_hz=1.0), 100).volts(["u5"])
    expected_m = (2940.0 + STOP.stiffness_n_per_m * STOP.stop_m) / (24500.0 + STOP.stiffness_n_per_m)
    assert volts[-1, 0] / computer.scales.volts("displacement") == pytest.approx(expected_m, rel=2e-4)


def test_every_amplifier_agrees_with_ngspice_at_every_sample(ngspice: NgSpice) -> None:
    computer = SuspensionComputer("bump-stop", rng=np.random.default_rng(3), offset_v=3e-3)
    excitation = Excitation(low_v=-3.0, clock="free", phase=0.637)
    deck = deck_of(computer, excitation, 300, **computer.dials_for(K=18000.0))
    outputs = [amp.out for amp in deck.circuit.of(OpAmp)]
    reference = ngspice(deck.text(outputs), outputs, 300)
    error = np.abs(deck.volts(outputs) - reference)
    assert error.max() < 0.05 * LSB_V


def test_a_stop_that_cannot_be_is_refused() -> None:
    with pytest.raises(CircuitError, match="bump stop: stiffness_n_per_m must be positive"):
        BumpStop(stiffness_n_per_m=-1.0)
