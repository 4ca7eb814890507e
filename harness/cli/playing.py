"""One play of a scenario, from the options to the files and the exit status."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.cli.terminal import INCONCLUSIVE, INTERRUPTED, STATUS, complain, progress_line, show

if TYPE_CHECKING:
    from harness.can_log import CanLog
    from harness.dut import Dut
    from harness.rig import Rig
    from harness.run import Run
    from harness.scenario import Scenario
    from harness.verdict import Verdict

RUN_FILE, REPORT_FILE, CAN_LOG = "run.npz", "report.html", "can"


def prepare(out: Path, rig: Rig) -> None:
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


def can_log(arguments: argparse.Namespace) -> CanLog | None:
    """What listens to the CAN frames of the run, if they shall be kept; a run on another link has none.

    :raises RecordingError: the log of an earlier run is in the way.
    """
    from harness.can_log import WRITTEN, CanLog

    kept = None
    for suffix in WRITTEN:
        log = CanLog(arguments.out / f"{CAN_LOG}.{suffix}")
        kept = log if suffix == arguments.can_log else kept
    return kept


def play(
    rig: Rig, dut: Dut, scenario: Scenario, seed: int, arguments: argparse.Namespace, log: CanLog | None = None
) -> int:
    from harness.bench import Bench
    from harness.errors import RecordingError

    run = Bench(rig, dut, progress_line(), real_time=arguments.real_time).play(scenario, seed)
    status = conclude(run, arguments)
    try:
        if log is not None:
            log.close()
    except RecordingError as error:
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)
    return status


def conclude(run: Run, arguments: argparse.Namespace) -> int:
    """Judge a run, show the verdict, keep both, and return the exit status."""
    from harness.bench import INTERRUPTED_BY_USER
    from harness.errors import RecordingError
    from harness.report import write_report
    from harness.summary import summary
    from harness.verdict import judge

    verdict = judge(run)
    if arguments.json:
        show(json.dumps(_as_json(run, verdict, arguments.out)))
    else:
        show(f"{summary(run, verdict)}\nreport: {arguments.out / REPORT_FILE}\nrun:    {arguments.out / RUN_FILE}")
    try:
        run.save(arguments.out / RUN_FILE)
        write_report(run, verdict, arguments.out / REPORT_FILE)
    except RecordingError as error:
        return complain(f"INCONCLUSIVE: {error}", INCONCLUSIVE)
    if not verdict.valid:
        complain(f"INCONCLUSIVE: {verdict.reasons[0]}", INCONCLUSIVE)
    return INTERRUPTED if INTERRUPTED_BY_USER in run.conditions.faults else STATUS[verdict.outcome]


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
