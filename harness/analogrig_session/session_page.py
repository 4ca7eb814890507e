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

from analogrig import ConfigurationError, RecordingError
from analogrig.config import read_bounded
from analogrig.output import FORMAT, FORMAT_VERSION, REPORT_FILE, VERDICT_FILE, replace_file
from analogrig.pages import SIGNS, TABLES, render_page
from analogrig.wording import number_of

PAGE_FILE = "session.html"

MOST_RUNS = 5_000
"""Largest number of runs in a session."""

_MOST_BYTES = 16_000_000
"""Largest verdict that is read."""

_MOST_TRENDS = 40
_LEFT, _RIGHT, _TOP, _HEIGHT, _LABEL = 56, 580, 26, 180, 110
"""First and last point of a plot, its axis, and the room for a label, in pixels of the drawing in session.html."""


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

    @property
    def link(self) -> str:
        """URL of the page."""
        return quote(self.page)


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
    by, changes = table["recorded_by"] or {}, table["changes"]
    exact = [each for each in changes if each["latency"] is not None and each["bound"]]
    latency, bound = (math.fsum(float(each[key]) for each in exact) for key in ("latency", "bound"))
    if table["outcome"] not in SIGNS or not math.isfinite(latency + bound):
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
    shown = [outcome for outcome in SIGNS if outcome != "unjudged" or session.count(outcome)]
    counts = ", ".join(f"{session.count(outcome)} {outcome}" for outcome in shown)
    unread = (*session.unended, *session.unread)
    worst = next((outcome for outcome in ("failed", "inconclusive", "unjudged") if session.count(outcome)), "passed")
    return render_page(
        Path(__file__).parent / "session.html",
        (TABLES,),
        title=f"{number_of(len(session.runs), 'run')}: {counts}",
        outcome="inconclusive" if worst == "passed" and unread else worst,
        counts=counts,
        unread=unread,
        trends=_trends(session.runs),
        runs=session.runs,
        most_trends=_MOST_TRENDS,
        most_runs=MOST_RUNS,
    )


@dataclass(frozen=True)
class _Point:
    """Run in a plot."""

    run: Entry
    x: float
    y: float
    is_labelled: bool
    """True if its build and commit stand below: they are not those of the run before, and there is room."""

    @property
    def title(self) -> str:
        run = self.run
        ratio = "no change detected" if run.ratio is None else f"{run.ratio:.2f} bounds"
        alarms = number_of(run.false_alarms, "false alarm")
        return f"{run.folder}, seed {run.seed}: {run.outcome}, {ratio}, {run.missed} missed, {alarms}"


@dataclass(frozen=True)
class _Trend:
    """Plot of the delay in bounds over the runs of one kind, in the order of their start."""

    caption: str
    most: float
    """Value at the top of the plot."""
    points: list[_Point]

    def height(self, ratio: float) -> float:
        """Place of a ratio on the vertical axis."""
        return _height(ratio, self.most)


def _trends(runs: Sequence[Entry]) -> list[_Trend]:
    """A plot for each kind of run that was played more than once."""
    by_kind: dict[tuple[str, str, str], list[Entry]] = {}
    for run in runs:
        by_kind.setdefault(run.kind, []).append(run)
    return [_trend(kind, alike) for kind, alike in by_kind.items() if len(alike) > 1]


def _trend(kind: tuple[str, str, str], runs: Sequence[Entry]) -> _Trend:
    most = 1.1 * max([1.0, *(run.ratio for run in runs if run.ratio is not None)])
    step = (_RIGHT - _LEFT) / max(1, len(runs) - 1)
    points = []
    free, made_by = -math.inf, ("", "")
    for i, run in enumerate(runs):
        x = _LEFT + i * step
        is_labelled = (run.build, run.commit) != made_by and x >= free
        free = x + _LABEL if is_labelled else free
        made_by = run.build, run.commit
        points.append(_Point(run, x, _height(run.ratio or 0.0, most), is_labelled))
    return _Trend(f"{kind[0]} on {kind[1]}, device {kind[2]}", most, points)


def _height(ratio: float, most: float) -> float:
    return _TOP + _HEIGHT * (1.0 - ratio / most)
