"""The command ``analogrig``.

Everything heavy is imported inside the command that needs it, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from harness.bench import Progress
    from harness.dut import Dut
    from harness.rig import Rig
    from harness.run import Run
    from harness.scenario import Scenario
    from harness.verdict import Verdict

PASSED, FAILED, USAGE, INCONCLUSIVE, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit statuses."""

_STATUS = {"passed": PASSED, "failed": FAILED, "inconclusive": INCONCLUSIVE}

RUN_FILE, REPORT_FILE = "run.npz", "report.html"

DEFAULT_SCENARIO = "thesis"
DEFAULT_SEED = 1995


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status. Every failure is one line on standard error."""
    _open_standard_streams()
    try:
        arguments = _parser().parse_args(argv)
        return int(arguments.command(arguments))
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)
    except Exception as error:  # noqa: BLE001 - whatever it is, a user gets one line
        return _explain(error)


def _explain(error: Exception) -> int:
    """What ended a command, in one line."""
    from emulator.errors import EmulatorError
    from harness.errors import AnalogrigError

    if isinstance(error, AnalogrigError | EmulatorError):
        return _complain(str(error), USAGE)
    if "ANALOGRIG_DEBUG" in os.environ:
        raise error
    what = " ".join(f"{type(error).__name__}: {error}".split())
    return _complain(f"a fault of analogrig itself: {what} (ANALOGRIG_DEBUG=1 shows where)", INCONCLUSIVE)


def _complain(message: str, status: int) -> int:
    print(f"analogrig: {message}", file=sys.stderr)
    return status


def _open_standard_streams() -> None:
    """Whoever closed one of them wants to hear nothing; a file opened later must not take its place."""
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
            setattr(sys, name, open(number, "w", closefd=False))  # noqa: SIM115 - for as long as we live


def _print(text: str) -> None:
    """To standard output. If nobody listens any more, that is no reason to change what the command has found."""
    try:
        print(text, flush=True)
    except OSError as error:
        print(f"analogrig: standard output: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="analogrig",
        description="Hardware in the loop for embedded parameter estimators: a rig, a link, a device, a verdict.",
        epilog="Exit status: 0 passed, 1 failed verdict, 2 usage or configuration, 3 inconclusive, 130 interrupted.",
    )
    parser.add_argument("--version", action=_Version)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_run(commands)
    _add_replay(commands)
    _add_emulate(commands)
    _add_effects(commands)
    _add_netlist(commands)
    return parser


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE, f"analogrig: {message} (see {self.prog} --help)\n")


class _Version(argparse.Action):
    """Asks the installed distribution, and only when asked."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help="show the version and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        _print(f"analogrig {version('analogrig')}")
        parser.exit()


def _add_run(commands: Any) -> None:
    command = commands.add_parser("run", help="play a scenario on a rig, through a device, and judge what it says")
    _add_what_to_play(command)
    _add_dut(command, default=os.environ.get("ANALOGRIG_DUT", "host"))
    _add_output(command)
    command.set_defaults(command=_run)


def _add_replay(commands: Any) -> None:
    command = commands.add_parser("replay", help="play a recorded run through a device again, and judge it")
    command.add_argument("file", type=Path, metavar="FILE", help="a recording (run.npz)")
    _add_dut(command, default=None)
    _add_output(command, default=Path("build/replay"))
    command.set_defaults(command=_replay)


def _add_emulate(commands: Any) -> None:
    command = commands.add_parser("emulate", help="the rig alone: write volts and codes to a file")
    _add_what_to_play(command)
    command.add_argument(
        "--out",
        type=Path,
        default=Path("build/signals.csv"),
        metavar="FILE",
        help=".csv or .npz (default: %(default)s)",
    )
    command.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    command.set_defaults(command=_emulate)


def _add_effects(commands: Any) -> None:
    command = commands.add_parser("effects", help="what matters at 12 bits: each fault of the machine by itself")
    command.add_argument("--set", choices=("shock", "front"), help="one parameter set instead of both")
    command.add_argument("--out", type=Path, metavar="FILE", help="also draw it, as an .svg file")
    command.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    command.set_defaults(command=_effects)


def _add_netlist(commands: Any) -> None:
    command = commands.add_parser("netlist", help="the emulated computer as a SPICE deck, which ngspice runs unchanged")
    _add_what_to_play(command)
    command.add_argument("--out", type=Path, metavar="FILE", help="where the deck goes (default: standard output)")
    command.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    command.set_defaults(command=_netlist)


