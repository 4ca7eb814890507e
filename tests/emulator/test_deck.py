"""Circuits played by the engine and, as their deck, by ngspice."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    CurrentSource,
    Deck,
    Edges,
    Excitation,
    OpAmp,
    OpAmpModel,
    PotTurn,
    Resistor,
    SuspensionComputer,
)

NgSpice = Callable[[str, Sequence[str], int], NDArray[np.float64]]

LSB_V = 10.0 / 4096
RATE_HZ = 20e3
TL07X = OpAmpModel(avol=2e5, gbw_hz=3e6, slew_v_per_s=13e6, swing_v=(-13.5, 13.5), rout_ohm=100.0)


def test_machine_with_offsets_turned_pots_and_initial_conditions_agrees_with_ngspice(ngspice: NgSpice) -> None:
    computer = SuspensionComputer("front", rng=np.random.default_rng(1), offset_v=3e-3)
    excitation = Excitation(clock="free", drift_ppm=200.0, phase=0.637, frequency_hz=317.0)
    changes = (PotTurn(60, {"K": 18000.0}), PotTurn(90, {"B": 2123.0, "K": 20000.0}))
    deck = Deck(
        computer.circuit,
        samples=120,
        edges={"F": excitation.edges(0, 120 * TICKS_PER_SAMPLE, RATE_HZ)},
        turns=[PotTurn(change.sample, computer.dials_for(**change.values)) for change in changes],
        initial_v={"C2": 1.5, "U3": -1.5, "U5": 1.5},
    )
    nodes = ("u1", "u2", "u3", "u4", "u5")
    assert np.abs(deck.volts(nodes) - ngspice(deck.text(), nodes, deck.samples)).max() < 0.05 * LSB_V


def test_current_sources_agree_with_ngspice(ngspice: NgSpice) -> None:
    circuit = Circuit(
        [
            CurrentSource("I1", "0", "a"),
            CurrentSource("I2", "b", "a", 0.1e-3),
            Resistor("R1", "a", "0", 2e3),
            Resistor("R2", "a", "b", 1e3),
            Capacitor("C1", "b", "0", 100e-9),
            OpAmp("U1", "0", "m", "out", TL07X),
            Resistor("R3", "b", "m", 10e3),
            Resistor("R4", "m", "out", 10e3),
        ]
    )
    ticks = np.rint(np.array([0.0, 20.26, 40.48]) * TICKS_PER_SAMPLE).astype(np.int64)
    edges = {"I1": Edges(ticks, np.array([0.0, 2e-3, 0.0]))}
    deck = Deck(circuit, samples=101, edges=edges, initial_v={"C1": 0.5})
    nodes = ("a", "b", "out")
    assert np.abs(deck.volts(nodes) - ngspice(deck.text(nodes), nodes, deck.samples)).max() < 0.05 * LSB_V


def test_current_comes_out_of_a_sources_second_node() -> None:
    """1 mA into 2 kOhm and 1 nF: 2 V (1 - exp(-t / 2 us)), at rest by the first sample."""
    circuit = Circuit(
        [CurrentSource("I", "0", "a", 1e-3), Resistor("R", "a", "0", 2e3), Capacitor("C", "a", "0", 1e-9)]
    )
    assert Deck(circuit, samples=5).volts(["a"])[1:, 0] == pytest.approx(2.0, abs=1e-9)
