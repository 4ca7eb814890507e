"""Import of measured data as a recording: columns of a file become codes of the two measured channels."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Program, RecordingError, Run, Scenario
from analogrig.config import plain
from analogrig.plant import MAX_SAMPLES, Segment
from analogrig.recordings import scaled_to_program, unanswered
from analogrig.run import IMPORTED, Channel
from analogrig.scenario import DEFAULT_PROGRAM
from analogrig.wording import number_of
from analogrig_emulator import Excitation, parse_unit
from analogrig_imports.column_names import MOST_UNIT, is_time, known_unit
from analogrig_imports.columns import ColumnFile, read_columns

if TYPE_CHECKING:
    from analogrig import Rig


LEAST_BITS, MOST_BITS = 2, 16

_LEAST_WIDTH, _MOST_MAGNITUDE = 1e-7, 1e8
"""Limits of a converter's range, which a run can hold."""

_MOST_RATE_ERROR = 0.01
"""Relative difference of the given rate from the one that a file states, which may be rounded."""

_MOST_JITTER = 0.02
"""Largest deviation of a time from the even grid, in sample periods."""

_MOST_GAPS = 0.5
"""Largest share of the grid without a row."""


@dataclass(frozen=True)
class ImportedColumn:
    """One column of a file: values in ``unit`` are column * scale + offset. ValueError: a number is out of range."""

    column: str
    unit: str | None = None
    """None: the one in the header of an unscaled column; V without one."""
    scale: float = 1.0
    offset: float = 0.0
    range: tuple[float, float] | None = None
    """Ends of the converter's range in ``unit``, beyond which a sample is clipped.

    None: the range is symmetrical and holds all values.
    """
    noise: float = 0.0
    """Noise of the values before quantisation, rms in ``unit``; 0: unknown."""

    def __post_init__(self) -> None:
        if not self.column:
            raise ValueError("column must not be empty")
        if self.unit is not None and not (0 < len(self.unit) <= MOST_UNIT and self.unit.isprintable()):
            raise ValueError(f"unit must be 1 to {MOST_UNIT} printable characters, not {self.unit[:40]!r}")
        if not 1e-9 < abs(self.scale) < 1e9:
            raise ValueError(f"scale must have a magnitude between 1e-9 and 1e9, not {self.scale:g}")
        if self.range is not None and not self.range[0] < self.range[1]:
            raise ValueError(f"range must ascend, not [{self.range[0]:g}, {self.range[1]:g}]")
        if not 0.0 <= self.noise < _MOST_MAGNITUDE:
            raise ValueError(f"noise must be 0 to {_MOST_MAGNITUDE:g}, not {self.noise:g}")


