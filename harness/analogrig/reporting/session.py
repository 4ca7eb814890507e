"""Page of a session: all runs below a folder, and the trend of their delay over builds."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from analogrig.config import read_bounded
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.output import FORMAT, FORMAT_VERSION, REPORT_FILE, VERDICT_FILE
from analogrig.pages import FOLDER, TABLES, assemble_page
from analogrig.reporting.markings import figure, levels, words
from analogrig.reporting.markup import SORTABLE, cell, heading, number, row, table, text
from analogrig.storage import replace_file
from analogrig.wording import number_of

PAGE_FILE = "session.html"

MOST_RUNS = 5_000
"""Largest number of runs in a session."""

_MOST_BYTES = 16_000_000
"""Largest verdict that is read."""

_MOST_TRENDS = 40
_WIDTH, _HEIGHT, _LEFT, _TOP, _BELOW = 600, 180, 56, 26, 62
_SIGNS = {"passed": "✓", "failed": "✗", "inconclusive": "?", "unjudged": "–"}
_STYLES = {"passed": "good", "failed": "bad", "inconclusive": "neutral", "unjudged": "neutral"}
_COLOURS = {
    "passed": "var(--alarm)",
    "failed": "var(--false)",
    "inconclusive": "var(--truth)",
    "unjudged": "var(--truth)",
}


@dataclass(frozen=True)
class Entry:
    """One run of a session, from its ``verdict.json``."""

    folder: str
    """Folder of the run, relative to that of the session."""
    scenario: str
    rig: str
    device: str
    seed: int
    outcome: str
    samples: int
    changes: int
    missed: int
    false_alarms: int
    ratio: float | None
    """Mean latency over mean bound of the detected changes; None without one."""
    started: str
    """Start of the play, ISO 8601; empty if unknown."""
    build: str
    """Build of the device: the first digits of its file's SHA-256; empty if it has no file."""
    commit: str
    """Commit of analogrig; empty if unknown."""
    page: str
    """Page of the run, relative to that of the session; empty without one."""

    @property
    def kind(self) -> tuple[str, str, str]:
        """Scenario, rig and device: runs of one kind form a trend."""
        return self.scenario, self.rig, self.device


@dataclass(frozen=True)
class RunList:
    """Runs below a folder, in the order of their start."""

    runs: tuple[Entry, ...]
    unended: tuple[str, ...] = ()
    """One line for each run that has not ended, or failed before its first sample."""
    unread: tuple[str, ...] = ()
    """One line for each file that is no verdict."""

    def count(self, outcome: str) -> int:
        """Number of runs with an outcome."""
        return sum(run.outcome == outcome for run in self.runs)


def find_session(folder: Path, page: Path) -> RunList:
    """Runs below ``folder``: every ``verdict.json`` of a play. Links to folders are not followed.

    :param page: the page to be written, whose links lead to the runs.
    :raises ConfigurationError: it is no folder, or holds no run or more than MOST_RUNS.
    """
    if not folder.is_dir():
        raise ConfigurationError(f"{folder}: no such folder")
    runs: list[Entry] = []
    unended: list[str] = []
    unread: list[str] = []
    for parent, folders, files in os.walk(folder):
        folders[:] = sorted(each for each in folders if not each.endswith(".previous"))  # of earlier commands
        if VERDICT_FILE not in files:
            continue
        if len(runs) + len(unended) + len(unread) == MOST_RUNS:
            raise ConfigurationError(f"{folder}: more than {MOST_RUNS:,} runs: name a folder within it")
        try:
            entry = _read(Path(parent), folder, page.parent)
        except _NoResultError as error:
            unended.append(str(error))
        except (ConfigurationError, RecordingError) as error:
            unread.append(str(error))
        else:
            runs += [entry] if entry else []
    if not (runs or unended or unread):
        raise ConfigurationError(f"{folder}: holds no run: no {VERDICT_FILE} of analogrig run, replay or judge")
    return RunList(tuple(sorted(runs, key=lambda run: (run.started, run.folder))), tuple(unended), tuple(unread))


class _NoResultError(RecordingError):
    """The verdict is that of a run without results."""


