"""Silverbox: a measured electronic mass, damper and cubic spring, as samples for the device.

The record is that of Wigren and Schoukens, "Three free data sets for development and benchmarking in nonlinear system
identification", ECC 2013; it is not part of the repository. FOLDER_SETTING names the folder of its file.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from analogrig.run import Run
from analogrig_imports.imported import ImportDescription, ImportedColumn, import_columns
from tests import tools

from .figure import Figure
from .played import Array, Played
from .shipped import answers_to, reported_misfits, shipped

FOLDER_SETTING, FILE = tools.SILVERBOX_SETTING, tools.SILVERBOX_NAME

ROW = "silverbox"

RATE_HZ = 10e6 / 2**14

RANGES_V = (0.2, 0.35)
"""Largest input and output of the 12-bit card that samples the record."""

CODES = 4096

RESONANCE_HZ, DAMPING = 68.35, 0.0488
"""Resonance and damping ratio of the linear part, from a fit of the multisines."""

LINEAR_END, GROWTH_END = 10_000, 40_000
"""Ends of the part that a linear model describes, and of that in which the amplitude grows in proportion to time."""

PARTS = ((0, LINEAR_END, 0), (LINEAR_END, 20_000, 1), (20_000, GROWTH_END, 1))
"""Parts of the record, (start, end), and the largest number of alarms: one for each doubling of the amplitude."""

SPLICES, FIRST_SPLICE, HORIZON_N = 20, 2_500, 300
"""Number of instants of each change, the first one, and the samples after a change in which it must be seen."""

MORE_SPLICES, FIRST_OF_MORE = 120, 2_000
"""Number of other instants of each change, and the first one. The changes missed there are stated, not required."""

FACTORS = (1.2, 0.8)

AT_REST = np.zeros(2)


def find_file() -> Path:
    """File of the record.

    :raises FileNotFoundError: it is absent; the message names the setting.
    """
    path = tools.silverbox_file()
    if not path.is_file():
        raise FileNotFoundError(f"{path} is absent: set {FOLDER_SETTING} to the folder of {FILE}")
    return path


def import_record(samples: int | None = None) -> Run:
    """Record as ``analogrig import`` makes it, or its first samples; errors as find_file."""
    described = ImportDescription(ImportedColumn("V1"), ImportedColumn("V2"), RATE_HZ, samples=samples)
    return import_columns(find_file(), described, None)


@dataclass(frozen=True, eq=False)
class Record:
    """Volts of input and output, (n,) each."""

    input_v: Array
    output_v: Array

    @classmethod
    def load(cls) -> Self:
        """:raises FileNotFoundError: the folder lacks the file; the message names the setting."""
        input_v, output_v = np.loadtxt(find_file(), delimiter=",", skiprows=1, usecols=(0, 1)).T
        return cls(input_v, output_v)

    def played(self, end: int | None = None) -> Played:
        """Codes up to a sample."""
        u, y = (
            np.clip(np.rint((volts[:end] / most_v + 1.0) * CODES / 2), 0, CODES - 1)
            for volts, most_v in zip((self.input_v, self.output_v), RANGES_V, strict=True)
        )
        return Played(u, y, np.ones(len(u), np.bool_), np.zeros(len(u)))

    @functools.cached_property
    def states(self) -> Array:
        """States of the linear part with unit static gain, (n, 2)."""
        return respond(self.input_v)

    @functools.cached_property
    def gain(self) -> float:
        """Static gain of the linear part, by least squares with an offset."""
        unit, seen_v = (each[LINEAR_END // 10 : LINEAR_END] for each in (self.states[:, 0], self.output_v))
        regressors = np.stack([unit, np.ones(len(unit))], axis=1)
        return float(np.linalg.lstsq(regressors, seen_v, rcond=None)[0][0])

    def spliced(self, onset: int, factor: float) -> Record:
        """Record up to HORIZON_N after the change of the stiffness at a sample, by its exact linear difference."""
        end = onset + HORIZON_N + 1
        output_v = self.output_v[:end].copy()
        changed = respond(self.input_v[onset:end], self.states[onset], factor)
        output_v[onset:] += self.gain * (changed - self.states[onset:end])[:, 0]
        return Record(self.input_v[:end], output_v)


def respond(input_v: Array, state: Array = AT_REST, factor: float = 1.0) -> Array:
    """States (n, 2) of the linear part with unit static gain at each sample: displacement, and velocity per second.

    The stiffness is ``factor`` times as large. The input is linear between the samples.
    """
    (xx, xv, x0, x1), (vx, vv, v0, v1) = _step(factor)
    out, (x, v) = np.empty((len(input_v), 2)), state.tolist()
    inputs = input_v.tolist()
    for k, (now, following) in enumerate(zip(inputs, [*inputs[1:], inputs[-1]], strict=True)):
        out[k] = x, v
        rise = following - now
        x, v = xx * x + xv * v + x0 * now + x1 * rise, vx * x + vv * v + v0 * now + v1 * rise
    return out


def _step(factor: float) -> list[list[float]]:
    """Rows of x and v after a sample period from x, v, the input before and its rise (first-order hold)."""
    from scipy.linalg import expm

    rate = 2.0 * math.pi * RESONANCE_HZ
    generator = np.zeros((4, 4))
    generator[0, 1] = 1.0
    generator[1, :3] = -factor * rate**2, -2.0 * DAMPING * rate, rate**2
    generator[2, 3] = RATE_HZ
    rows: list[list[float]] = expm(generator / RATE_HZ)[:2].tolist()
    return rows


def figures() -> Iterator[Figure]:
    """Alarms of the parts of the record, and changes of the stiffness that are spliced in; none without the record."""
    try:
        record = Record.load()
    except FileNotFoundError as absent:
        print(f"{ROW} is skipped: {absent}")
        return
    yield from _alarms(record)
    missed = yield from _changes(record, SPLICES, FIRST_SPLICE)
    yield Figure(f"{_spliced(SPLICES, FIRST_SPLICE)}: required", not missed, "", "missed" if missed else "")
    yield from _changes(record, MORE_SPLICES, FIRST_OF_MORE)


def _alarms(record: Record) -> Iterator[Figure]:
    device = shipped()
    answers = answers_to(device, record.played())
    alarms = np.array([alarm.index for alarm in answers.alarms], dtype=int)
    for start, end, most in (*PARTS, (GROWTH_END, len(record.input_v), 1)):
        found = int(np.count_nonzero((alarms >= start) & (alarms < end)))
        row = f"{ROW}, samples {start:,} to {end:,}"
        yield Figure(f"{row}: false alarms per 1e5", 1e5 * found / (end - start), "", f"{found} alarms")
        reasons = "" if found <= most else "rate"
        if end == GROWTH_END:
            yield _misfit(row, record.played(GROWTH_END))
        yield Figure(f"{row}: required", not reasons, "", reasons)


def _misfit(row: str, played: Played) -> Figure:
    """Figure of 1 if the device reports a non-linear plant while the amplitude grows."""
    try:
        misfits = reported_misfits(played)
    except LookupError:
        return Figure(f"{row}: MISFIT", 0.0, "of 1 run", "not reported")
    told = ", ".join(f"{each.kind} at {each.sample:,}" for each in misfits)
    return Figure(f"{row}: MISFIT", float(any(each.kind == "nonlinear" for each in misfits)), "of 1 run", told)


def _spliced(number: int, first: int) -> str:
    """Row of the changes at that number of samples, from the first one to the end of the growth."""
    return f"{ROW}, K spliced in at {number} samples from {first:,} on"


def _changes(record: Record, number: int, first: int) -> Generator[Figure, None, int]:
    """Play the changes. Return how many are missed."""
    device = shipped()
    delays_n: list[int] = []
    for onset in np.linspace(first, GROWTH_END - HORIZON_N - 1, number).astype(int).tolist():
        for factor in FACTORS:
            alarms = answers_to(device, record.spliced(onset, factor).played()).alarms
            delays_n += [alarm.index - onset for alarm in alarms if alarm.index > onset][:1]
    row, trials = _spliced(number, first), number * len(FACTORS)
    yield Figure(f"{row}: missed", trials - len(delays_n), f"of {trials}")
    if delays_n:
        yield Figure(f"{row}: median delay", float(np.median(delays_n)), "samples")
    return trials - len(delays_n)
