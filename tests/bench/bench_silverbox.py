"""Twin of the Silverbox: a program fitted to its multisines simulates its arrow head.

The record is that of silverbox.py. The machine has the two multipliers and five coefficients of
fixtures/programs/silverbox.toml, TL07x amplifiers, and runs at the speed of the Silverbox. Nothing of the arrow head is
fitted.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from analogrig.bench import Bench
from analogrig.config import fixtures
from analogrig.devices.registry import open_dut
from analogrig.reporting.measured import Oscillation, mode_of
from analogrig.rigs.emulator import ComputerDescription
from analogrig.rigs.recording import RecordingRig
from analogrig.run import Run
from analogrig_emulator import CHANNELS, PatchedProgram, load_patch
from analogrig_emulator.machine.program_loader import compile_program, parse_program
from analogrig_instruments.calibration.recorded_plant import RecordedPlant, fit_program

from .figure import Figure
from .silverbox import GROWTH_END, RATE_HZ, find_file, import_record

FITTED = (GROWTH_END, 130_000)
MOST_V = 0.45e-3
ESTIMATED_N = 15_000
SPECIMENS = 3

MACHINES = {
    "nominal parts": (ComputerDescription(), 0),
    **{f"real parts, specimen {i}": (ComputerDescription(components="polyester"), i) for i in range(1, SPECIMENS + 1)},
}

NOTE = f"""\
Each row is a machine with the program `silverbox`. `analogrig calibrate` fits its six parameters to
samples {FITTED[0]:,} to {FITTED[1]:,} alone, the multisines. It then plays the arrow head, samples 0 to
{GROWTH_END:,}, with the recorded input, and never sees the recorded output. The first 200 samples of
either are not compared. The amplifiers are TL07x (`--op-amp tl07x`). Real parts are polyester
capacitors, 1 % resistors, and AD633 multipliers with drawn errors. The pots are
continuous.

The linear rows leave out the multipliers: the best that a mass, a damper and a linear spring do.
The required rms is {MOST_V * 1e3:g} mV. The record itself is not part of the repository:
`ANALOGRIG_SILVERBOX` names the folder of `SNLS80mV.csv`.
"""
"""Paragraphs below the table."""


def figures() -> Iterator[Figure]:
    """Two rows a machine, one more for the speed; none without the record."""
    try:
        run = import_record()
    except FileNotFoundError as absent:
        print(f"silverbox is skipped: {absent}")
        return
    program = load_patch(fixtures() / "programs" / "silverbox.toml")
    for name, (computer, seed) in MACHINES.items():
        yield from _fitted(name, program, run, computer, seed)
    yield from _fitted("linear, nominal parts", linear(program), run, ComputerDescription(), 0)
    yield from _estimated(import_record(ESTIMATED_N))


def linear(program: PatchedProgram) -> PatchedProgram:
    """The same program without its multipliers."""
    path = fixtures() / "programs" / f"{program.name}.toml"
    lines = [line for line in path.read_text().splitlines() if not line.startswith(("square =", "cube ="))]
    text = "\n".join(lines).replace(" + square*x**2 - cube*x**3", "")
    return compile_program(parse_program(text, str(path)))


def _fitted(name: str, program: PatchedProgram, run: Run, computer: ComputerDescription, seed: int) -> Iterator[Figure]:
    plant = RecordedPlant(program, run, computer, seed)
    span, arrow = plant.span(*FITTED), plant.span(0, GROWTH_END)
    start_s = time.process_time()
    twin = fit_program(plant, span)
    fit_s = time.process_time() - start_s
    seen, unseen = twin.fit, plant.difference(twin.values, arrow)
    yield Figure(f"{name}: multisines, fitted", seen.rms * 1e3, "mV rms", f"largest {seen.largest * 1e3:.2f} mV")
    yield Figure(f"{name}: arrow head", unseen.rms * 1e3, "mV rms", f"largest {unseen.largest * 1e3:.2f} mV")
    if not name.startswith("linear"):
        failed = "" if unseen.rms <= MOST_V else f"more than {MOST_V * 1e3:g} mV"
        yield Figure(f"{name}: required", not failed, "", failed)
        rate = twin.plays * (span.end - span.first) / fit_s
        yield Figure(f"{name}: fit", fit_s, "s of processor time", f"{twin.plays} plays, {rate / 1e6:.2f} M samples/s")


def play(run: Run, device: str) -> Run:
    """Run of a recording through a device."""
    rig = RecordingRig.of(run, find_file())
    with open_dut(device) as dut:
        return Bench(rig, dut).play(*rig.recorded)


def batch(run: Run) -> Oscillation:
    """Resonance, damping and gain of y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k) + .. + b2 u(k-2) + d by least squares."""
    u, y = (run.codes[:, CHANNELS.index(name)].astype(float) for name in CHANNELS[:2])
    regressors = [-y[1:-1], -y[:-2], u[2:], u[1:-1], u[:-2], np.ones(len(y) - 2)]
    theta = np.linalg.lstsq(np.stack(regressors, axis=1), y[2:], rcond=None)[0]
    poles = np.roots([1.0, *theta[:2]]).astype(complex)
    rate = np.log(poles[0]) * RATE_HZ
    scales = [run.conditions.channels[name].lsb for name in CHANNELS[:2]]
    gain = theta[2:5].sum() / (1.0 + theta[:2].sum()) * scales[1] / scales[0]
    return Oscillation(abs(rate) / (2.0 * np.pi), -rate.real / abs(rate), gain)


def _estimated(run: Run) -> Iterator[Figure]:
    """Estimate of the device least-squares against that of the batch."""
    played, expected = play(run, "least-squares"), batch(run)
    found = mode_of(played, played.theta[-1])
    assert found is not None
    row = f"device least-squares, first {ESTIMATED_N:,} samples"
    yield Figure(f"{row}: resonance", found.resonance_hz, "Hz", f"batch {expected.resonance_hz:.3f} Hz")
    yield Figure(f"{row}: damping", found.damping, "", f"batch {expected.damping:.5f}")