def _read(parent: Path, folder: Path, start: Path) -> Entry | None:
    """Run in ``parent``; None if its verdict is that of another command, such as ``thesis``.

    :raises ConfigurationError: the verdict cannot be read, or is none.
    :raises _NoResultError: the run has no results.
    """
    path = parent / VERDICT_FILE
    try:
        table = json.loads(read_bounded(path, _MOST_BYTES))
        if table["format"] != FORMAT or table["version"] != FORMAT_VERSION:
            raise ConfigurationError(f"{path}: not a verdict of this version: run analogrig judge again")
        if "scenario" not in table:
            if table["outcome"] == "inconclusive":
                raise _NoResultError(f"{path}: inconclusive: {', '.join(map(str, table['reasons']))}")
            return None
        return _entry(table, parent, folder, start)
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror or error}") from error
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, ArithmeticError) as error:
        raise ConfigurationError(f"{path}: not a verdict of analogrig: run the command again, or remove it") from error


def _entry(table: Mapping[str, Any], parent: Path, folder: Path, start: Path) -> Entry:
    by, changes = table["recorded_by"] or {}, table["tweaks"]
    exact = [each for each in changes if each["latency"] is not None and each["bound"]]
    latency, bound = (math.fsum(float(each[key]) for each in exact) for key in ("latency", "bound"))
    if table["outcome"] not in _SIGNS or not math.isfinite(latency + bound):
        raise ValueError("outcome, latency or bound")
    return Entry(
        folder=parent.relative_to(folder).as_posix(),
        scenario=str(table["scenario"]),
        rig=str(table["rig"]),
        device=str(table["dut"]["name"]),
        seed=int(table["seed"]),
        outcome=table["outcome"],
        samples=int(table["samples"]),
        changes=len(changes),
        missed=sum(each["result"] == "missed" for each in changes),
        false_alarms=len(table["false_alarms"]),
        ratio=latency / bound if exact else None,
        started=str(by.get("started", "")),
        build=next((str(each["sha256"])[:8] for each in by.get("devices", []) if each.get("sha256")), ""),
        commit=str(by.get("commit") or "")[:12],
        page=os.path.relpath(parent / REPORT_FILE, start) if (parent / REPORT_FILE).is_file() else "",
    )


def write_session(session: RunList, path: Path) -> None:
    """Write the page, atomically. The same session gives the same bytes.

    :raises RecordingError: it cannot be written.
    """
    with replace_file(path) as file:
        file.write(render(session).encode("utf-8", "replace"))


def render(session: RunList) -> str:
    """The page as text."""
    shown = [outcome for outcome in _SIGNS if outcome != "unjudged" or session.count(outcome)]
    counts = ", ".join(f"{session.count(outcome)} {outcome}" for outcome in shown)
    worst = next((outcome for outcome in ("failed", "inconclusive", "unjudged") if session.count(outcome)), "passed")
    lines = (*session.unended, *session.unread)
    worst = "inconclusive" if worst == "passed" and lines else worst
    unread = "".join(f"<li>{text(line)}</li>" for line in lines)
    return assemble_page(
        FOLDER / "session.html",
        (TABLES,),
        title=text(f"{number_of(len(session.runs), 'run')}: {counts}"),
        outcome=worst,
        heading=text(number_of(len(session.runs), "run")),
        sentence=text(f"{counts}."),
        unread=f"<ul>{unread}</ul>" if unread else "",
        trends=_trends(session.runs),
        runs=_table(session.runs),
    )


def _table(runs: Sequence[Entry]) -> str:
    head = heading(
        ("Started", "Outcome", "Run", "Scenario", "Rig", "Device", "Build", "Commit"),
        ("Seed", "Samples", "Changes", "Missed", "False alarms", "Latency / bound"),
    )
    caption = "In the order of their start; latency over bound of all detected changes"
    return table(caption, head, map(_row, runs), SORTABLE, MOST_RUNS)


def _row(run: Entry) -> str:
    name = text(run.folder if run.folder != "." else "here")
    link = f'<a href="{text(quote(run.page))}">{name}</a>' if run.page else name
    places = [run.scenario, run.rig, run.device, run.build, run.commit]
    numbers = [run.samples, run.changes, run.missed, run.false_alarms]
    outcome = cell(f"{_SIGNS[run.outcome]} {run.outcome}", f"text {_STYLES[run.outcome]}")
    return row(
        [
            cell(run.started[:19].replace("T", " "), "date"),
            outcome,
            f'<th scope="row">{link}</th>',
            *map(cell, places),
            number(run.seed, "d"),
            *(number(value, ",d") for value in numbers),
            number(run.ratio, ".2f"),
        ]
    )


