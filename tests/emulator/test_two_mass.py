"""The front suspension on its tyre, against the equations of the thesis and against ngspice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from analogrig_emulator import TICKS_PER_SAMPLE, Deck, Excitation, OpAmp, PotTurn, SuspensionComputer
from tests.emulator.programs import program_of

Volts = NDArray[np.float64]

PROGRAM = program_of("two-mass")
LSB_V = 10.0 / 4096
RATE_HZ = 20e3
SAMPLES = 400
TIME_SCALE = 200.0
QUANTITIES = (
    "force",
    "displacement",
    "velocity",
    "net_force",
    "suspension_force",
    "compression",
    "rate",
    "tyre_net_force",
    "tyre_velocity",
    "tyre_displacement",
)
CHANGES: tuple[PotTurn, ...] = (
    PotTurn(120, {"K2": 18000.0}),
    PotTurn(200, {"M1": 14.0, "B2": 3453.0}),
    PotTurn(280, {"K1": 150e3, "M2": 90.0}),
)


READ_NODES = [PROGRAM.scales.quantities[quantity].node for quantity in QUANTITIES]


def deck_of(computer: SuspensionComputer, changes: Sequence[PotTurn] = CHANGES) -> Deck:
    edges = Excitation().edges(0, SAMPLES * TICKS_PER_SAMPLE, RATE_HZ)
    turns = [PotTurn(change.sample, computer.dials_for(**change.values)) for change in changes]
    return Deck(computer.circuit, SAMPLES, RATE_HZ, {"F": edges}, turns, title="two masses")


def by_equations(changes: Sequence[PotTurn]) -> Volts:
    """Equ 2.1 and 2.2 stepped exactly: (samples, quantities in the order of QUANTITIES), in V at their nodes."""
    values, scales = dict(PROGRAM.values), PROGRAM.scales
    edges = Excitation().edges(0, SAMPLES * TICKS_PER_SAMPLE, RATE_HZ)
    force_v = edges.levels_v[np.searchsorted(edges.ticks, np.arange(SAMPLES) * TICKS_PER_SAMPLE, side="right") - 1]
    settings = {change.sample: change.values for change in changes}
    rows: list[list[float]] = []
    state: Volts = np.zeros(4)
    for k in range(SAMPLES):
        force_n = force_v[k] * scales.full("force") / 10.0
        rows.append(quantities(values, state, force_n))
        values |= settings.get(k, {})
        state = stepped(values, state, force_n)
    return np.array(rows) * [scales.volts_at_node(quantity) for quantity in QUANTITIES]


def quantities(values: Mapping[str, float], state: Volts, force_n: float) -> list[float]:
    x2, v2, x1, v1 = state
    s = values["B2"] * (v2 - v1) + values["K2"] * (x2 - x1)
    tyre = values["B1"] * v1 + values["K1"] * x1
    return [force_n, x2, v2, force_n - s, s, x2 - x1, v2 - v1, s - tyre, v1, x1]


def stepped(values: Mapping[str, float], state: Volts, force_n: float) -> Volts:
    m2, b2, k2, m1, b1, k1 = (values[name] for name in ("M2", "B2", "K2", "M1", "B1", "K1"))
    a = np.zeros((5, 5))
    a[:4] = [
        [0.0, 1.0, 0.0, 0.0, 0.0],
        [-k2 / m2, -b2 / m2, k2 / m2, b2 / m2, force_n / m2],
        [0.0, 0.0, 0.0, 1.0, 0.0],
        [k2 / m1, b2 / m1, -(k1 + k2) / m1, -(b1 + b2) / m1, 0],
    ]
    step: Volts = expm(a * TIME_SCALE / RATE_HZ)
    following: Volts = (step @ np.append(state, 1.0))[:4]
    return following


def test_with_ideal_amplifiers_it_solves_the_equations_of_the_thesis() -> None:
    volts = deck_of(SuspensionComputer(PROGRAM, opamp="ideal")).volts(READ_NODES)
    np.testing.assert_allclose(volts, by_equations(CHANGES), atol=1e-9)


def test_with_real_amplifiers_it_stays_within_25_lsb_of_them() -> None:
    # Bandwidth: the tyre rings at 3.4 kHz of machine time, and the summers have inputs of gain 10.
    volts = deck_of(SuspensionComputer(PROGRAM)).volts(READ_NODES)
    deviation = dict(zip(QUANTITIES, np.abs(volts - by_equations(CHANGES)).max(axis=0) / LSB_V, strict=True))
    moving = ("displacement", "velocity", "compression", "tyre_velocity", "tyre_displacement")
    assert max(deviation[name] for name in moving) < 25.0


def test_no_amplifier_exceeds_10_v() -> None:
    deck = deck_of(SuspensionComputer(PROGRAM))
    assert np.abs(deck.volts([amp.out for amp in deck.circuit.of(OpAmp)])).max() < 10.0


def test_both_springs_in_series_carry_a_constant_force() -> None:
    computer = SuspensionComputer(PROGRAM)
    computer.set(K1=215e3, M1=15.0)
    scale = PROGRAM.scales.quantities["displacement"]
    volts = deck_of(computer, ()).volts([scale.node])
    static_m = 2940.0 / PROGRAM.values["K2"] + 2940.0 / 215e3
    assert volts[49, 0] / PROGRAM.scales.volts_at_node("displacement") == pytest.approx(static_m, rel=0.002)
