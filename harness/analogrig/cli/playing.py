"""One play of a scenario, from the options to the files and the exit status."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli.terminal import INCONCLUSIVE, INTERRUPTED, STATUS, complain, progress_line, show, show_json, working

if TYPE_CHECKING:
    from analogrig.devices.dut import Dut
    from analogrig.identity import Identity
    from analogrig.judging.verdict import Verdict
    from analogrig.output import OutputFolder
    from analogrig.recordings import CanLog
    from analogrig.rigs.rig import Rig
    from analogrig.run import Run
    from analogrig.scenario import Scenario


def output_folder(arguments: argparse.Namespace) -> OutputFolder:
    """The folder of --out for the results of a run, as yet untouched."""
    from analogrig.cli.options import files_read
    from analogrig.output import OutputFolder

    return OutputFolder(arguments.out, arguments.command_line, arguments.started, reads=files_read(arguments))


def can_log(output: OutputFolder, arguments: argparse.Namespace) -> CanLog | None:
    """Listener to the CAN frames of the run, if they shall be kept; a run on another link has none."""
    from analogrig.output import CAN_LOG
    from analogrig.recordings import WRITTEN, CanLog

    asked = arguments.can_log or WRITTEN[0]
    return None if asked == "none" else CanLog(output.parts / f"{CAN_LOG}.{asked}")


def play(
    rig: Rig,
    dut: Dut,
    scenario: Scenario,
    seed: int,
    output: OutputFolder,
    arguments: argparse.Namespace,
    log: CanLog | None = None,
) -> int:
    """Play a scenario with the options of the command line.

    :raises ConfigurationError: a log was asked for of a device that is on no CAN bus.
    """
    from dataclasses import replace

    from analogrig.bench import Bench
    from analogrig.errors import ConfigurationError
    from analogrig.signals import held

    if arguments.can_log is not None and log is not None and not log.has_frames:
        raise ConfigurationError(f"--can-log {arguments.can_log}: device {dut.name} is not on a CAN bus")
    identity = replace(output.identity(), devices=dut.files())
    if log is not None:
        log.begin()
    bench = Bench(rig, dut, progress_line(), real_time=arguments.real_time, time_limit_s=arguments.time_limit)
    run = bench.play(scenario, seed)
    with held():
        return conclude(_with_log(run, log, output).with_identity(identity), output, identity, arguments)


def _with_log(run: Run, log: CanLog | None, output: OutputFolder) -> Run:
    """Return the run, invalid if its CAN log could not be written."""
    from dataclasses import replace

    from analogrig.errors import RecordingError

    try:
        if log is not None:
            log.close()
    except RecordingError as error:
        faults = (*run.conditions.faults, output.reason(error))
        return replace(run, conditions=replace(run.conditions, faults=faults))
    return run


def conclude(run: Run, output: OutputFolder, identity: Identity, arguments: argparse.Namespace) -> int:
    """Judge a run, keep it and its report, show the verdict to whoever listens, and return the exit status.

    :param identity: of this command.
    """
    from analogrig.bench import INTERRUPTED_BY_USER
    from analogrig.errors import RecordingError
    from analogrig.judging.verdict import judge
    from analogrig.output import REPORT_FILE, RUN_FILE
    from analogrig.reporting import write_report
    from analogrig.reporting.summary import summary

    def write(folder: Path) -> None:
        run.save(folder / RUN_FILE)
        write_report(run, verdict, folder / REPORT_FILE)

    try:
        with working("judging, writing run and report"):
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
        complain(f"INCONCLUSIVE: {verdict.reasons[0]}", INCONCLUSIVE)
    return INTERRUPTED if INTERRUPTED_BY_USER in run.conditions.faults else STATUS[verdict.outcome]


def _as_json(run: Run, verdict: Verdict, identity: Identity, output: OutputFolder) -> dict[str, Any]:
    from analogrig.judging.advice import advice
    from analogrig.judging.verdict import as_json
    from analogrig.output import RUN_FILE

    conditions = run.conditions
    return {
        "scenario": conditions.scenario["name"],
        "rig": conditions.rig["name"],
        "dut": dict(conditions.dut),
        "link": conditions.link,
        "line_s": conditions.line_s,
        "link_counters": dict(conditions.link_counters),
        "real_time": conditions.real_time,
        "seed": conditions.seed,
        "samples": run.samples,
        "counters": dict(conditions.counters),
        **as_json(verdict),
        "advice": list(advice(run, verdict)),
        "identity": identity.as_table(),
        "recorded_by": None if conditions.identity is None else conditions.identity.as_table(),
        "report": str(output.page),
        "run": str(output.path / RUN_FILE),
    }
