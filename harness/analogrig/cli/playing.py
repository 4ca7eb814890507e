"""``analogrig run``, ``replay`` and ``judge``: one play or recording, from the options to the files and exit status."""

from __future__ import annotations

import argparse
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli.options import (
    DUT,
    FILE,
    add_capture,
    add_command,
    add_dut,
    add_json,
    add_what_to_play,
    changes_of_dut,
    files_read,
    is_capture,
    load_capture,
    open_what_to_play,
    seconds,
    trust_of,
)
from analogrig.cli.terminal import (
    INCONCLUSIVE,
    INTERRUPTED,
    STATUS,
    complain,
    progress_line,
    show,
    show_json,
    show_work,
)

if TYPE_CHECKING:
    from analogrig.devices.device import Device
    from analogrig.identity import Identity
    from analogrig.judging.verdict import Verdict
    from analogrig.output import OutputFolder
    from analogrig.rigs.rig import Rig
    from analogrig.run import Run
    from analogrig.scenario import Scenario


def add_run(commands: Any) -> None:
    command = add_command(
        commands,
        "run",
        "play a scenario on a rig through a device, and judge the device's alarms",
        "run --seed 7",
        "run --scenario slow --dut inproc --out build/slow",
        "run --rig emulator-0-10v --dut inproc --out build/clipped --json",
    )
    add_what_to_play(command)
    add_dut(command, default=os.environ.get("ANALOGRIG_DUT", ""), shown="$ANALOGRIG_DUT, that of the scenario, or host")
    _add_output(command, "build/run")
    _add_play(command)
    command.set_defaults(command=_run)


def add_replay(commands: Any) -> None:
    command = add_command(
        commands,
        "replay",
        "play a recorded run through a device again, and judge it",
        "replay build/run/run.npz",
        "replay build/run/run.npz --dut mean-between-faults --out build/mean",
        "replay build/can/can.log --scenario thesis --dut inproc",
        "replay --compare build/run/run.npz",
    )
    command.add_argument("file", type=Path, metavar=FILE, help="recording (run.npz) or CAN log")
    add_capture(command)
    command.set_defaults(log_dut=None)
    add_dut(command, default=None, shown="that of the recording")
    command.add_argument(
        "--compare",
        action="store_true",
        help="compare the answers with those of the bundled library in process, as [estimator] of the device file"
        " configures it, and name the cause of differences: the recorded answers, or with --dut those of a new play",
    )
    _add_output(command, "build/replay")
    _add_play(command)
    command.set_defaults(command=_replay)


def add_judge(commands: Any) -> None:
    command = add_command(
        commands,
        "judge",
        "judge a recorded run or a CAN log, without a device",
        "judge build/run/run.npz",
        "judge build/can/can.log --scenario thesis --json",
        "judge bench.asc --dut ecu.toml --scenario thesis",
    )
    command.add_argument("file", type=Path, metavar=FILE, help="recording (run.npz) or CAN log")
    add_capture(command)
    command.add_argument(
        "--dut", dest="log_dut", metavar=DUT, help="device file (kind can-dbc) of a CAN log with messages of its own"
    )
    _add_output(command, "build/judge")
    command.set_defaults(command=_judge)


def _add_output(command: argparse.ArgumentParser, default: str) -> None:
    command.add_argument(
        "--out",
        type=Path,
        default=Path(default),
        metavar="DIR",
        help="folder for run.npz and report.html (default: %(default)s)",
    )
    add_json(command)


def _add_play(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--can-log",
        choices=("log", "blf", "asc", "mf4", "none"),
        help="format of the CAN log beside run.npz: candump, BLF, ASC or MF4 (default: log on a CAN bus)",
    )
    command.add_argument(
        "--time-limit",
        type=seconds,
        metavar="SECONDS",
        help="end the run after that time; it is then INCONCLUSIVE, and what was recorded is kept (default: no limit)",
    )


def _run(arguments: argparse.Namespace) -> int:
    with _output_folder(arguments) as output, open_what_to_play(arguments) as (rig, scenario, seed):
        from analogrig.devices.registry import open_dut

        device = functools.partial(open_dut, arguments.dut or scenario.dut or "host")
        return _play(rig, scenario, seed, device, output, arguments)


def _replay(arguments: argparse.Namespace) -> int:
    if arguments.compare:
        return _compare(arguments)
    with _output_folder(arguments) as output:
        from analogrig.devices.registry import open_dut, reopen_dut
        from analogrig.errors import ConfigurationError
        from analogrig.rigs.recording import RecordingRig
        from analogrig.run import IMPORTED

        if arguments.dut is None and is_capture(arguments.file):
            raise ConfigurationError(f"{arguments.file}: a CAN log does not name its device: name one with --dut")
        with RecordingRig.of(load_capture(arguments), arguments.file) as rig:
            conditions = rig.run.conditions
            if arguments.dut is None and conditions.device.kind == IMPORTED:
                raise ConfigurationError(f"{arguments.file}: measured data has no device: name one with --dut")
            device: Callable[..., Device] = functools.partial(reopen_dut, conditions.dut, str(arguments.file))
            if arguments.dut:
                device = functools.partial(open_dut, arguments.dut)
            return _play(rig, rig.scenario(), conditions.seed, device, output, arguments)