@dataclass(frozen=True)
class ImportDescription:
    """Meaning of the columns of a file, from the command line or a .toml file. ValueError: a value is out of range."""

    input: ImportedColumn
    output: ImportedColumn
    rate_hz: float | None = None
    """Sample rate; None: that of ``time``, or the one that the file states."""
    time: str = ""
    """Column of the sample instants, on an even grid, on which rows may be missing."""
    time_unit: str = ""
    """Unit of the instants; empty: that of the header, or s."""
    clock: Literal["plant", "machine"] | None = None
    """Clock of the rate and the instants: the plant's, or that of a machine that plays a program at its speed.

    None: not stated; only a program with speed 1 can then be compared with the data.
    """
    bits: int = MOST_BITS
    """Resolution of the converter."""
    first: int = 0
    """First row of the recording."""
    samples: int | None = None
    """Number of rows; None: all from ``first`` on."""
    skip_lines: int = 0
    """Lines of a text file before its header or first row."""
    description: str = ""

    def __post_init__(self) -> None:
        if self.time_unit and _seconds(self.time_unit) is None:
            raise ValueError(f"time_unit must be a unit of time, such as ms, not {self.time_unit[:40]!r}")
        if self.input.column == self.output.column:
            raise ValueError(f"input and output are the same column, {self.input.column[:40]}: name two")
        if self.rate_hz is not None and not 1e-6 <= self.rate_hz <= 1e9:
            raise ValueError(f"rate_hz must be 1e-6 to 1e9, not {self.rate_hz:g}")
        if self.rate_hz is not None and self.time:
            raise ValueError("rate_hz and time state the rate twice: give one of them")
        if not LEAST_BITS <= self.bits <= MOST_BITS:
            raise ValueError(f"bits must be {LEAST_BITS} to {MOST_BITS}, not {self.bits}")
        if self.first < 0 or self.skip_lines < 0:
            raise ValueError("first and skip_lines must not be negative")
        if self.samples is not None and not 1 <= self.samples <= MAX_SAMPLES:
            raise ValueError(f"samples must be 1 to {MAX_SAMPLES}, not {self.samples}")

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns to read, each once."""
        return tuple(dict.fromkeys(name for name in (self.input.column, self.output.column, self.time) if name))


def _seconds(unit: str) -> float | None:
    """Seconds of one unit of time; None if it is none."""
    return None if (known := known_unit(unit)) is None else known.factor_to(parse_unit("s"))


def _in_unit(described: ImportedColumn, header: str) -> ImportedColumn:
    """Column with the unit of its header, unless the description states unit or scale."""
    unit = described.unit
    if unit is None:
        known = known_unit(header) if described.scale == 1.0 else None
        unit = "V" if known is None else known.text
    return dataclasses.replace(described, unit=unit)


def is_emulated(path: Path, names: tuple[str, ...]) -> bool:
    """True if a file with columns of these names was written by ``analogrig emulate``."""
    if path.suffix == ".npz":
        return {"codes[0]", "codes[1]", "clipped[0]", "volts[0]"} <= set(names)
    channels = [name.removesuffix("_code") for name in names if name.endswith("_code")]
    return len(channels) > 1 and {f"{name}_clipped" for name in channels} <= set(names)


def import_columns(
    path: Path, described: ImportDescription, scenario: Scenario | None, program: Program | None = None
) -> Run:
    """Recording of two columns of a file, which no device has seen.

    :param scenario: the truth about plant and changes; None: unknown.
    :param program: whose input and output the columns are, without a scenario; None: unknown.
    :raises RecordingError: the file cannot be read, or its columns give no samples.
    :raises ConfigurationError: the recording is longer than the scenario, or in other units than its program.
    """
    found = read_columns(path, described.columns, described.skip_lines)
    headers = [found.units.get(each.column, "") for each in (described.input, described.output)]
    assumed = [
        each.unit is None and not header
        for each, header in zip((described.input, described.output), headers, strict=True)
    ]
    described = dataclasses.replace(
        described, input=_in_unit(described.input, headers[0]), output=_in_unit(described.output, headers[1])
    )
    rows = slice(described.first, None if described.samples is None else described.first + described.samples)
    columns = {name: values[rows] for name, values in found.columns.items()}
    count = {len(values) for values in columns.values()}
    if len(count) > 1:
        lengths = ", ".join(f"{name} {len(values)}" for name, values in columns.items())
        raise RecordingError(f"{path}: the columns differ in length: {lengths}")
    if not (samples := (count_n := count.pop())):
        raise RecordingError(f"{path}: has no row {described.first}")
    if samples == 1:
        raise RecordingError(f"{path}: has a single row: a recording needs two")
    if described.samples is not None and samples < described.samples:
        raise RecordingError(f"{path}: has {samples} rows from row {described.first} on, not {described.samples}")
    if len(columns[described.input.column]) and all(
        np.unique(columns[each.column][np.isfinite(columns[each.column])]).size == 1
        for each in (described.input, described.output)
    ):
        raise RecordingError(
            f"{path}: columns {described.input.column} and {described.output.column} are constant, which is no data:"
            f" {_others(found, described)}"
        )
    rate_hz, at = _grid(path, described, columns, found)
    if at is not None:
        samples = int(at[-1]) + 1
        columns = {name: _spread(values, at) for name, values in columns.items()}
    is_known = scenario is not None or program is not None
    program = scenario.program if scenario else program or Program.load(DEFAULT_PROGRAM)
    shape, channels = (samples, len(program.channels)), {}
    codes, clipped = np.zeros(shape, np.uint16), np.ones(shape, np.bool_)
    beyond_n = []
    for column, (name, each) in enumerate(zip(program.measured, (described.input, described.output), strict=True)):
        values = columns[each.column] * each.scale + each.offset
        channels[name] = _channel(path, each, described.bits, values)
        codes[:, column], clipped[:, column] = _converted(values, channels[name], is_ranged=each.range is not None)
        if clipped[:, column].all():
            raise RecordingError(f"{path}: column {each.column}: no value lies within its range: give a wider range")
        beyond_n.append(int((clipped[:, column] & np.isfinite(values)).sum()))
    rig = {"name": f"{IMPORTED}:{path.name}", "kind": IMPORTED, "file": str(path), **dataclasses.asdict(described)}
    rig |= {"blank_lines": found.blank_lines, "header_units": headers, "beyond_range_n": beyond_n}
    rig |= {"time_header": found.units.get(described.time, ""), "gaps_n": samples - count_n, "assumed": assumed}
    if found.rate_hz is not None and abs(rate_hz / found.rate_hz - 1.0) > _MOST_RATE_ERROR:
        rig["stated_rate_hz"] = found.rate_hz
    truth = _truth(path, samples, 1.0 / rate_hz, scenario, program)
    run = unanswered(codes, clipped, channels, 1.0 / rate_hz, 1.0, plain(rig), *truth)
    return dataclasses.replace(run, conditions=scaled_to_program(run.conditions)) if is_known else run


def import_signals(path: Path, rig: Rig, scenario: Scenario | None, played: Scenario) -> Run:
    """Recording of a file of ``analogrig emulate``, with the units and the rate of ``rig``; errors as import_columns.

    :param played: scenario whose units the rig states.
    """
    names, there = played.program.channels, read_columns(path)
    if path.suffix == ".npz":
        wanted = [f"{kind}[{i}]" for kind in ("codes", "clipped") for i in range(len(names))]
    else:
        wanted = [f"{name}_{kind}" for kind in ("code", "clipped") for name in names]
    channels = there.channels or tuple(name.removesuffix("_code") for name in there.names if name.endswith("_code"))
    if channels != names:
        raise RecordingError(
            f"{path}: has the channels {', '.join(channels)[:200]}, program {played.program.name} {', '.join(names)}:"
            " pass the scenario that was played with --scenario, or its program with --program"
        )
    found = read_columns(path, wanted)
    values = np.stack([found.columns[name] for name in wanted], axis=1)
    performance = rig.perform(played, 0)
    codes, clipped = values[:, : len(names)], values[:, len(names) :]
    most = [performance.channels[name].codes if name in performance.channels else 1 for name in names]
    if not (np.isfinite(values).all() and (codes == np.rint(codes)).all() and (codes >= 0).all()):
        raise RecordingError(f"{path}: its codes are no whole numbers")
    if not (codes < most).all():
        raise RecordingError(f"{path}: has codes that rig {rig.description()['name']} does not have: name its rig")
    if not np.isin(clipped, (0.0, 1.0)).all():
        raise RecordingError(f"{path}: a flag of a clipped sample is neither 0 nor 1")
    for name in played.program.measured:
        if clipped[:, names.index(name)].all():
            raise RecordingError(f"{path}: every sample of {name} is clipped")
    description: dict[str, Any] = {"name": f"{IMPORTED}:{path.name}", "kind": IMPORTED, "file": str(path)}
    description["rig"] = dict(rig.description())
    return unanswered(
        codes.astype(np.uint16),
        clipped.astype(np.bool_),
        performance.channels,
        performance.sample_period_s,
        performance.time_scale,
        description,
        *_truth(path, len(codes), performance.sample_period_s, scenario, played.program),
    )


def _channel(path: Path, described: ImportedColumn, bits: int, values: NDArray[np.float64]) -> Channel:
    """Scale of a converter with these values.

    :raises RecordingError: they have no range.
    """
    codes, where = 1 << bits, f"{path}: column {described.column}"
    if described.range is not None:
        low, high = described.range
    else:
        finite = np.abs(values[np.isfinite(values)])
        if not finite.size:
            raise RecordingError(f"{where}: holds no number")
        high = float(finite.max()) / (1.0 - 2.0 / codes)  # the last code stands for the largest value
        low = -high
    most = max(abs(low), abs(high))
    if not (high - low > _LEAST_WIDTH and most < _MOST_MAGNITUDE):
        what = f"largest magnitude {most:g}" if described.range is None else f"range [{low:g}, {high:g}]"
        raise RecordingError(
            f"{where}: {what}: a range must be wider than {_LEAST_WIDTH:g} and within +-{_MOST_MAGNITUDE:g}; scale it"
        )
    lsb = (high - low) / codes
    if not (noise_lsb := described.noise / lsb) < _MOST_MAGNITUDE:
        raise RecordingError(f"{where}: noise {described.noise:g} is far larger than its values: state it in the unit")
    return Channel(low, lsb, described.unit or "V", 1.0, noise_lsb, codes)


def _converted(
    values: NDArray[np.float64], channel: Channel, *, is_ranged: bool
) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Codes and clipping of values. With a known range an end code says only that the value was beyond it.

    Without a number the code before is repeated, as clipped.
    """
    finite = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        at = np.rint((values - channel.low_v) / channel.lsb_v)
        last = channel.codes - 1
        beyond = ~finite | (at < 0) | (at > last) | (is_ranged & ((at == 0) | (at == last)))
        codes = np.clip(np.where(finite, at, 0.0), 0, last).astype(np.uint16)
    before = np.maximum.accumulate(np.where(finite, np.arange(len(values)), -1))
    held = np.where(before < 0, last // 2, codes[before])
    return np.where(finite, codes, np.clip(held, 1, last - 1)).astype(np.uint16), beyond


def _others(found: ColumnFile, described: ImportDescription) -> str:
    """Cure by the names of the other columns, if there are any."""
    names = [name[:40] for name in found.names if name not in described.columns][:20]
    return f"name others: there are {', '.join(names)}" if names else "record the plant in motion"


def _spread(values: NDArray[np.float64], at: NDArray[np.int64]) -> NDArray[np.float64]:
    """Values at these places of the grid, and no numbers elsewhere."""
    spread = np.full(int(at[-1]) + 1, np.nan)
    spread[at] = values
    return spread


def _grid(
    path: Path, described: ImportDescription, columns: Mapping[str, NDArray[np.float64]], found: ColumnFile
) -> tuple[float, NDArray[np.int64] | None]:
    """Sample rate [Hz], and the places of the rows on the grid; None: none is missing.

    :raises RecordingError: no rate is known, or the samples are on no even grid.
    """
    if described.rate_hz is not None:
        return described.rate_hz, None
    if not described.time:
        if found.rate_hz is None:
            times = [name for name in found.names if is_time(name)]
            such = f", such as --time {shlex.quote(times[0])}" if times else ""
            raise RecordingError(f"{path}: states no sample rate: pass --rate HZ, or --time COLUMN{such}")
        return found.rate_hz, None
    where = f"{path}: column {described.time}"
    unit = described.time_unit or found.units.get(described.time) or "s"
    in_s = _seconds(unit)
    if in_s is None:
        raise RecordingError(f"{where}: must be a time, not in {unit}: pass --time-unit, or --rate HZ")
    instants_s = columns[described.time] * in_s
    if len(instants_s) < 2 or not np.isfinite(instants_s).all():
        raise RecordingError(f"{where}: instants are missing")
    steps_s = np.diff(instants_s)
    if not (steps_s > 0.0).all():
        row = int((steps_s <= 0.0).argmax()) + 1
        raise RecordingError(
            f"{where}: row {described.first + row} is no later than the one before: instants must ascend; pass --rate"
            " HZ if the rows are evenly spaced"
        )
    at = np.arange(len(instants_s))
    period_s, late = _fitted(instants_s, at)
    if np.abs(late).max() > _MOST_JITTER:
        gapped = np.concatenate([[0], np.cumsum(np.rint(steps_s / np.median(steps_s)).astype(np.int64))])
        gapped_s, gapped_late = _fitted(instants_s, gapped)
        is_on_grid = np.abs(gapped_late).max() <= _MOST_JITTER and (np.diff(gapped) > 0).all()
        if not is_on_grid or len(gapped) < _MOST_GAPS * (gapped[-1] + 1) or gapped[-1] >= MAX_SAMPLES:
            worst = int(np.abs(late).argmax())
            raise RecordingError(
                f"{where}: row {described.first + worst} is {abs(late[worst]):.2g} sample periods off an even grid:"
                " resample the data, or pass --rate HZ"
            )
        at, period_s = gapped, gapped_s
    if not 1e-9 <= period_s <= 1e6:
        raise RecordingError(f"{where}: a sample period of {period_s:g} s: must be seconds, or pass --time-unit")
    return 1.0 / period_s, at if at[-1] >= len(at) else None


def _fitted(instants_s: NDArray[np.float64], at: NDArray[np.int64]) -> tuple[float, NDArray[np.float64]]:
    """Sample period [s] of rows at these places of a grid, (n,), and by how many periods each is late, (n,)."""
    period_s = float(instants_s[-1] - instants_s[0]) / max(int(at[-1]), 1)
    return period_s, (instants_s - instants_s[0] - period_s * at) / period_s


def _truth(
    path: Path, samples: int, period_s: float, scenario: Scenario | None, program: Program
) -> tuple[Scenario, tuple[Segment, ...]]:
    """Scenario and plant of a recording; without a scenario they are unknown.

    :raises ConfigurationError: the recording is longer than the scenario.
    """
    if scenario is None:
        return _unknown(path, samples, period_s, program), ()
    if samples > scenario.samples:
        raise ConfigurationError(
            f"{path}: has {number_of(samples, 'sample')}, scenario {scenario.name} {scenario.samples}:"
            " pass the scenario that was played"
        )
    return scenario, scenario.segments()


def _unknown(path: Path, samples: int, period_s: float, program: Program) -> Scenario:
    """Scenario of samples of which nothing is known: a generator that never switches, and no change."""
    still = Excitation(low_v=0.0, high_v=0.0, frequency_hz=min(max(0.1 / period_s, 1e-6), 1e12))
    text = "measured data, plant unknown"
    return Scenario(samples=samples, program=program, excitation=still, name=path.stem, description=text)
