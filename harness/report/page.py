"""The page as a whole: template, styles, scripts and data joined into one file."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path
from string import Template

from harness.errors import RecordingError
from harness.report import tables
from harness.report.payload import as_script, payload
from harness.run import Run
from harness.storage import replacing
from harness.verdict import Verdict

_FOLDER = Path(__file__).parent
_STYLES = ("uPlot.min.css", "page.css")
_SCRIPTS = ("uPlot.iife.min.js", "page.js")


def write_report(run: Run, verdict: Verdict, path: Path) -> None:
    """Write the page: either all of it or nothing. The same run gives the same bytes.

    :raises RecordingError: the page cannot be written, or the build has not put uPlot in its place.
    """
    page = render(run, verdict)
    with replacing(path) as file:
        file.write(page.encode("utf-8", "replace"))


def render(run: Run, verdict: Verdict) -> str:
    """The page as text.

    :raises RecordingError: the build has not put uPlot in its place.
    """
    styles = [part(name) for name in _STYLES]
    scripts = [part(name) for name in _SCRIPTS]
    return Template(part("page.html")).substitute(
        policy=policy(styles, scripts),
        styles="\n".join(f"<style>{style}</style>" for style in styles),
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
        data=as_script(payload(run, verdict)),
        title=tables.title(run, verdict),
        outcome=tables.outcome(run, verdict),
        conditions=tables.conditions(run, verdict),
        tweaks=tables.tweaks(verdict),
        diagnoses=tables.diagnoses(verdict),
        false_alarms=tables.false_alarms(run, verdict),
        estimates=tables.estimates(verdict),
        settings=tables.settings(run),
        period=tables.period(run),
    )


def policy(styles: list[str], scripts: list[str]) -> str:
    """A content security policy under which nothing is loaded and only these very styles and scripts work."""
    return f"default-src 'none'; style-src {_hashes(styles)}; script-src {_hashes(scripts)}"


def _hashes(sources: list[str]) -> str:
    digests = (hashlib.sha256(source.encode("utf-8")).digest() for source in sources)
    return " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)


def part(name: str) -> str:
    """A file beside this one.

    :raises RecordingError: it is not there.
    """
    path = _FOLDER / name
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RecordingError(f"no report without {path}: build it with make setup, or pip install -e .") from None
    except OSError as error:
        raise RecordingError(f"no report without {path}: {error.strerror or error}") from error
