"""``analogrig calibrate``: the emulator becomes the twin of a rig."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli import (
    FAILED,
    FILE,
    INCONCLUSIVE,
    PASSED,
    add_command,
    add_json,
    add_rig,
    add_seed,
    complain,
    count,
    files_read,
    progress_line,
    show,
    show_result,
    trust_of,
)

if TYPE_CHECKING:
    from analogrig_instruments.calibration.fit import Calibration

MOST_LSB = 1.0
"""Largest rms difference between rig and twin, on data that the fit has not seen."""

PROGRAMS = ("front", "shock")
"""Programs for which the components of a rig are fitted; for others, the parameters of the program."""

_SHOWN_AS = {"": (100.0, "%"), "V": (1e3, "mV"), "s": (1e6, "us"), "LSB": (1.0, "LSB")}
"""Scale and unit in which an estimate is shown, by its own unit."""


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "calibrate",
        "fit the emulator to a rig's recordings, and keep it as the rig's twin",
        "calibrate --rig emulator-real --out build/twin.toml",
        "calibrate --rig bench --op-amp 741 --components polyester",
        "calibrate --rig emulator-real --program pendulum --out build/pendulum.toml",
        "calibrate --recording build/silverbox.npz --program silverbox --span 40000:130000 --check 0:40000",
    )
    add_rig(command, default=None)
    command.add_argument(
        "--out",
        type=Path,
        default=Path("build/twin.toml"),
        metavar="FILE.toml",
        help="file of the twin, for --rig (default: %(default)s)",
    )
    command.add_argument(
        "--program",
        default="front",
        metavar="PROGRAM",
        help="program of the computer, or a program file; its parameters are fitted, but with front and shock on a rig"
        " the components (default: %(default)s)",
    )
    _add_program_fit(command)
    command.add_argument(
        "--op-amp",
        choices=("tl07x", "741", "opa627", "ideal"),
        help="type of the amplifiers (default: ideal with --recording, tl07x for a rig)",
    )
    command.add_argument(
        "--components",
        choices=("nominal", "polyester", "polypropylene"),
        help="type of the capacitors (default: the type that fits best)",
    )
    command.add_argument(
        "--pots",
        choices=("coefficient", "dial"),
        help="quantity that the pots are set by (default: coefficient, unless dial fits better)",
    )
    add_seed(command)
    add_json(command)
    command.set_defaults(command=_run)


def _add_program_fit(command: argparse.ArgumentParser) -> None:
    """Add the options of a fit of a program's parameters."""
    command.add_argument(
        "--recording", type=Path, metavar=FILE, help="fit the program's parameters to this recording instead of a rig"
    )
    command.add_argument("--span", metavar="FIRST:END", help="samples of the recording to fit (default: all)")
    command.add_argument("--check", metavar="FIRST:END", help="samples of the recording to compare only")
    command.add_argument(
        "--settle", type=count, metavar="N", help="samples at the start of either that are not compared (default: 200)"
    )
    command.add_argument(
        "--fix",
        action="append",
        default=[],
        metavar="NAME[=VALUE]",
        help="parameter that is known and not fitted; repeat for more (default value: the program's)",
    )
    command.add_argument(
        "--reconstruction",
        choices=("band-limited", "held"),
        help="course of the input between the samples of the recording (default: the one that fits better)",
    )
    command.add_argument(
        "--most-rms",
        type=float,
        metavar="X",
        help="largest rms difference of a twin to keep, in the"
        " output's unit (default: half the rms of the fitted output about its mean)",
    )


def _run(arguments: argparse.Namespace) -> int:
    from analogrig import ConfigurationError, RigError, open_rig
    from analogrig.output import move_aside, replace_file
    from analogrig_instruments.calibration.averages import check_scenario, record, scenarios
    from analogrig_instruments.calibration.fit import POTS, STOCKS, calibrate, difference_lsb

    if arguments.out.suffix != ".toml":
        raise ConfigurationError(f"--out {arguments.out}: must be a .toml file, for --rig to open")
    if arguments.op_amp is None:
        arguments.op_amp = "tl07x" if arguments.recording is None else "ideal"
    if arguments.recording is not None:
        return _fit_recording(arguments)
    arguments.rig = arguments.rig or "emulator"
    if arguments.program not in PROGRAMS:
        return _fit_rig(arguments)
    _check_for_a_rig(arguments, ("span", "check", "settle", "most_rms", "fix", "reconstruction"))
    move_aside(arguments.out, files_read(arguments))
    plays, recordings = [*scenarios(arguments.program), check_scenario(arguments.program)], []
    show_progress = progress_line("recordings")
    try:
        with open_rig(arguments.rig, allow=trust_of(arguments)) as rig:
            for play in plays:
                recordings.append(record(rig, play, arguments.seed))
                if show_progress is not None:
                    show_progress(len(recordings), len(plays))
        found = calibrate(
            recordings[:-1],
            op_amp=arguments.op_amp,
            stocks=(arguments.components,) if arguments.components else STOCKS,
            pots=(arguments.pots,) if arguments.pots else POTS,
            progress=progress_line("fits"),
        )
        check_lsb = difference_lsb(recordings[-1], found.twin, found.estimate("displacement noise").value)
    except RigError as error:
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)
    is_twin = check_lsb <= MOST_LSB
    if is_twin:
        with replace_file(arguments.out) as file:
            file.write(_toml(found, arguments, check_lsb).encode("utf-8"))
    if arguments.json:
        show_result(_as_json(found, check_lsb, arguments), arguments)
    else:
        heading = f"{'':20} {'fitted':>10}    {'std error':>9}       stands for"
        kept = f"kept as {arguments.out}" if is_twin else f"no twin: more than {MOST_LSB:g} LSB; nothing kept"
        show("\n".join([heading, *_values(found), "", *_said(found, check_lsb), kept]))
    return PASSED if is_twin else FAILED


