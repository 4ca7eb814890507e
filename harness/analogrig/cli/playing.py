"""One play of a scenario, from the options to the files and the exit status."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli.terminal import INCONCLUSIVE, INTERRUPTED, STATUS, complain, progress_line, show, show_json, working

if TYPE_CHECKING:
    from analogrig.judging.verdict import Verdict
    from analogrig.protocol.dut import Dut
    from analogrig.recordings import CanLog
    from analogrig.rigs.rig import Rig
    from analogrig.run import Run
    from analogrig.scenario import Scenario

RUN_FILE, REPORT_FILE, CAN_LOG = "run.npz", "report.html", "can"


def prepare(out: Path, rig: Rig) -> None:
    """Find out before the run whether its results can be kept.

    :raises ConfigurationError: the folder cannot be made, or holds the recording that is being played.
    """
    from analogrig.errors import ConfigurationError
    from analogrig.rigs.recording import RecordingRig

    make_folder(out)
    if isinstance(rig, RecordingRig) and rig.path.resolve() == (out / RUN_FILE).resolve():
        raise ConfigurationError(f"--out {out}: would overwrite the recording that is played; choose another folder")


def make_folder(out: Path) -> None:
    """Find out before the work whether its results can be kept.

    :raises ConfigurationError: the folder cannot be made, or cannot be written to.
    """
    from analogrig.errors import ConfigurationError

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"--out {out}: {error.strerror or error}") from error
    if not os.access(out, os.W_OK | os.X_OK):
        raise ConfigurationError(f"--out {out}: cannot be written to")


def can_log(rig: Rig, arguments: argparse.Namespace) -> CanLog | None:
    """What listens to the CAN frames of the run, if they shall be kept; a run on another link has none.

    :raises ConfigurationError: the run would overwrite the log that is being played.
    """
    from analogrig.errors import ConfigurationError
    from analogrig.recordings import WRITTEN, CanLog
    from analogrig.rigs.recording import RecordingRig

    if isinstance(rig, RecordingRig) and rig.path.resolve() in {path.resolve() for path in _can_logs(arguments.out)}:
        raise ConfigurationError(
            f"--out {arguments.out}: would overwrite the CAN log that is played; choose another folder"
        )
    asked = arguments.can_log or WRITTEN[0]
    return None if asked == "none" else CanLog(arguments.out / f"{CAN_LOG}.{asked}")


def _can_logs(out: Path) -> list[Path]:
    """Wherever a run leaves one."""
    from analogrig.recordings import WRITTEN

    return [out / f"{CAN_LOG}.{suffix}" for suffix in WRITTEN]


def _begin(log: CanLog | None, out: Path) -> None:
    """What an earlier run has left goes, now that there is a device to play with.

    :raises RecordingError: it cannot go.
    """
    from analogrig.errors import RecordingError

    for path in _can_logs(out):
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be removed: {error.strerror or error}") from error
    if log is not None:
        log.begin()


def play(
    rig: Rig, dut: Dut, scenario: Scenario, seed: int, arguments: argparse.Namespace, log: CanLog | None = None
) -> int:
    """:raises ConfigurationError: a log was asked for of a device that is on no CAN bus."""
    from analogrig.bench import Bench
    from analogrig.errors import ConfigurationError, RecordingError

    if arguments.can_log is not None and log is not None and not log.has_heard:
        raise ConfigurationError(f"--can-log {arguments.can_log}: device {dut.name} is not on a CAN bus")
    _begin(log, arguments.out)
    bench = Bench(rig, dut, progress_line(), real_time=arguments.real_time, time_limit_s=arguments.time_limit)
    run = bench.play(scenario, seed)
    status = conclude(run, arguments)
    try:
        if log is not None:
            log.close()
    except RecordingError as error:
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)
    return status


def conclude(run: Run, arguments: argparse.Namespace) -> int:
    """Judge a run, keep it and its report, show the verdict to whoever listens, and return the exit status."""
    from analogrig.bench import INTERRUPTED_BY_USER
    from analogrig.errors import RecordingError
    from analogrig.judging.verdict import judge
    from analogrig.reporting import write_report
    from analogrig.reporting.summary import summary

    unkept = None
    with working("judging, writing run and report"):
        verdict = judge(run)
        try:
            run.save(arguments.out / RUN_FILE)
            write_report(run, verdict, arguments.out / REPORT_FILE)
        except RecordingError as error:
            unkept = error
    if arguments.json:
        show_json(_as_json(run, verdict, arguments.out))
    else:
        show(f"{summary(run, verdict)}\nreport: {arguments.out / REPORT_FILE}\nrun:    {arguments.out / RUN_FILE}")
    if unkept is not None:
        return complain(f"INCONCLUSIVE: {unkept}", INCONCLUSIVE)
    if not verdict.valid:
        complain(f"INCONCLUSIVE: {verdict.reasons[0]}", INCONCLUSIVE)
    return INTERRUPTED if INTERRUPTED_BY_USER in run.conditions.faults else STATUS[verdict.outcome]


def _as_json(run: Run, verdict: Verdict, out: Path) -> dict[str, Any]:
    from analogrig.judging.advice import advice
    from analogrig.judging.verdict import as_json

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
        "report": str(out / REPORT_FILE),
        "run": str(out / RUN_FILE),
    }
