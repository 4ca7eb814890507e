"""Assembly of a page from template, style sheet, scripts and texts: one look for all pages."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from pathlib import Path
from string import Template

from analogrig.errors import RecordingError

FOLDER = Path(__file__).parent / "reporting"
PLOTS = (FOLDER / "uPlot.iife.min.js", FOLDER / "plots.js")
"""Scripts of every page with plots."""
TABLES = FOLDER / "tables.js"
"""Script of every page with tables that can be sorted."""


def assemble_page(
    template: Path,
    scripts: Sequence[Path] = (),
    *,
    title: str,
    more_styles: Sequence[Path] = (),
    connect: str = "",
    **texts: str,
) -> str:
    """Self-contained page: ``template`` with the one style sheet, its scripts and texts. ``title`` must be escaped.

    :param more_styles: style sheets of this page alone.
    :param connect: source of the content security policy that the page may connect to; empty: none.
    :raises RecordingError: a file is missing, such as uPlot before the build.
    """
    has_plots = set(PLOTS) <= set(scripts)
    styles = (*((FOLDER / "uPlot.min.css",) if has_plots else ()), FOLDER / "page.css", *more_styles)
    style, script = ([_part(path) for path in paths] for paths in (styles, scripts))
    elements = [_part(FOLDER / "licence.html").rstrip("\n")] if has_plots else []
    sources = [f"script-src {_hashes(script)}"] if script else []
    sources += [f"connect-src {connect}"] if connect else []
    return Template(_part(FOLDER / "frame.html")).substitute(
        title=title,
        policy="; ".join(["default-src 'none'", f"style-src {_hashes(style)}", *sources]),
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
