"""Page of one run."""

from __future__ import annotations

from pathlib import Path

from analogrig.judging.verdict import Verdict
from analogrig.pages import FOLDER, PLOTS, assemble_page
from analogrig.reporting import measured, tables
from analogrig.reporting.payload import as_script, payload
from analogrig.run import Run
from analogrig.storage import replace_file


def write_report(run: Run, verdict: Verdict, path: Path) -> None:
    """Write a run and its verdict as one HTML page without remote resources, atomically.

    The same run gives the same bytes.

    :raises RecordingError: the page cannot be written, or uPlot is not installed by the build.
    """
    page = render(run, verdict)
    with replace_file(path) as file:
        file.write(page.encode("utf-8", "replace"))


def render(run: Run, verdict: Verdict) -> str:
    """HTML page of a run and its verdict.

    :raises RecordingError: uPlot is not installed by the build.
    """
    return assemble_page(
        FOLDER / "page.html",
        (*PLOTS, FOLDER / "page.js"),
        data=as_script(payload(run, verdict)),
        title=tables.title(run, verdict),
        outcome=tables.outcome(run, verdict),
        conditions=tables.conditions(run, verdict),
        measured=measured.section(run),
        alarm="detection" if verdict.knows_truth else "alarm",
        tweaks=tables.tweaks(run, verdict),
        diagnoses=tables.diagnoses(run, verdict),
        channel_faults=tables.channel_faults(run, verdict),
        false_alarms=tables.false_alarms(run, verdict),
        fit=tables.fit(verdict),
        estimates=tables.estimates(run, verdict),
        settings=tables.settings(run),
        period=tables.period(run),
        resolution=tables.resolution(run, verdict),
    )