def _add_what_to_play(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--scenario",
        metavar="NAME",
        help=f"a shipped name or a .toml file (default: {DEFAULT_SCENARIO}, or that recorded)",
    )
    command.add_argument(
        "--program", choices=_PROGRAMS, help="what is wired on the computer, instead of the scenario's plant.set"
    )
    command.add_argument(
        "--rig",
        default=os.environ.get("ANALOGRIG_RIG", "emulator"),
        metavar="NAME",
        help="shipped name, .toml file, or recording:FILE (default: $ANALOGRIG_RIG or emulator)",
    )
    command.add_argument(
        "--seed", type=_seed, metavar="N", help=f"of all that is random (default: {DEFAULT_SEED}, or that recorded)"
    )


_PROGRAMS = ("front", "shock", "bump-stop", "two-mass")
"""Those of emulator.PROGRAMS, which would take a tenth of a second to ask."""


def _seed(text: str) -> int:
    if text.isascii() and text.isdecimal() and len(text) <= 19 and int(text) < 2**63:
        return int(text)
    raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 2^63 - 1, not {text[:40]!r}")


def _factor(text: str) -> float:
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if 1e-3 <= factor <= 1e6:
        return factor
    raise argparse.ArgumentTypeError(f"must be a number from 0.001 to 1000000, not {text[:40]!r}")


def _add_dut(command: argparse.ArgumentParser, default: str | None) -> None:
    shown = "$ANALOGRIG_DUT or host" if default is not None else "that of the recording"
    command.add_argument(
        "--dut",
        default=default,
        metavar="NAME",
        help=f"shipped name, .toml file, inproc, qemu-m3, qemu-m4, qemu-m7[:ELF], or serial:URL (default: {shown})",
    )
    command.add_argument(
        "--exchange",
        choices=("sample", "block", "stream"),
        help="how samples go to the device, instead of as described",
    )
    command.add_argument("--baud", type=int, metavar="N", help="of the line; without a real one its time is reported")
    command.add_argument(
        "--wire-faults", metavar="FAULTS", help="spoil the line: flip@0.001,reset@to:81,seed=7; see harness/README.md"
    )
    command.add_argument(
        "--report-interval", type=int, metavar="N", help="the device reports its estimate every N samples"
    )
    command.add_argument(
        "--real-time",
        type=_factor,
        nargs="?",
        const=1.0,
        metavar="FACTOR",
        help="samples go out as the machine takes them, or FACTOR times slower; a stream, unless --exchange is given",
    )


def _add_output(command: argparse.ArgumentParser, default: Path = Path("build/run")) -> None:
    command.add_argument(
        "--out",
        type=Path,
        default=default,
        metavar="DIR",
        help="where run.npz and report.html go (default: %(default)s)",
    )
    command.add_argument("--json", action="store_true", help="print one JSON object instead of tables")


def _run(arguments: argparse.Namespace) -> int:
    from harness.dut import open_dut
    from harness.rig import open_rig

    with open_rig(arguments.rig) as rig:
        scenario, seed = _what_to_play(rig, arguments)
        _prepare(arguments.out, rig)
        with open_dut(arguments.dut, **_changes(arguments)) as dut:
            return _play(rig, dut, scenario, seed, arguments)


def _replay(arguments: argparse.Namespace) -> int:
    from harness.dut import open_dut, reopen_dut
    from harness.rig import RecordingRig

    with RecordingRig.open(arguments.file) as rig:
        _prepare(arguments.out, rig)
        changes = _changes(arguments)
        named = arguments.dut
        with open_dut(named, **changes) if named else reopen_dut(rig.run.conditions.dut, **changes) as dut:
            return _play(rig, dut, rig.scenario(), rig.run.conditions.seed, arguments)


