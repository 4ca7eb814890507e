"""Signals and SPICE deck of a rig, without a device."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Rig, Scenario
from analogrig.bench import Progress
from analogrig.output import replace_file
from analogrig.rigs import Block, SetUp, is_emulated
from analogrig_emulator import SOURCE, TICKS_PER_SAMPLE, Deck, Excitation, PotTurn


def write_signals(
    rig: Rig, scenario: Scenario, seed: int, path: Path, progress: Progress | None = None
) -> dict[str, Any]:
    """Play ``scenario`` on ``rig`` and write volts, codes and clipping flags, one row a sample, as .csv or .npz.

    The last two columns hold the time of a sample: ``machine_s``, and ``plant_s``, in which the plant's equations hold.

    :returns: ``samples``; ``clipped``, the number of samples with any channel clipped; ``overloads``, the first sample
        with a lit overload lamp by amplifier.
    :raises ConfigurationError: the suffix of ``path`` is neither .csv nor .npz.
    :raises RecordingError: the file cannot be written.
    """
    if path.suffix not in (".csv", ".npz"):
        raise ConfigurationError(f"{path}: the file's name must end with .csv or .npz")
    blocks: list[Block] = []
    performance = rig.perform(scenario, seed)
    for block in performance.blocks:
        blocks.append(block)
        if progress is not None:
            progress(block.first + len(block.codes), scenario.samples)
    volts, codes, clipped = (
        np.concatenate([getattr(block, name) for block in blocks]) for name in ("volts", "codes", "clipped")
    )
    periods_s = performance.sample_period_s * np.array([1.0, performance.time_scale])
    times = np.arange(len(codes))[:, None] * periods_s
    with replace_file(path) as file:
        if path.suffix == ".csv":
            _write_csv(scenario.program.channels, times, volts, codes, clipped, file)
        else:
            np.savez(
                file,
                channels=np.array(scenario.program.channels),
                volts=volts,
                codes=codes,
                clipped=clipped,
                machine_s=times[:, 0],
                plant_s=times[:, 1],
            )
    overloads = dict(performance.hindsight().lamps)
    return {"samples": len(codes), "clipped": int(clipped.any(axis=1).sum()), "overloads": overloads}


def _write_csv(
    channels: Sequence[str],
    times: NDArray[Any],
    volts: NDArray[Any],
    codes: NDArray[Any],
    clipped: NDArray[Any],
    file: BinaryIO,
) -> None:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = [f"{channel}_{kind}" for kind in ("v", "code", "clipped") for channel in channels]
    writer.writerow(["sample", *names, "machine_s", "plant_s"])
    rows = zip(volts.tolist(), codes.tolist(), clipped.astype(int).tolist(), times.tolist(), strict=True)
    for index, row in enumerate(rows):
        writer.writerow([index, *(f"{v:.6f}" for v in row[0]), *row[1], *row[2], *(f"{t:.9g}" for t in row[3])])
    file.write(out.getvalue().encode("ascii"))


def netlist(rig: Rig, scenario: Scenario, seed: int) -> Deck:
    """SPICE deck of a scenario: circuit with the components drawn from ``seed``, excitation and pot changes.

    :raises ConfigurationError: the scenario cannot be played on this rig, or the rig is not emulated.
    """
    if not is_emulated(rig):
        raise ConfigurationError(f"{rig.description()['name']}: only an emulated rig has a netlist")
    setup = rig.set_up(scenario, seed)
    rate_hz = setup.computer.sample_rate_hz
    return Deck(
        setup.computer.circuit,
        samples=scenario.samples,
        sample_rate_hz=rate_hz,
        **_excitation(setup.excitation, scenario.samples, rate_hz),
        turns=_dial_changes(setup, scenario.samples),
        title=f"scenario {scenario.name} on rig {rig.description()['name']}, seed {seed}",
    )


def _excitation(excitation: Excitation, samples: int, rate_hz: float) -> dict[str, Any]:
    """Field of a deck that excites it."""
    window = (0, (samples - 1) * TICKS_PER_SAMPLE + 1, rate_hz)
    if excitation.is_smooth:
        return {"drives": {SOURCE: excitation.drive(*window)}}
    return {"edges": {SOURCE: excitation.edges(*window)}}


def _dial_changes(setup: SetUp, samples: int) -> list[PotTurn]:
    """Dials after each sample at which one moves. A ramp becomes one step a sample, to the middle of its period."""
    dials = setup.computer.dials
    turns: list[PotTurn] = []
    for sample, goals, ramp_n in setup.computer.plan(setup.changes, samples):
        for k in range(min(ramp_n, samples - sample)):
            part = (k + 0.5) / ramp_n
            between = {pot: dials[pot] + part * (goal - dials[pot]) for pot, goal in goals.items()}
            turns.append(PotTurn(sample + k, setup.computer.machine.resting(between)))
        if sample + ramp_n < samples:
            turns.append(PotTurn(sample + ramp_n, goals))
        dials |= goals
    return turns
