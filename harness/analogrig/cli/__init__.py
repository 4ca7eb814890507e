"""The command ``analogrig``: its commands, and their common options and output.

Everything heavy is imported inside the command that needs it, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import errno
import os
import shlex
import sys
from collections.abc import Sequence
from typing import NoReturn

from analogrig.cli import (
    bench,
    calibrate,
    campaign,
    certify,
    compare,
    compare_rigs,
    doctor,
    emulation,
    importing,
    listing,
    new,
    patch,
    playing,
    report,
    serve,
    thesis,
)
from analogrig.cli.terminal import INCONCLUSIVE, INTERRUPTED, USAGE, complain, open_standard_streams, show
from analogrig.signals import interruption, raise_signals

_COMMANDS = (
    playing.add_run,
    playing.add_replay,
    playing.add_judge,
    importing.add,
    bench.add,
    campaign.add,
    certify.add,
    compare.add,
    report.add,
    thesis.add,
    emulation.add_emulate,
    serve.add,
    doctor.add,
    calibrate.add,
    compare_rigs.add,
    emulation.add_effects,
    emulation.add_netlist,
    patch.add,
    new.add,
    listing.add_list,
    listing.add_completion,
    listing.add_include,
)
"""Functions that add the commands to the parser, in the order of ``--help``."""


_EXHAUSTED = {
    errno.EMFILE: "raise the limit of this shell (ulimit -n)",
    errno.ENFILE: "close programs, or raise the limit of this machine (sysctl fs.file-max)",
    errno.ENOMEM: "close programs",
    errno.ENOSPC: "make room on the disk",
}
"""Advice for failures that any operation of the system can have, an import among them."""

_MOST_CAUSE = 100
"""Characters of an error that another library has worded; its end names the cause."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. Every failure is one line on standard error."""
    open_standard_streams()
    with raise_signals():
        try:
            parser = _parser()
            if listing.COMPLETION_VARIABLE in os.environ:
                listing.complete(parser)
            arguments = parser.parse_args(argv)
            arguments.command_line = shlex.join(["analogrig", *(sys.argv[1:] if argv is None else argv)])
            from analogrig.identity import now  # here, for --help needs none

            arguments.started = now()
            return int(arguments.command(arguments))
        except KeyboardInterrupt:
            return complain("interrupted", INTERRUPTED)
        except SystemExit:
            raise
        except BaseException as error:  # noqa: BLE001 - whatever it is, a user gets one line
            return complain("interrupted", INTERRUPTED) if interruption(error) else _explain(error)


def _explain(error: BaseException) -> int:
    """Print in one line the error that ended a command; return the exit status."""
    try:
        from analogrig.errors import AnalogrigError, DeviceCrashed
        from analogrig.wording import error_text, one_line
        from analogrig_emulator import EmulatorError
    except (ImportError, MemoryError, OSError):
        cause = " ".join(str(error).split())[-_MOST_CAUSE:]
        return complain(f"not enough memory, or an incomplete installation: {cause}", INCONCLUSIVE)
    if isinstance(error, AnalogrigError | EmulatorError):
        has_crashed = isinstance(error, DeviceCrashed)
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE) if has_crashed else complain(str(error), USAGE)
    if isinstance(error, FileNotFoundError) and _is_working_directory_gone():
        return complain("the working directory is gone: change to one that exists", USAGE)
    if "ANALOGRIG_DEBUG" in os.environ:
        raise error
    if isinstance(error, MemoryError):
        return complain("not enough memory", INCONCLUSIVE)
    if isinstance(error, OSError) and error.errno in _EXHAUSTED:
        return complain(f"{error.strerror}: {_EXHAUSTED[error.errno]}", INCONCLUSIVE)
    culprit = _package_of(error) or "a fault of analogrig itself"
    return complain(f"{culprit}: {one_line(error_text(error))} (ANALOGRIG_DEBUG=1 shows where)", INCONCLUSIVE)


def _package_of(error: BaseException) -> str:
    """Package of somebody else, which adds kinds, in whose code an error was raised; empty if there is none."""
    import traceback  # here, for --help needs none

    from analogrig.devices import registry
    from analogrig.rigs import description

    modules = [str(frame.f_globals.get("__name__")) for frame, _ in traceback.walk_tb(error.__traceback__)]
    return registry.KINDS.package_of(modules) or description.KINDS.package_of(modules)


def _is_working_directory_gone() -> bool:
    try:
        os.getcwd()  # noqa: PTH109 - asks the operating system, as Path.cwd() does
    except FileNotFoundError:
        return True
    return False


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="analogrig",
        description="Hardware in the loop for embedded parameter estimators: a rig, a link, a device, a verdict.",
        epilog="exit status: 0 passed, 1 failed verdict, 2 usage or configuration, 3 inconclusive, 130 interrupted\n\n"
        "examples:\n"
        "  analogrig run\n"
        "  analogrig list scenarios\n"
        "  analogrig run --scenario slow --dut inproc --out build/slow\n"
        "  analogrig run --help",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for add in _COMMANDS:
        add(commands)
    return parser


class _Parser(argparse.ArgumentParser):
    """Report a usage error in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE, f"analogrig: {message} (see {self.prog} --help)\n")


class _Version(argparse.Action):
    """Print the version of the installed distribution, which takes time to look up."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help="show the version and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from analogrig.identity import version

        show(f"analogrig {version()}")
        parser.exit()
