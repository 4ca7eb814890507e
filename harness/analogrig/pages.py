"""Assembly of a page from template, style sheet, scripts and values: one look for all pages."""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import math
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Any

from analogrig.errors import RecordingError
from analogrig.wording import number_of

FOLDER = Path(__file__).parent / "reporting"
PLOTS = (FOLDER / "uPlot.iife.min.js", FOLDER / "plots.js")
"""Scripts of every page with plots."""
TABLES = FOLDER / "tables.js"
"""Script of every page with tables that can be sorted."""

__all__ = ["SIGNS", "TABLES", "render_page"]
"""Names for packages beside the core."""

SIGNS = {"passed": "✓", "failed": "✗", "inconclusive": "?", "unjudged": "–"}
"""Sign of each outcome of a run."""


def render_page(template: str | Path, scripts: Sequence[Path] = (), *, title: str, **values: Any) -> str:
    """Self-contained page: a template with values, all of which are escaped.

    :param template: path, or the name of one of this package. It may import those of this package.
    :raises RecordingError: a file is missing, such as uPlot before the build.
    """
    path = FOLDER / template
    body = _templates(path.parent).get_template(path.name).render(values)
    return _frame(body, scripts, html.escape(title))


def assemble_page(
    template: Path,
    scripts: Sequence[Path] = (),
    *,
    title: str,
    more_styles: Sequence[Path] = (),
    connect: str = "",
    **texts: str,
) -> str:
    """Self-contained page: ``template`` with finished texts in HTML. ``title`` must be escaped.

    :param more_styles: style sheets of this page alone.
    :param connect: source of the content security policy that the page may connect to; empty: none.
    :raises RecordingError: a file is missing, such as uPlot before the build.
    """
    return _frame(Template(_part(template)).substitute(texts), scripts, title, more_styles, connect)


@functools.cache
def _templates(folder: Path) -> Any:
    """Environment of the templates in a folder. jinja2 is imported here, because few commands need it."""
    import jinja2

    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader([folder, FOLDER]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters["shown"] = _shown
    templates.globals.update(number_of=number_of, levels=_levels, signs=SIGNS)
    return templates


def _shown(value: Any, form: str = ".4g") -> str:
    """A number as text; a dash for None."""
    return "–" if value is None else format(value, form)


def _levels(most: float) -> list[float]:
    """Round values from 0 to ``most`` for an axis."""
    step = 10.0 ** math.floor(math.log10(most))
    step *= next(factor for factor in (0.2, 0.5, 1.0, 2.0) if most / (factor * step) <= 6.0)
    return [i * step for i in range(int(most / step) + 1)]


def _frame(body: str, scripts: Sequence[Path], title: str, more_styles: Sequence[Path] = (), connect: str = "") -> str:
    """Page with the one style sheet and its scripts."""
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
        body=body.rstrip("\n"),
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
