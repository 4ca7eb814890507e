"""Random configurations of the LUCIDAC in ngspice."""

from __future__ import annotations

import numpy as np

from analogrig_emulator import piecewise_linear
from analogrig_emulator.circuit.spice import Accuracy, Deck
from analogrig_emulator.lucidac.machine import Lucidac
from tests.emulator.ideal_lucidac import random_configuration
from tests.emulator.plays import NgSpice

SAMPLES = 20
LSB_V = 5.0 / 65536
"""16 bits over the range of the converter, +-1.25 machine units."""


def ngspice_error_lsb(ngspice: NgSpice, seed: int) -> float:
    """Largest difference between engine and ngspice at any output of a calibrated specimen, drawn by the seed."""
    machine = Lucidac()
    machine.configure(random_configuration(np.random.default_rng(seed)))
    machine.calibrate(gain=True, offset=True)
    charging = piecewise_linear(machine.wiring.circuit(charging=True))
    start_v = dict(zip(charging.states, charging.rest(np.zeros(0)).state.tolist(), strict=True))
    deck = Deck(machine.wiring.circuit(), SAMPLES, initial_v=start_v)
    nodes = list(dict.fromkeys(machine.wiring.computing_nodes.values()))
    text = deck.text(nodes, Accuracy(reltol=1e-8, vntol_v=1e-9, trtol=0.03, max_step_s=2e-6, method="gear"))
    return float(np.abs(deck.volts(nodes) - ngspice(text, nodes, SAMPLES)).max()) / LSB_V
