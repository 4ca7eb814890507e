"""Assembly of the page from template, styles, scripts and data."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from pathlib import Path
from string import Template

from analogrig.errors import RecordingError
from analogrig.judging.verdict import Verdict
from analogrig.reporting import tables
from analogrig.reporting.payload import as_script, payload
from analogrig.run import Run
from analogrig.storage import replace_file

FOLDER = Path(__file__).parent
STYLES = (FOLDER / "uPlot.min.css", FOLDER / "page.css")
"""Styles of every page with plots."""
SCRIPTS = (FOLDER / "uPlot.iife.min.js", FOLDER / "plots.js")
"""Scripts of every page with plots."""


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
        STYLES,
        (*SCRIPTS, FOLDER / "page.js"),
        data=as_script(payload(run, verdict)),
        title=tables.title(run, verdict),
        outcome=tables.outcome(run, verdict),
        conditions=tables.conditions(run, verdict),
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


def assemble_page(template: Path, styles: Sequence[Path], scripts: Sequence[Path], *, title: str, **texts: str) -> str:
    """Self-contained page: ``template`` with its styles, scripts and texts. ``title`` must be escaped.

    :raises RecordingError: a file is missing, such as uPlot before the build.
    """
    style, script = ([_part(path) for path in paths] for paths in (styles, scripts))
    elements = [_part(FOLDER / "licence.html").rstrip("\n")] if scripts else []
    return Template(_part(FOLDER / "frame.html")).substitute(
        title=title,
        policy=f"default-src 'none'; style-src {_hashes(style)}; script-src {_hashes(script)}",
        styles="\n".join(f"<style>{each}</style>" for each in style),
        body=Template(_part(template)).substitute(texts).rstrip("\n"),
        scripts="\n".join([*elements, *(f"<script>{each}</script>" for each in script)]),
    )


def _hashes(sources: list[str]) -> str:
    digests = (hashlib.sha256(source.encode("utf-8")).digest() for source in sources)
    return " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)


def _part(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RecordingError(f"no report without {path}: build it with make setup, or pip install -e .") from None
    except OSError as error:
        raise RecordingError(f"no report without {path}: {error.strerror or error}") from error