def _trends(runs: Sequence[Entry]) -> str:
    """One plot for each kind of run that was played more than once."""
    kinds = [kind for kind in dict.fromkeys(run.kind for run in runs) if sum(run.kind == kind for run in runs) > 1]
    if not kinds:
        return "<p>No scenario was played twice with the same device: there is no trend.</p>"
    more = f"<p>The first {_MOST_TRENDS} of {len(kinds)} are drawn.</p>" if len(kinds) > _MOST_TRENDS else ""
    plots = [_trend(kind, [run for run in runs if run.kind == kind]) for kind in kinds[:_MOST_TRENDS]]
    return f'<div class="maps">{"".join(plots)}</div>{more}'


def _trend(kind: tuple[str, str, str], runs: Sequence[Entry]) -> str:
    """Plot of the delay in bounds over the runs, in the order of their start; ticks where build or commit change."""
    most = 1.1 * max([1.0, *(run.ratio for run in runs if run.ratio is not None)])
    step = (_WIDTH - _LEFT - 20) / max(1, len(runs) - 1)
    places = [(run, _LEFT + i * step, _TOP + _HEIGHT * (1.0 - (run.ratio or 0.0) / most)) for i, run in enumerate(runs)]
    parts = [words(_LEFT, 12, "latency / bound", "start", is_faint=True)]
    parts += [_level(value, most) for value in levels(most)]
    free, made_by = -math.inf, ("", "")
    for run, x, _ in places:
        if (run.build, run.commit) != made_by and x >= free:
            parts.append(words(x, _TOP + _HEIGHT + 16, run.build or "–", "start"))
            parts.append(words(x, _TOP + _HEIGHT + 32, run.commit or "–", "start"))
            parts.append(f'<path d="M{x:.1f} {_TOP}v{_HEIGHT}" stroke="var(--line)"/>')
            free = x + 110
        made_by = run.build, run.commit
    line = " ".join(f"{x:.1f},{y:.1f}" for run, x, y in places if run.ratio is not None)
    parts.append(f'<polyline points="{line}" fill="none" stroke="var(--muted)"/>')
    parts += [_point(run, x, y) for run, x, y in places]
    below = "build of the device and commit of analogrig, in the order of the runs"
    parts.append(words(_LEFT, _TOP + _HEIGHT + 52, below, "start", is_faint=True))
    caption = f"{kind[0]} on {kind[1]}, device {kind[2]}"
    has_links = any(run.page for run in runs)
    return figure(
        caption, f"{caption}: latency over bound", _WIDTH, _TOP + _HEIGHT + _BELOW, parts, has_links=has_links
    )


def _level(value: float, most: float) -> str:
    y = _TOP + _HEIGHT * (1.0 - value / most)
    line = f'<path d="M{_LEFT} {y:.1f}H{_WIDTH - 10}" stroke="var(--line)"/>'
    return line + words(_LEFT - 8, y + 4, f"{value:g}", "end")


def _point(run: Entry, x: float, y: float) -> str:
    """Mark of a run, which leads to its page: a disc if it passed, a cross if it failed, else a ring."""
    colour = _COLOURS[run.outcome]
    ring = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="none" stroke="{colour}" stroke-width="2"/>'
    shapes = {
        "passed": f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>',
        "failed": f'<path d="M{x - 5:.1f} {y - 5:.1f}l10 10m0 -10l-10 10" stroke="{colour}" stroke-width="3"/>',
        "inconclusive": ring,
        "unjudged": ring,
    }
    ratio = "no change detected" if run.ratio is None else f"{run.ratio:.2f} bounds"
    alarms = number_of(run.false_alarms, "false alarm")
    title = f"{run.folder}, seed {run.seed}: {run.outcome}, {ratio}, {run.missed} missed, {alarms}"
    mark = f"{shapes[run.outcome]}<title>{text(title)}</title>"
    if not run.page:
        return f"<g>{mark}</g>"
    return f'<a href="{text(quote(run.page))}" aria-label="{text(title)}">{mark}</a>'
