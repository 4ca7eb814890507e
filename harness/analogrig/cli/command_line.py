"""The command ``analogrig``: its commands, and their common options and output.

Everything heavy is imported inside the command that needs it, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import errno
import functools
import os
import shlex
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from analogrig.cli import (
    campaign,
    certify,
    compare,
    listing,
    playing,
)
from analogrig.cli.terminal import (
    INCONCLUSIVE,
    INTERRUPTED,
    PASSED,
    USAGE,
    complain,
    end_output,
    keep_results_apart,
    open_standard_streams,
    show,
)
from analogrig.errors import ConfigurationError
from analogrig.signals import interruption, raise_signals

_COMMANDS = (
    playing.add_run,
    playing.add_replay,
    playing.add_judge,
    campaign.add,
    certify.add,
    compare.add,
    listing.add_list,
    listing.add_completion,
    listing.add_include,
)
"""Functions that add our commands to the parser, in the order of ``--help``. Packages add others."""


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
            words = sys.argv[1:] if argv is None else argv
            parser = make_parser(words[0] if words else "")
            if listing.COMPLETION_VARIABLE in os.environ:
                listing.complete(parser)
            arguments = parser.parse_args(argv)
            arguments.command_line = shlex.join(["analogrig", *words])
            from analogrig.identity import now  # here, for --help needs none

            arguments.started = now()
            with keep_results_apart():
                status = int(arguments.command(arguments))
                return end_output(status)
        except KeyboardInterrupt:
            return complain("interrupted", INTERRUPTED)
        except SystemExit as error:
            if not error.code and (status := end_output(PASSED)):  # of --help
                return status
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
    import traceback  # here, for --help needs none

    from analogrig.entry_points import package_of

    modules = (str(frame.f_globals.get("__name__")) for frame, _ in traceback.walk_tb(error.__traceback__))
    culprit = package_of(modules) or "a fault of analogrig itself"
    return complain(f"{culprit}: {one_line(error_text(error))} (ANALOGRIG_DEBUG=1 shows where)", INCONCLUSIVE)


def _is_working_directory_gone() -> bool:
    try:
        os.getcwd()  # noqa: PTH109 - asks the operating system, as Path.cwd() does
    except FileNotFoundError:
        return True
    return False


def make_parser(name: str = "") -> argparse.ArgumentParser:
    """Parser of the command line. Only if ``name`` is no command of ours, those of other packages are added."""
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
    if name not in commands.choices:
        _add_installed(commands)
    return parser


def _add_installed(commands: Any) -> None:
    """Add the commands of installed packages. One that cannot be imported has the error as its help and result."""
    from analogrig.entry_points import COMMANDS, of_group
    from analogrig.wording import error_text

    for point in of_group(COMMANDS):
        if point.name in commands.choices:
            complain(f"command {point.name!r} of {point} is ignored: there is one of this name", PASSED)
            continue
        wrong = f"command {point.name!r}: {point} adds no command of this name"
        try:
            add: Any = point.load("command")
            add(commands)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - of foreign code; the other commands work
            is_named = isinstance(error, ConfigurationError)
            wrong = str(error) if is_named else f"command {point.name!r}: {point}: {error_text(error)}"
        if point.name not in commands.choices:
            broken = commands.add_parser(
                point.name, help=wrong.replace("%", "%%"), prefix_chars="\0", add_help=False
            )  # it takes any words
            broken.add_argument("words", nargs="*")
            broken.set_defaults(command=functools.partial(_raise, ConfigurationError(wrong)))


def _raise(error: ConfigurationError, _: argparse.Namespace) -> int:
    raise error


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