def _fit_recording(arguments: argparse.Namespace) -> int:
    """Fit the parameters of a program to a recording."""
    from analogrig import ConfigurationError

    if arguments.rig not in (None, os.environ.get("ANALOGRIG_RIG")):
        raise ConfigurationError(f"--rig {arguments.rig}: is not played with --recording; leave out one of them")
    from analogrig_instruments.commands.fitting import fit_recording

    return fit_recording(arguments)


def _fit_rig(arguments: argparse.Namespace) -> int:
    """Fit the parameters of a program to a rig."""
    from analogrig import RigError

    _check_for_a_rig(arguments, ("span", "check"))
    try:
        from analogrig_instruments.commands.fitting import fit_rig

        return fit_rig(arguments)
    except RigError as error:
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)


def _check_for_a_rig(arguments: argparse.Namespace, options: Sequence[str]) -> None:
    """:raises ConfigurationError: one of these options is given."""
    from analogrig import ConfigurationError

    for option in options:
        if getattr(arguments, option) not in (None, []):
            others = "" if option in ("span", "check") else ", and for programs other than front and shock"
            raise ConfigurationError(f"--{option.replace('_', '-')} is for --recording{others}")


def _values(found: Calibration) -> list[str]:
    """One line for each value."""
    lines = []
    for each in found.estimates:
        factor, unit = _SHOWN_AS[each.unit]
        value = f"{factor * each.value:10.4f} +- {factor * each.standard_error:9.4f} {unit:3}"
        lines.append(f"{each.name:20} {value}   {each.stands_for}")
    return lines


def _said(found: Calibration, check_lsb: float) -> list[str]:
    """Quality and limits of a calibration, one line each."""
    from analogrig_instruments.calibration.fit import LEAST_GAIN_OF_DIALS

    computer = found.twin.computer
    others = [
        f"{stock}, by {pots} {chi_square - found.chi_square:+.0f}"
        for (stock, pots), chi_square in found.chi_squares.items()
        if (stock, pots) != (computer.components, computer.pots)
    ]
    why = (
        "of those tried the least chi-square"
        if found.is_least
        else "the least chi-square but for dials, which have three unknowns more and gain less than"
        f" {LEAST_GAIN_OF_DIALS:g} times what is left per degree of freedom"
    )
    lines = [f"kept: {computer.components} capacitors, pots set by {computer.pots}: {why}"]
    lines += [f"chi-square of others: {'; '.join(others)}"] if others else []
    lines += [f"hardly told apart: {a} and {b} (correlation {c:+.2f})" for a, b, c in found.alike]
    lines += [f"known no better than by the datasheet: {', '.join(found.unseen)}"] if found.unseen else []
    return [
        *lines,
        f"recordings: within {found.residual_lsb:.2f} LSB rms, chi-square {found.chi_square:.0f} of {found.freedom}",
        *_caveats(found),
        f"on a scenario that was not fitted: within {check_lsb:.2f} LSB rms",
    ]


def _caveats(found: Calibration) -> list[str]:
    """Reasons why the twin may differ from the rig, one line each."""
    if found.explains_all:
        return []
    deviation, wider = (2.0 * found.freedom) ** 0.5, (found.chi_square / found.freedom) ** 0.5
    left = f"chi-square {found.chi_square:.0f} where noise leaves {found.freedom} +- {deviation:.0f}"
    why = f"what no such machine does (nonlinearity, drift); the standard errors are {wider:.1f} times as wide for it"
    return [f"caveat: {left}: the rig does {why}"]


def _toml(found: Calibration, arguments: argparse.Namespace, check_lsb: float) -> str:
    """Rig description for ``open_rig``, with its origin and uncertainty as comments."""
    from dataclasses import asdict, replace

    from analogrig.config import to_toml
    from analogrig.identity import Identity
    from analogrig.reporting import provenance

    made_by = provenance(Identity.here(arguments.command_line, arguments.started))
    heading = [
        f"Twin of the rig {arguments.rig!r}, program {arguments.program}: the emulator as fitted by calibrate.",
        "A value stands for all that acts as it does; the parts that are not named are as in the diagram.",
        *_values(found),
        *_said(found, check_lsb),
        *(f"{name}: {' '.join(value.split())}" for name, value in made_by),
    ]
    described = asdict(replace(found.twin, description=f"twin of {arguments.rig}"))
    del described["name"]
    return "".join(f"# {line}\n" for line in heading) + "\n" + to_toml(described)


def _as_json(found: Calibration, check_lsb: float, arguments: argparse.Namespace) -> dict[str, Any]:
    return {
        "rig": arguments.rig,
        "program": arguments.program,
        "file": str(arguments.out) if check_lsb <= MOST_LSB else None,
        "components": found.twin.computer.components,
        "pots": found.twin.computer.pots,
        "estimates": [vars(each) for each in found.estimates],
        "chi_square": found.chi_square,
        "freedom": found.freedom,
        "caveats": _caveats(found),
        "tried": [
            {"components": stock, "pots": pots, "chi_square": value}
            for (stock, pots), value in found.chi_squares.items()
        ],
        "alike": found.alike,
        "unseen": found.unseen,
        "residual_lsb": found.residual_lsb,
        "check_lsb": check_lsb,
    }
