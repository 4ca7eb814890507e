"""Programs played with the parts of the rig ``emulator-real``, by the engine and by ngspice."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analogrig.rigs.description import describe
from analogrig.rigs.emulator import EmulatorDescription
from analogrig_emulator import (
    MULTIPLIERS,
    TICKS_PER_SAMPLE,
    Circuit,
    Deck,
    Excitation,
    Multiplier,
    OpAmp,
    PatchedProgram,
    SuspensionComputer,
)
from analogrig_emulator.circuit.spice import Accuracy
from tests.emulator.conftest import UnfinishedError, ngspice_in
from tests.emulator.plays import LSB_V
from tests.emulator.test_compiler import RATE_HZ, levels_v

SAMPLES = 120

ACCURACIES = (Accuracy(), Accuracy(reltol=1e-6), Accuracy(reltol=1e-6, trtol=1.0))
"""Settings of ngspice, the tightest first."""


def off_ngspice_lsb(program: PatchedProgram, seed: int, drive: float = 1.0) -> float:
    """Largest difference of the parts of a seed from ngspice at any amplifier and multiplier, in LSB.

    drive: levels of the input as a multiple of those of the trial play.
    """
    low_v, high_v = levels_v(program)
    excitation = Excitation(low_v=drive * low_v, high_v=drive * high_v, clock="free", phase=0.637)
    edges = excitation.edges(0, SAMPLES * TICKS_PER_SAMPLE, RATE_HZ)
    deck = Deck(_circuit(program, seed), SAMPLES, RATE_HZ, {"F": edges})
    outputs = [each.out for each in deck.circuit.of(OpAmp)] + [each.out for each in deck.circuit.of(Multiplier)]
    return float(np.abs(deck.volts(outputs) - _by_ngspice(deck, outputs)).max() / LSB_V)


def _circuit(program: PatchedProgram, seed: int) -> Circuit:
    description = describe("emulator-real")
    assert isinstance(description, EmulatorDescription)
    parts = description.computer
    return SuspensionComputer(
        program,
        opamp=parts.op_amp,
        multiplier=MULTIPLIERS[parts.multiplier_name],
        components=parts.components_for(seed),
    ).circuit


def _by_ngspice(deck: Deck, outputs: list[str]) -> NDArray[np.float64]:
    """Voltages by the tightest of the settings with which ngspice reaches the end; it may give up in tight ones.

    :raises AssertionError: there is none.
    """
    for accuracy in ACCURACIES:
        with tempfile.TemporaryDirectory() as folder, contextlib.suppress(UnfinishedError):
            return ngspice_in(Path(folder))(deck.text(outputs, accuracy), outputs, SAMPLES)
    raise AssertionError(f"ngspice reaches the end with none of {len(ACCURACIES)} settings")
