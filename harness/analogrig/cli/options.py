"""Options that mean the same in every command, and what they ask for."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from analogrig.devices.device import DeviceDescription
    from analogrig.rigs.rig import Rig
    from analogrig.run import Run
    from analogrig.scenario import Scenario
    from analogrig.trust import Trust

DEFAULT_SCENARIO = "thesis"

SCENARIO, CAMPAIGN, PROGRAM, RIG, DUT, FILE = "SCENARIO", "CAMPAIGN", "PROGRAM", "RIG", "DUT", "FILE"
"""Metavars. They say what an option takes, and `completion` completes by them."""

RIG_NAMES = "shipped name, table of your rigs file, FILE.toml or FILE.toml:NAME"


def add_command(commands: Any, name: str, does: str, *examples: str) -> argparse.ArgumentParser:
    """Add a command, with its examples at the end of its help.

    :param does: one line in the imperative, for the list of commands and its own help.
    :param examples: arguments after ``analogrig``.
    """
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        help=does,
        description=f"{does[0].upper()}{does[1:]}.",
        epilog="\n".join(["examples:", *(f"  analogrig {example}" for example in examples)]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    return command


def add_rig(
    command: argparse.ArgumentParser,
    words: str = f"{RIG_NAMES} (default: $ANALOGRIG_RIG or emulator)",
    default: str | None = "emulator",
) -> None:
    """Add --rig; ``default`` applies if the environment names no rig."""
    command.add_argument("--rig", default=os.environ.get("ANALOGRIG_RIG", default), metavar=RIG, help=words)
    add_allow(command)


def add_allow(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--allow",
        action="append",
        default=[],
        metavar="THING",
        help="library, firmware, command, Python module, serial port, CAN bus or HOST:PORT that a file may name"
        " (repeatable)",
    )


def trust_of(arguments: argparse.Namespace) -> Trust:
    """Things that the command line names: those of --allow, and what --dut states itself."""
    from analogrig.devices.registry import named_things
    from analogrig.trust import OPTION, Trust

    trust, dut = Trust(arguments.allow, option=OPTION), getattr(arguments, "dut", None)
    return trust.also(named_things(dut)) if dut else trust


def add_what_to_play(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--scenario",
        metavar=SCENARIO,
        help="shipped name or .toml file (default: that of the recording, or one change of --program, or"
        f" {DEFAULT_SCENARIO})",
    )
    command.add_argument(
        "--program",
        metavar=PROGRAM,
        help="program of the computer instead of the scenario's: shipped name or .toml file",
    )
    add_rig(
        command, f"{RIG_NAMES}, or recording:FILE (default: $ANALOGRIG_RIG, that of the scenario, or emulator)", None
    )
    add_seed(command, default=None, shown="that of the scenario or recording, else 1995")


def add_seed(command: argparse.ArgumentParser, default: int | None = 0, shown: str = "%(default)d") -> None:
    command.add_argument("--seed", type=seed, default=default, metavar="N", help=f"random seed (default: {shown})")


def add_json(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def _number_in(low: float, high: float, words: str, kind: type[int | float]) -> Callable[[str], Any]:
    """Parser of a number from ``low`` to ``high``; ``words`` are its message."""

    def parse(text: str) -> Any:
        with contextlib.suppress(ValueError):
            number = kind(text)
            if low <= number <= high and (kind is float or (text.isascii() and text.isdecimal())):
                return number
        raise argparse.ArgumentTypeError(f"must be {words}, not {text[:40]!r}")

    return parse


seed = _number_in(0, 2**63 - 1, "a whole number from 0 to 2^63 - 1", int)
count = _number_in(0, 999_999_999, "a whole number from 0 to 999999999", int)
factor = _number_in(1e-3, 1e6, "a number from 0.001 to 1000000", float)
seconds = _number_in(1e-3, 1e9, "a number of seconds from 0.001 to 1e9", float)
port = _number_in(0, 65535, "a whole number from 0 to 65535", int)


def add_dut(command: argparse.ArgumentParser, default: str | None, shown: str = "$ANALOGRIG_DUT or host") -> None:
    command.add_argument(
        "--dut",
        default=default,
        metavar=DUT,
        help="kind with its place, shipped name or .toml file; `analogrig list devices` shows the kinds"
        f" (default: {shown})",
    )
    command.add_argument(
        "--exchange",
        choices=("sample", "block", "stream"),
        help="override the device's exchange mode",
    )
    command.add_argument(
        "--baud", type=int, metavar="N", help="baud rate of the serial line; computes the line time where there is none"
    )
    command.add_argument(
        "--bitrate", type=int, metavar="N", help="bit rate of the CAN bus; computes the line time where there is none"
    )
    command.add_argument(
        "--wire-faults", metavar="FAULTS", help="faults to inject into the line, such as flip@0.001,reset@to:81,seed=7"
    )
    command.add_argument("--report-interval", type=int, metavar="N", help="samples between estimates from the device")
    command.add_argument(
        "--real-time",
        type=factor,
        nargs="?",
        const=1.0,
        metavar="FACTOR",
        help="send samples at the machine's rate, or FACTOR times slower; implies --exchange stream",
    )


def changes_of_dut(arguments: argparse.Namespace) -> dict[str, Any]:
    """Changes of the device settings that the command line makes beyond the device's name."""
    return {
        "exchange": arguments.exchange,
        "in_real_time": arguments.real_time is not None,
        "baud": arguments.baud,
        "bitrate": arguments.bitrate,
        "report_interval_n": arguments.report_interval,
        "wire_faults": arguments.wire_faults,
    }


