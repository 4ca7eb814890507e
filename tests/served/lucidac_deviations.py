"""Deviation of an example's run from the ideal solution of its quantised coefficients, in machine units."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.lucidac.configuration import Configuration
from analogrig_emulator.lucidac.machine import Lucidac
from analogrig_lucidac.messages import protocol
from analogrig_lucidac.registers import Registers
from analogrig_lucidac.served_machine import MAC
from tests.emulator.ideal_lucidac import ideal_solution
from tests.harness.processes import LONG_S
from tests.served.lucidac_examples import Example
from tests.served.serving import ROOT

Values = NDArray[np.float64]

SPARSE = 5
"""Every fifth sample is compared: the ideal solution takes long."""


def run_examples(port: int, folder: Path, python: str = sys.executable) -> None:
    """Run all examples with the manufacturer's client, of the environment of ``python``, into a folder."""
    command = [python, "-m", "tests.served.lucidac_examples", str(port), str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=LONG_S)


def read_configuration(folder: Path, name: str) -> Configuration:
    """Configuration that the client made of an example."""
    items = protocol().Module.FromString((folder / f"{name}.apb").read_bytes()).items
    return Registers().with_items(items, MAC).configuration()


def play(machine: Lucidac, example: Example) -> Values:
    """Values of an example up to its horizon, (samples, channels), on a machine that is patched with it."""
    samples = round(example.horizon_s * example.sample_rate)
    codes = np.concatenate(list(machine.play(samples, example.sample_rate)))
    gains, offsets = ([getattr(scale, name) for scale in machine.scales] for name in ("gain", "offset"))
    return np.asarray(codes * np.array(gains) + np.array(offsets))


def calibrated_deviation(machine: Lucidac, example: Example, patch: Configuration) -> float:
    """Largest deviation within the horizon of a machine that is patched and calibrated."""
    machine.configure(patch)
    machine.calibrate(gain=True, offset=True)
    return deviation(example, patch, play(machine, example))


def deviation(example: Example, patch: Configuration, values: Values) -> float:
    """Largest deviation of values (samples, channels) within the horizon."""
    first, last = (round(time_s * example.sample_rate) for time_s in (example.from_s, example.horizon_s))
    shown = values[first:last:SPARSE]
    start = shown[0] if first else None
    expected = ideal_solution(_without_ports(patch), len(shown), example.sample_rate / SPARSE, start)
    return float(np.abs(shown[:, : expected.shape[1]] - expected).max())


def _without_ports(patch: Configuration) -> Configuration:
    lanes = {number: lane for number, lane in patch.lanes.items() if lane.source is not None}
    return dataclasses.replace(patch, lanes=lanes, adc=tuple(output for output in patch.adc if output < 12))