def _compare(arguments: argparse.Namespace) -> int:
    """Compare the recorded answers, or those of a new play, with the bundled library. Nothing is written."""
    from analogrig.bench import Bench, raise_if_interrupted
    from analogrig.claims.claim_check import compare_with_library
    from analogrig.devices.registry import open_dut
    from analogrig.rigs.recording import RecordingRig

    run = load_capture(arguments)
    if arguments.dut is not None:
        rig = RecordingRig.of(run, arguments.file)
        with open_dut(arguments.dut, allow=trust_of(arguments), **changes_of_dut(arguments)) as dut:
            bench = Bench(rig, dut, progress_line(), time_limit_s=arguments.time_limit)
            run = raise_if_interrupted(bench.play(rig.scenario(), run.conditions.seed))
    with show_work("comparing"):
        comparison = compare_with_library(run)
    if arguments.json:
        show_json(comparison.as_table() | {"faults": list(run.conditions.faults)})
    else:
        show(comparison.text())
    if not comparison.agrees:
        return STATUS["failed"]
    if run.conditions.faults:
        return complain(f"INCONCLUSIVE: {run.conditions.faults[0]}", INCONCLUSIVE)
    return 0


def _judge(arguments: argparse.Namespace) -> int:
    with _output_folder(arguments) as output:
        from analogrig.errors import ConfigurationError
        from analogrig.rigs.recording import RecordingRig
        from analogrig.run import IMPORTED

        run = load_capture(arguments)
        if run.conditions.device.kind == IMPORTED:
            raise ConfigurationError(
                f"{arguments.file}: no device has answered these samples: judge the run of analogrig replay"
                f" {arguments.file} --dut NAME"
            )
        RecordingRig.of(run, arguments.file)
        return _conclude(run, output, output.identity(), arguments)


def _output_folder(arguments: argparse.Namespace) -> OutputFolder:
    """The folder of --out for the results of a run, as yet untouched."""
    from analogrig.output import OutputFolder

    return OutputFolder(arguments.out, arguments.command_line, arguments.started, reads=files_read(arguments))


def _play(
    rig: Rig,
    scenario: Scenario,
    seed: int,
    open_device: Callable[..., Device],
    output: OutputFolder,
    arguments: argparse.Namespace,
) -> int:
    """Play a scenario with the options of the command line.

    :raises ConfigurationError: a log was asked for of a device that is on no CAN bus.
    """
    from dataclasses import replace

    from analogrig.bench import Bench, was_interrupted
    from analogrig.errors import ConfigurationError, RecordingError
    from analogrig.output import CAN_LOG
    from analogrig.recordings import WRITTEN, CanLog
    from analogrig.signals import hold_signals

    log = None
    if arguments.can_log != "none":
        log = CanLog(output.parts / f"{CAN_LOG}.{arguments.can_log or WRITTEN[0]}")
    with open_device(allow=trust_of(arguments), listener=log, **changes_of_dut(arguments)) as dut:
        if arguments.can_log is not None and log is not None and not log.has_frames:
            raise ConfigurationError(f"--can-log {arguments.can_log}: device {dut.name} is not on a CAN bus")
        identity = replace(output.identity(), devices=dut.files())
        if log is not None:
            log.begin()
        bench = Bench(rig, dut, progress_line(), real_time=arguments.real_time, time_limit_s=arguments.time_limit)
        run = bench.play(scenario, seed)
        with hold_signals():
            try:
                if log is not None:
                    log.close()
            except RecordingError as error:
                faults = (*run.conditions.faults, output.reason(error))
                run = replace(run, conditions=replace(run.conditions, faults=faults))
            status = _conclude(run.with_identity(identity), output, identity, arguments)
            return INTERRUPTED if was_interrupted(run) else status


def _conclude(run: Run, output: OutputFolder, identity: Identity, arguments: argparse.Namespace) -> int:
    """Judge a run, write it and its report, print the verdict, and return the exit status.

    :param identity: of this command.
    """
    from analogrig.errors import RecordingError
    from analogrig.judging.verdict import judge
    from analogrig.output import REPORT_FILE, RUN_FILE
    from analogrig.reporting import write_report
    from analogrig.reporting.run_summary import summary

    def write(folder: Path) -> None:
        run.save(folder / RUN_FILE)
        write_report(run, verdict, folder / REPORT_FILE)

    try:
        with show_work("judging, writing run and report"):
            verdict = judge(run)
            table = _as_json(run, verdict, identity, output)
            output.conclude(write, table)
    except RecordingError as error:
        unkept = {"outcome": "inconclusive", "valid": False, "reasons": [str(error), *verdict.reasons]}
        if arguments.json:
            show_json(table | unkept)
        else:
            show(summary(run, verdict))
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)
    if arguments.json:
        show_json(table)
    else:
        show(f"{summary(run, verdict)}\nreport: {output.page}\nrun:    {output.path / RUN_FILE}")
    if not verdict.valid:
        complain(f"{verdict.outcome.upper()}: {verdict.reasons[0]}", INCONCLUSIVE)
    return STATUS[verdict.outcome]


def _as_json(run: Run, verdict: Verdict, identity: Identity, output: OutputFolder) -> dict[str, Any]:
    from dataclasses import asdict

    from analogrig.judging.advice import advice
    from analogrig.judging.response import step_responses
    from analogrig.judging.verdict import as_json
    from analogrig.output import RUN_FILE

    conditions = run.conditions
    return {
        "scenario": conditions.played.name,
        "rig": conditions.source.name,
        "dut": dict(conditions.dut),
        "link": conditions.link,
        "line_s": conditions.line_s,
        "link_counters": dict(conditions.link_counters),
        "real_time": conditions.real_time,
        "seed": conditions.seed,
        "samples": run.samples,
        "counters": dict(conditions.counters),
        **as_json(verdict),
        "step_responses": [asdict(each) for each in step_responses(run)],
        "advice": list(advice(run, verdict)),
        "identity": identity.as_table(),
        "recorded_by": None if conditions.identity is None else conditions.identity.as_table(),
        "report": str(output.page),
        "run": str(output.path / RUN_FILE),
    }