@contextlib.contextmanager
def open_what_to_play(arguments: argparse.Namespace) -> Iterator[tuple[Rig, Scenario, int]]:
    """Open the requested rig, scenario and seed; the scenario or the recording supplies those not given."""
    from analogrig.program import Program
    from analogrig.rigs.description import DEFAULT_RIG, open_rig
    from analogrig.scenario import DEFAULT_SEED, Scenario

    asked = None if arguments.scenario is None else Scenario.load(arguments.scenario)
    with open_rig(arguments.rig or (asked.rig if asked else "") or DEFAULT_RIG, allow=trust_of(arguments)) as rig:
        recorded, recorded_seed = rig.recorded or (None, None)
        program = None if arguments.program is None else Program.load(arguments.program)
        scenario = asked or recorded
        if scenario is None:
            scenario = Scenario.load(DEFAULT_SCENARIO) if program is None else Scenario.of_program(program)
        elif program is not None:
            scenario = scenario.on_program(program)
        seeds = (arguments.seed, scenario.seed, recorded_seed, DEFAULT_SEED)
        yield rig, scenario, next(seed for seed in seeds if seed is not None)


def files_read(arguments: argparse.Namespace) -> tuple[Path, ...]:
    """Recordings and descriptions that the command line names, directly or by its scenario: none may be overwritten."""
    from analogrig.config import read_toml
    from analogrig.errors import AnalogrigError
    from analogrig.trust import resolve_name

    given = vars(arguments)
    names = [
        str(given[key])
        for key in ("file", "rig", "scenario", "program", "dut", "log_dut")
        if given.get(key) is not None
    ]
    scenario = Path(given.get("scenario") or "")
    if scenario.suffix == ".toml":
        with contextlib.suppress(AnalogrigError):  # the command that loads it reports the error
            table = read_toml(scenario)
            names += [
                resolve_name(scenario, str(table[key]))
                for key in ("rig", "dut", "program")
                if isinstance(table.get(key), str)
            ]
    return tuple(Path(re.sub(r"(\.toml):.*$", r"\1", name.removeprefix("recording:"))) for name in names)


def add_capture(command: argparse.ArgumentParser) -> None:
    """Add the options for data that a CAN log does not contain."""
    command.add_argument(
        "--scenario", metavar=SCENARIO, help="scenario of a CAN log: shipped name or .toml file (run.npz holds its own)"
    )
    add_rig(command, f"rig of a CAN log: {RIG_NAMES} (default: $ANALOGRIG_RIG or emulator)")
    command.add_argument("--dbc", type=Path, metavar=FILE, help="message catalogue of a CAN log (default: ours)")
    command.add_argument("--run", type=count, metavar="N", help="number of the run in a CAN log, from 1")
    command.add_argument(
        "--channel",
        action="append",
        default=[],
        metavar="NAME",
        help="channel of a CAN log with several buses, such as can0; may be repeated",
    )
    command.add_argument(
        "--most-lost", type=count, default=0, metavar="N", help="samples that a CAN log may lack (default: %(default)s)"
    )


def is_capture(path: Path) -> bool:
    """True if the file name is not that of our own recordings."""
    return path.suffix != ".npz"


def load_capture(arguments: argparse.Namespace) -> Run:
    """Run in the recording or CAN log that the command line names.

    :raises RecordingError: it cannot be read.
    :raises ConfigurationError: it is a CAN log, and the scenario is not given, or not the one.
    """
    from analogrig.run import Run
    from analogrig.scenario import Scenario

    scenario = None if arguments.scenario is None else Scenario.load(arguments.scenario)
    if scenario is None and not is_capture(arguments.file):
        return Run.load(arguments.file)  # without the readers of CAN logs, which take a second to import

    from analogrig.errors import ConfigurationError
    from analogrig.recordings import import_run, replace_scenario
    from analogrig.rigs.description import open_rig

    if scenario is not None and not is_capture(arguments.file):
        return replace_scenario(Run.load(arguments.file), scenario)
    if scenario is None:
        raise ConfigurationError(f"{arguments.file}: a CAN log does not name its scenario: name one with --scenario")
    device = None if arguments.log_dut is None else _described_ecu(arguments.log_dut)
    if device is not None and arguments.dbc is not None:
        raise ConfigurationError(f"{arguments.log_dut}: names a DBC of its own: leave out --dbc")
    with open_rig(arguments.rig, allow=trust_of(arguments)) as rig:
        return import_run(
            arguments.file,
            scenario,
            rig,
            dbc=arguments.dbc,
            device=device,
            number=arguments.run,
            most_lost_n=arguments.most_lost,
            channels=arguments.channel,
        )


def _described_ecu(name: str) -> DeviceDescription:
    """Device whose messages a CAN log holds. It is only described: nothing is opened.

    :raises ConfigurationError: it is of another kind, or its description is wrong.
    """
    from analogrig.devices.registry import describe, kinds_that_decode_logs
    from analogrig.errors import ConfigurationError

    device = describe(name)
    if not device.decodes_logs:
        raise ConfigurationError(
            f"{name}: a log of a device of the kind {device.kind} needs no device file: leave it out, or pass one of"
            f" the kind {' or '.join(kinds_that_decode_logs())}"
        )
    return device
