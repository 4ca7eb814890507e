"""``analogrig import``: measured data of other tools becomes a recording."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli import (
    FILE,
    PASSED,
    PROGRAM,
    RIG_NAMES,
    SCENARIO,
    add_command,
    add_json,
    add_rig,
    files_read,
    show,
    show_result,
    show_work,
    trust_of,
)

if TYPE_CHECKING:
    from analogrig import Program, Run, Scenario
    from analogrig_imports.imported import ImportDescription

_SIDES = ("input", "output")


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "import",
        "make a recording of measured data: CSV, LabVIEW, NumPy, MATLAB, MF4, Parquet or WAV",
        "import SNLS80mV.csv --input V1 --output V2 --rate 610.3515625 --out build/silverbox.npz",
        "import bench.mat --map bench.toml --scenario mine.toml --out build/bench.npz",
        "import build/signals.csv --scenario thesis --out build/again.npz",
        "import build/pendulum.csv --program pendulum --out build/pendulum.npz",
    )
    command.add_argument(
        "file", type=Path, metavar=FILE, help=".csv, .tsv, .txt, .dat, .lvm, .npy, .npz, .mat, .mf4, .parquet or .wav"
    )
    command.add_argument("--out", type=Path, required=True, metavar="FILE.npz", help="file of the recording")
    command.add_argument("--map", type=Path, metavar="FILE.toml", help="the settings below as a file")
    for side in _SIDES:
        command.add_argument(f"--{side}", metavar="COLUMN", help=f"column of the plant's {side}")
        command.add_argument(f"--{side}-unit", metavar="UNIT", help="its unit (default: that of the header, or V)")
        command.add_argument(f"--{side}-scale", type=float, metavar="X", help="units per number in it (default: 1)")
        command.add_argument(
            f"--{side}-range",
            nargs=2,
            type=float,
            metavar=("LOW", "HIGH"),
            help="range of its converter in units (default: one that holds all values)",
        )
        command.add_argument(
            f"--{side}-noise", type=float, metavar="X", help="its noise, rms in units (default: unknown)"
        )
    command.add_argument("--rate", type=float, metavar="HZ", help="sample rate (default: that of the file)")
    command.add_argument("--time", metavar="COLUMN", help="column of the instants, instead of --rate")
    command.add_argument("--time-unit", metavar="UNIT", help="its unit (default: that of the header, or s)")
    command.add_argument(
        "--clock",
        choices=("plant", "machine"),
        help="clock of --rate and --time: that of the plant, or of a machine that plays it faster; needed with a"
        " scenario or program whose speed is not 1",
    )
    command.add_argument("--bits", type=int, metavar="N", help="bits of the converter (default: 16)")
    command.add_argument("--first", type=int, metavar="N", help="first row (default: 0)")
    command.add_argument("--samples", type=int, metavar="N", help="number of rows (default: all)")
    command.add_argument("--skip-lines", type=int, metavar="N", help="lines of text before the header (default: 0)")
    command.add_argument(
        "--scenario", metavar=SCENARIO, help="scenario with the truth: shipped name or .toml file (default: unknown)"
    )
    command.add_argument(
        "--program",
        metavar=PROGRAM,
        help="program whose input and output the columns are: shipped name or .toml file (default: the scenario's, or"
        " front)",
    )
    add_rig(
        command,
        f"rig of a file of analogrig emulate: {RIG_NAMES} (default: $ANALOGRIG_RIG, that of the scenario, or emulator)",
        None,
    )
    add_json(command)
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig import ConfigurationError, Program, Scenario
    from analogrig.identity import Identity
    from analogrig.output import move_aside

    if arguments.out.suffix != ".npz":
        raise ConfigurationError(f"--out {arguments.out}: the file's name must end with .npz")
    move_aside(arguments.out, (*files_read(arguments), *([arguments.map] if arguments.map else [])))
    scenario = None if arguments.scenario is None else Scenario.load(arguments.scenario)
    program = None if arguments.program is None else Program.load(arguments.program)
    if scenario is not None and program is not None:
        scenario = scenario.on_program(program)
    with show_work("reading"):
        run = _import(arguments, scenario, program)
        run = run.with_identity(Identity.here(arguments.command_line, arguments.started))
        run.save(arguments.out)
    table = _as_json(run, arguments)
    if arguments.json:
        show_result(table, arguments)
    else:
        show("\n".join(_lines(run, arguments)))
    return PASSED


def _import(arguments: argparse.Namespace, scenario: Scenario | None, program: Program | None) -> Run:
    from analogrig import RecordingError, Scenario, open_rig
    from analogrig.cli import DEFAULT_SCENARIO
    from analogrig.rigs import DEFAULT_RIG
    from analogrig_imports.columns import read_columns
    from analogrig_imports.imported import import_columns, import_signals, is_emulated

    table = _table(arguments)
    if not table:
        names = read_columns(arguments.file).names
        if not is_emulated(arguments.file, names):
            shown = ", ".join(name[:40] for name in names[:20]) + (", ..." if len(names) > 20 else "") or "none"
            raise RecordingError(f"{arguments.file}: name the columns with --input and --output: there are {shown}")
        usual = Scenario.load(DEFAULT_SCENARIO) if program is None else Scenario.of_program(program)
        rig_name = arguments.rig or (scenario.rig if scenario else "") or DEFAULT_RIG
        with open_rig(rig_name, allow=trust_of(arguments)) as rig:
            return import_signals(arguments.file, rig, scenario, scenario or usual)
    return import_columns(arguments.file, _described(table, arguments), scenario, program)


def _table(arguments: argparse.Namespace) -> dict[str, Any]:
    """Settings of --map, with those of the command line in their place."""
    from analogrig.config import read_toml

    table = read_toml(arguments.map) if arguments.map else {}
    given = {"rate_hz": arguments.rate} | {
        name: getattr(arguments, name)
        for name in ("time", "time_unit", "clock", "bits", "first", "samples", "skip_lines")
    }
    table |= {name: value for name, value in given.items() if value is not None}
    for side in _SIDES:
        names = {"column": side, **{name: f"{side}_{name}" for name in ("unit", "scale", "range", "noise")}}
        found = {key: value for key, name in names.items() if (value := getattr(arguments, name)) is not None}
        if found:
            own = table.get(side, {})
            table[side] = (own if isinstance(own, dict) else {}) | found
    return table


def _described(table: dict[str, Any], arguments: argparse.Namespace) -> ImportDescription:
    from analogrig import ConfigurationError
    from analogrig.config import build
    from analogrig_imports.imported import ImportDescription

    where = str(arguments.map) if arguments.map else "the command line"
    for side in _SIDES:
        if side not in table:
            raise ConfigurationError(f"{where}: the column of the {side} is not named: pass --{side} COLUMN")
    return build(ImportDescription, table, where)


def _as_json(run: Run, arguments: argparse.Namespace) -> dict[str, Any]:
    conditions = run.conditions
    return {
        "file": str(arguments.out),
        "samples": run.samples,
        "missing": int(run.missing.sum()),
        "rate_hz": 1.0 / conditions.sample_period_s,
        "plant_rate_hz": 1.0 / conditions.sample_period_problem_s,
        "channels": {name: vars(channel) for name, channel in conditions.channels.items()},
        "truth": bool(conditions.segments),
        "caveats": _caveats(run),
    }


def _caveats(run: Run) -> list[str]:
    """Reasons to doubt a recording, one line each."""
    import numpy as np

    from analogrig.wording import number_of
    from analogrig_imports.column_names import known_unit

    names, rig = run.conditions.program.channels, run.conditions.rig
    lines = [
        f"caveat: {name.replace('_', ' ')} is constant: no plant can be identified"
        for name in run.conditions.program.measured
        if np.ptp(run.codes[~run.clipped[:, names.index(name)], names.index(name)]) == 0
    ]
    for side, header in zip(_SIDES, rig.get("header_units", ()), strict=False):
        column, unit, scale = (rig[side][key] for key in ("column", "unit", "scale"))
        known = known_unit(header)
        if scale == 1.0 and header and (known is None or known.text != unit):
            lines.append(
                f"caveat: column {column}, in {header}, is imported in {unit}: pass --{side}-unit, and --{side}-scale"
                " to convert"
            )
    for side, beyond_n in zip(_SIDES, rig.get("beyond_range_n", ()), strict=False):
        if beyond_n:
            column, unit, (low, high) = (rig[side][key] for key in ("column", "unit", "range"))
            lines.append(
                f"caveat: {number_of(beyond_n, 'sample')} of column {column} at or beyond the ends of its range,"
                f" {low:g} to {high:g} {unit}: missing"
            )
    lines += _caveats_of_time(rig)
    scenario, first = run.conditions.scenario, rig.get("first", 0)
    if run.conditions.segments and run.samples < run.conditions.samples_asked:
        lines.append(
            f"caveat: {run.samples} of the {run.conditions.samples_asked} samples of scenario {scenario['name']}:"
            " a replay is INCONCLUSIVE; import all, or set samples in the scenario"
        )
    if run.conditions.segments and first:
        lines.append(
            f"caveat: the samples of scenario {scenario['name']} count from row {first}: a change at sample 0 is in"
            " that row"
        )
    if len(run.conditions.segments) > 1 and not run.conditions.output.noise_lsb:
        lines.append("caveat: no noise of the output is stated: bounds count quantisation alone; pass --output-noise")
    if blank := rig.get("blank_lines"):
        lines.append(f"caveat: {number_of(blank, 'blank line')} between rows skipped: check that no sample is missing")
    return lines


def _caveats_of_time(rig: Mapping[str, Any]) -> list[str]:
    from analogrig.wording import number_of

    lines = []
    if rig.get("time") and not rig.get("time_unit") and not rig.get("time_header"):
        lines.append(f"caveat: column {rig['time']} states no unit: read as seconds; pass --time-unit for another")
    if gaps_n := rig.get("gaps_n"):
        lines.append(f"caveat: {number_of(gaps_n, 'row is', 'rows are')} missing on the grid of column {rig['time']}")
    if stated_hz := rig.get("stated_rate_hz"):
        lines.append(f"caveat: the file states {stated_hz:g} Hz, another rate than the one given")
    return lines


def _lines(run: Run, arguments: argparse.Namespace) -> list[str]:
    conditions = run.conditions
    rate = f"{1.0 / conditions.sample_period_s:.6g} Hz"
    if conditions.time_scale != 1.0:
        rate += f" of the machine, {1.0 / conditions.sample_period_problem_s:.6g} Hz of the plant"
    lines = [f"{arguments.out}: {run.samples} samples at {rate}, {int(run.missing.sum())} of them missing"]
    described = [conditions.rig[side] for side in _SIDES if side in conditions.rig]
    units = {name: each["unit"] for name, each in zip(conditions.program.measured, described, strict=False)}
    unstated = [
        name
        for name, header in zip(conditions.program.measured, conditions.rig.get("assumed", ()), strict=False)
        if header
    ]
    for name, channel in conditions.channels.items():
        high = channel.low_v + channel.codes * channel.lsb_v
        low, high = (volts * channel.unit_per_v for volts in (channel.low_v, high))
        converted = "" if units.get(name, channel.unit) == channel.unit else f", converted from {units[name]}"
        assumed = ", as no unit is stated" if name in unstated else ""
        span = f"{channel.codes} codes from {low:.5g} to {high:.5g} {channel.unit}{assumed}"
        lines.append(f"{name.replace('_', ' ')}: {span}{converted}")
    known = f"that of scenario {conditions.played.name}" if conditions.segments else "unknown: UNJUDGED"
    return [*lines, *_caveats(run), f"truth: {known}", f"next: analogrig replay {arguments.out} --dut inproc"]
