"""The front suspension on its tyre, against the equations of the thesis and against ngspice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    TWO_MASS,
    Circuit,
    Deck,
    Excitation,
    OpAmp,
    OpAmpModel,
    PotError,
    PotTurn,
    SuspensionComputer,
    TwoMassParts,
    TwoMassPlant,
    TwoMassProgram,
)

NgSpice = Callable[[str, Sequence[str], int], NDArray[np.float64]]
Volts = NDArray[np.float64]

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
    "compression_rate",
    "tyre_net_force",
    "tyre_velocity",
    "tyre_displacement",
)
TWEAKS: tuple[PotTurn, ...] = (
    PotTurn(120, {"K2": 18000.0}),
    PotTurn(200, {"M1": 14.0, "B2": 3453.0}),
    PotTurn(280, {"K1": 150e3, "M2": 90.0}),
)


def deck_of(
    computer: SuspensionComputer,
    tweaks: Sequence[PotTurn] = TWEAKS,
    excitation: Excitation | None = None,
) -> Deck:
    edges = (excitation or Excitation()).edges(0, SAMPLES * TICKS_PER_SAMPLE, RATE_HZ)
    turns = [PotTurn(change.sample, computer.dials_for(**change.values)) for change in tweaks]
    return Deck(computer.circuit, SAMPLES, RATE_HZ, {"F": edges}, turns, title="two masses")


FIELDS = {field.name.partition("_")[0]: field.name for field in fields(TwoMassPlant)}
"""Fields of the plant by the names of the parameters."""


def by_equations(program: TwoMassProgram, tweaks: Sequence[PotTurn]) -> Volts:
    """Equ 2.1 and 2.2 stepped exactly: (samples, quantities in the order of QUANTITIES), in V at their nodes."""
    plant, scales = program.plant, program.scales
    edges = Excitation().edges(0, SAMPLES * TICKS_PER_SAMPLE, RATE_HZ)
    force_v = edges.levels_v[np.searchsorted(edges.ticks, np.arange(SAMPLES) * TICKS_PER_SAMPLE, side="right") - 1]
    settings = {change.sample: change.values for change in tweaks}
    state, rows = np.zeros(4), []
    for k in range(SAMPLES):
        force_n = force_v[k] * scales.full("force") / 10.0
        rows.append(quantities(plant, state, force_n))
        plant = replace(plant, **{FIELDS[name]: value for name, value in settings.get(k, {}).items()})
        state = stepped(plant, state, force_n)
    return np.array(rows) * [scales.volts_at_node(quantity) for quantity in QUANTITIES]


def quantities(plant: TwoMassPlant, state: Volts, force_n: float) -> list[float]:
    x2, v2, x1, v1 = state
    s = plant.B2_n_s_per_m * (v2 - v1) + plant.K2_n_per_m * (x2 - x1)
    tyre = plant.B1_n_s_per_m * v1 + plant.K1_n_per_m * x1
    return [force_n, x2, v2, force_n - s, s, x2 - x1, v2 - v1, s - tyre, v1, x1]


def stepped(plant: TwoMassPlant, state: Volts, force_n: float) -> Volts:
    m2, b2, k2, m1, b1, k1 = asdict(plant).values()
    a = np.zeros((5, 5))
    a[:4] = [
        [0, 1, 0, 0, 0],
        [-k2 / m2, -b2 / m2, k2 / m2, b2 / m2, force_n / m2],
        [0, 0, 0, 1, 0],
        [k2 / m1, b2 / m1, -(k1 + k2) / m1, -(b1 + b2) / m1, 0],
    ]
    step: Volts = expm(a * TIME_SCALE / RATE_HZ)
    following: Volts = (step @ np.append(state, 1.0))[:4]
    return following


READ_NODES = [TWO_MASS.scales.quantities[quantity].node for quantity in QUANTITIES]


def test_with_ideal_amplifiers_it_solves_the_equations_of_the_thesis() -> None:
    volts = deck_of(SuspensionComputer("two-mass", opamp="ideal")).volts(READ_NODES)
    np.testing.assert_allclose(volts, by_equations(TWO_MASS, TWEAKS), atol=1e-9)


def test_with_real_amplifiers_it_stays_within_15_lsb_of_them() -> None:
    # Bandwidth: U7 sees a noise gain of 17, and the tyre rings at 3.4 kHz of machine time.
    volts = deck_of(SuspensionComputer("two-mass")).volts(READ_NODES)
    deviation = np.abs(volts - by_equations(TWO_MASS, TWEAKS)).max(axis=0) / LSB_V
    moving = [READ_NODES.index(node) for node in ("u11", "u2", "u5", "u8", "u9")]
    assert deviation[moving].max() < 15.0


def test_no_amplifier_exceeds_10_v() -> None:
    deck = deck_of(SuspensionComputer("two-mass"))
    assert np.abs(deck.volts([amp.out for amp in deck.circuit.of(OpAmp)])).max() < 10.0


def test_every_amplifier_agrees_with_ngspice_at_every_sample(ngspice: NgSpice) -> None:
    # At an edge's own instant ngspice still shows the level before it, so no edge is to fall on a sample.
    deck = deck_of(SuspensionComputer("two-mass"), excitation=Excitation(clock="free", phase=0.637))
    outputs = [amp.out for amp in deck.circuit.of(OpAmp)]
    reference = ngspice(deck.text(outputs), outputs, SAMPLES)
    assert np.abs(deck.volts(outputs) - reference).max() < 0.05 * LSB_V


def test_both_springs_in_series_carry_a_constant_force() -> None:
    plant = TwoMassPlant(K1_n_per_m=225e3, M1_kg=13.0)
    program = TwoMassProgram(plant)
    volts = deck_of(SuspensionComputer(program), ()).volts(["u11"])
    scales = program.scales
    static_m = 2940.0 / plant.K2_n_per_m + 2940.0 / plant.K1_n_per_m
    assert volts[49, 0] / scales.volts_at_node("displacement") == pytest.approx(static_m, rel=0.002)


def test_the_scaling_of_the_readme() -> None:
    computer = SuspensionComputer("two-mass")
    expected = {"M2": 0.2557, "B2": 0.6819, "K2": 0.8300, "M1": 0.7014, "B1": 0.3013, "K1": 0.7954}
    assert computer.coefficients == pytest.approx(expected, abs=1e-4)
    full = computer.scales.full
    assert full("suspension_force") == pytest.approx(5891.8, abs=0.1)
    assert full("tyre_net_force") == pytest.approx(995.7, abs=0.1)
    assert (full("tyre_velocity"), full("tyre_displacement")) == pytest.approx((1.0, 0.04))
    # x2 = d + x1 needs both at U11 on one scale.
    parts = TwoMassParts()
    assert full("tyre_displacement") * parts.r_out_x1_ohm == pytest.approx(full("displacement") * parts.feedback_ohm)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"M1": 12.0}, r"pot M1: coefficient 1.05\d* is beyond the track"),
        ({"K1": 250e3}, "pot K1: coefficient 1.1"),
        ({"M2": -1.0}, "pot M2: M2 must be positive"),
        ({"K3": 1.0}, "unknown setting 'K3'; there are M2,"),
    ],
)
def test_what_no_pot_can_show_is_refused_naming_it(settings: dict[str, float], message: str) -> None:
    with pytest.raises(PotError, match=message):
        SuspensionComputer("two-mass").dials_for(**settings)


def test_any_op_amp_can_be_given() -> None:
    model = OpAmpModel(gbw_hz=1e7)
    circuit: Circuit = SuspensionComputer("two-mass", opamp=model).circuit
    assert {amp.model for amp in circuit.of(OpAmp)} == {model}
    assert len(circuit.of(OpAmp)) == 11