def _changes(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the command line says about the device beyond its name."""
    in_real_time = "stream" if arguments.real_time is not None else None
    return {
        "exchange": arguments.exchange or in_real_time,
        "baud": arguments.baud,
        "report_interval_n": arguments.report_interval,
        "wire_faults": arguments.wire_faults,
    }


def _what_to_play(rig: Rig, arguments: argparse.Namespace) -> tuple[Scenario, int]:
    """Scenario and seed: those asked for; by default those of the recording if the rig is one."""
    from dataclasses import replace

    from harness.rig import RecordingRig
    from harness.scenario import Scenario

    recording = rig if isinstance(rig, RecordingRig) else None
    if recording is not None and arguments.scenario is None:
        scenario = recording.scenario()
    else:
        scenario = Scenario.load(arguments.scenario or DEFAULT_SCENARIO)
    if arguments.program is not None:
        scenario = replace(scenario, plant=replace(scenario.plant, set=arguments.program))
    if arguments.seed is not None:
        return scenario, arguments.seed
    return scenario, DEFAULT_SEED if recording is None else recording.run.conditions.seed


def _prepare(out: Path, rig: Rig) -> None:
    """Find out before the run whether its results can be kept.

    :raises ConfigurationError: the folder cannot be made, or holds the recording that is being played.
    """
    from harness.errors import ConfigurationError
    from harness.rig import RecordingRig

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"--out {out}: {error.strerror or error}") from error
    if not os.access(out, os.W_OK | os.X_OK):
        raise ConfigurationError(f"--out {out}: cannot be written to")
    if isinstance(rig, RecordingRig) and rig.path.resolve() == (out / RUN_FILE).resolve():
        raise ConfigurationError(f"--out {out}: would overwrite the recording that is played; choose another folder")


def _play(rig: Rig, dut: Dut, scenario: Scenario, seed: int, arguments: argparse.Namespace) -> int:
    from harness.bench import INTERRUPTED_BY_USER, Bench
    from harness.errors import RecordingError
    from harness.report import write_report
    from harness.summary import summary
    from harness.verdict import judge

    run = Bench(rig, dut, _progress_line(), real_time=arguments.real_time).play(scenario, seed)
    verdict = judge(run)
    if arguments.json:
        _print(json.dumps(_as_json(run, verdict, arguments.out)))
    else:
        _print(f"{summary(run, verdict)}\nreport: {arguments.out / REPORT_FILE}\nrun:    {arguments.out / RUN_FILE}")
    try:
        run.save(arguments.out / RUN_FILE)
        write_report(run, verdict, arguments.out / REPORT_FILE)
    except RecordingError as error:
        return _complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)
    if not verdict.valid:
        _complain(f"INCONCLUSIVE: {verdict.reasons[0]}", INCONCLUSIVE)
    return INTERRUPTED if INTERRUPTED_BY_USER in run.conditions.faults else _STATUS[verdict.outcome]


def _as_json(run: Run, verdict: Verdict, out: Path) -> dict[str, Any]:
    from harness.advice import advice
    from harness.verdict import as_json

    conditions = run.conditions
    return {
        "scenario": conditions.scenario["name"],
        "rig": conditions.rig["name"],
        "dut": dict(conditions.dut),
        "link": conditions.link,
        "line_s": conditions.line_s,
        "real_time": conditions.real_time,
        "seed": conditions.seed,
        "samples": run.samples,
        "counters": dict(conditions.counters),
        **as_json(verdict),
        "advice": list(advice(run, verdict)),
        "report": str(out / REPORT_FILE),
        "run": str(out / RUN_FILE),
    }


def _emulate(arguments: argparse.Namespace) -> int:
    from harness.emulate import write_signals
    from harness.rig import open_rig
    from harness.summary import lamps_text

    with open_rig(arguments.rig) as rig:
        scenario, seed = _what_to_play(rig, arguments)
        written = write_signals(rig, scenario, seed, arguments.out, progress=_progress_line())
    if arguments.json:
        _print(json.dumps({"file": str(arguments.out), "seed": seed, **written}))
    else:
        _print(f"{arguments.out}: {written['samples']} samples, {written['clipped']} of them with a clipped channel")
        _print(f"overload lamps: {lamps_text(written['overloads'])}")
    return PASSED


def _effects(arguments: argparse.Namespace) -> int:
    from harness import effects

    if arguments.out is not None and arguments.out.suffix != ".svg":
        from harness.errors import ConfigurationError

        raise ConfigurationError(f"{arguments.out}: the file's name must end with .svg")
    table = effects.measure([arguments.set] if arguments.set else ["shock", "front"])
    if arguments.out is not None:
        effects.write_picture(table, arguments.out)
    _print(json.dumps(effects.as_json(table)) if arguments.json else effects.text(table))
    return PASSED


def _netlist(arguments: argparse.Namespace) -> int:
    from harness.netlist import netlist
    from harness.rig import open_rig
    from harness.storage import replacing

    with open_rig(arguments.rig) as rig:
        scenario, seed = _what_to_play(rig, arguments)
        deck = netlist(rig, scenario, seed)
    text = deck.text()
    if arguments.out is not None:
        with replacing(arguments.out) as file:
            file.write(text.encode("ascii"))
    if arguments.json:
        where = {"deck": text} if arguments.out is None else {"file": str(arguments.out)}
        _print(json.dumps({**where, "samples": deck.samples, "seed": seed}))
    elif arguments.out is None:
        _print(text.rstrip("\n"))
    else:
        _print(f"{arguments.out}: {deck.samples} samples; run it with: ngspice -b -r out.raw {arguments.out}")
    return PASSED


def _progress_line() -> Progress | None:
    """Percent on standard error, at most once a second and only from the second second on; None when nobody watches."""
    if not sys.stderr.isatty():
        return None
    import time

    next_s = time.monotonic() + 1.0

    def show(done: int, asked: int) -> None:
        nonlocal next_s
        now_s = time.monotonic()
        if now_s >= next_s:
            next_s = now_s + 1.0
            end = "\n" if done == asked else ""
            print(f"\r{done} of {asked} samples ({done / asked:.0%})", end=end, file=sys.stderr, flush=True)

    return show


if __name__ == "__main__":
    sys.exit(main())
