"""The suspension with a bump stop, against its equation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from analogrig_emulator import Excitation, SuspensionComputer
from tests.emulator.programs import program_of

LSB_V = 10.0 / 4096
RATE_HZ = 20e3
TIME_SCALE = 200.0
PROGRAM = program_of("bump-stop")
STOP_M, STOP_N_PER_M = PROGRAM.values["x_stop"], PROGRAM.values["K_stop"]


def played(opamp: str, samples: int) -> NDArray[np.float64]:
    """Channels in V under a step of the force."""
    return np.concatenate(list(SuspensionComputer(PROGRAM, opamp=opamp).play(Excitation(frequency_hz=1.0), samples)))


def by_equation(force_n: float, samples: int) -> NDArray[np.float64]:
    """X in m and x' in m/s at the samples after a step of the force, from rest."""

    def slope(_: float, state: NDArray[np.float64]) -> list[float]:
        x, v = state
        spring_n = 24500.0 * x + STOP_N_PER_M * max(0.0, x - STOP_M)
        return [v, (force_n - 3021.0 * v - spring_n) / 115.0]

    instants_s = np.arange(samples) * TIME_SCALE / RATE_HZ
    solved = solve_ivp(
        slope, (0.0, instants_s[-1]), [0.0, 0.0], "DOP853", instants_s, rtol=1e-11, atol=1e-13, max_step=1e-3
    )
    states: NDArray[np.float64] = solved.y.T
    return states


def test_with_ideal_amplifiers_it_solves_its_equation() -> None:
    volts = played("ideal", 60)[:, 1:3]
    expected = by_equation(2940.0, 60) * [PROGRAM.scales.volts("displacement"), PROGRAM.scales.volts("velocity")]
    assert np.abs(volts - expected).max() < 0.05 * LSB_V
    assert expected[:, 0].max() > STOP_M * PROGRAM.scales.volts("displacement")


def test_at_rest_on_the_stop_both_springs_carry_the_force() -> None:
    expected_m = (2940.0 + STOP_N_PER_M * STOP_M) / (24500.0 + STOP_N_PER_M)
    found_m = played("tl07x", 100)[-1, 1] / PROGRAM.scales.volts("displacement")
    np.testing.assert_allclose(found_m, expected_m, rtol=2e-4)
