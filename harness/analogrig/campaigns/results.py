"""Results of a campaign: one JSON file without dates, and its tables."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analogrig import config
from analogrig.campaigns.plan import Cell, Plan
from analogrig.campaigns.rows import RATES, Row, changes, check_row, counts, is_valid, valid
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.plant import PARAMETERS
from analogrig.storage import replace_file
from analogrig.wording import counter_text, number_of

FORMAT, FORMAT_VERSION = "analogrig-campaign", 2

MAX_FILE_BYTES = 4_000_000_000

CONFIDENCE = 0.95
"""Confidence level of the bounds in the tables; they hold at any stopping time of a campaign."""


@dataclass(frozen=True)
class Results:
    """The rows of every cell, in the order of ``Plan.cells``."""

    plan: Plan
    rows: tuple[tuple[Row, ...], ...]

    def save(self, path: Path) -> None:
        """Write atomically; the same results give the same bytes.

        :raises RecordingError: the file cannot be written.
        """
        head = {"format": FORMAT, "version": FORMAT_VERSION, "plan": self.plan.as_table()}
        with replace_file(path) as file:
            file.write(f'{json.dumps(head, sort_keys=True)[:-1]}, "cells": [\n'.encode())
            for i, rows in enumerate(self.rows):
                lines = ",\n".join(json.dumps(row, sort_keys=True, separators=(",", ":")) for row in rows)
                file.write(f"{',' if i else ''}[\n{lines}\n]\n".encode())
            file.write(b"]}\n")

    @classmethod
    def load(cls, path: Path) -> Results:
        """:raises RecordingError: absent, or not the results of a campaign."""
        try:
            if path.stat().st_size > MAX_FILE_BYTES:
                raise RecordingError(f"{path}: larger than {MAX_FILE_BYTES} bytes")
            table = json.loads(path.read_bytes())
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror or error}") from error
        except (ValueError, RecursionError) as error:
            raise RecordingError(f"{path}: not the results of a campaign") from error
        if not isinstance(table, dict) or (table.get("format"), table.get("version")) != (FORMAT, FORMAT_VERSION):
            raise RecordingError(f"{path}: not of the format {FORMAT} {FORMAT_VERSION}")
        try:
            results = cls(config.build(Plan, table["plan"], str(path)), tuple(map(tuple, table["cells"])))
            results._check()
        except (ConfigurationError, LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise RecordingError(f"{path}: damaged results of a campaign ({error})") from error
        return results

    def of_plan(self, plan: Plan, path: Path) -> Results:
        """Return these results if they belong to the plan.

        :raises ConfigurationError: they are another's.
        """
        plan.check_same(json.loads(self.plan.as_json()), f"{path}: holds the results of another campaign")
        return self

    def cells(self) -> list[tuple[Cell, Summary]]:
        """Cells, each with the summary of its trials."""
        return [(cell, Summary.of(rows)) for cell, rows in zip(self.plan.cells(), self.rows, strict=True)]

    def total(self) -> Summary:
        return Summary.of([row for rows in self.rows for row in rows])

    def outcome(self) -> str:
        """``failed`` if a trial failed; ``inconclusive`` if one was not valid; else ``passed``."""
        outcomes = {row["outcome"] for rows in self.rows for row in rows}
        return next((each for each in ("failed", "inconclusive") if each in outcomes), "passed")

    def _check(self) -> None:
        if len(self.rows) != self.plan.size:
            raise ValueError(f"{number_of(len(self.rows), 'cell')}, where the plan has {self.plan.size}")
        spec = self.plan.spec
        for rows in self.rows:
            for row in rows:
                check_row(row)
            if [row["seed"] for row in rows] != [spec.first_seed + i for i in range(len(rows))]:
                raise ValueError("rows of other seeds than the plan has")
            if not (1 if spec.stop else spec.trials) <= len(rows) <= spec.trials:
                raise ValueError(f"a cell of {number_of(len(rows), 'trial')}")


@dataclass(frozen=True)
class Summary:
    """Summary of some trials; inconclusive ones are only counted."""

    trials: int
    passed: int
    failed: int
    inconclusive: int
    samples: int
    armed: int
    """Exposure: samples in which the trigger was armed."""
    false_alarms: int
    false_alarm_rate: tuple[float, float]
    """Bounds per sample in which the trigger was armed."""
    visible: int
    missed: int
    late: int
    miss_rate: tuple[float, float]
    latency_n: float | None
    """Mean detection delay; None: nothing was detected."""
    latency_p95_n: float | None
    bound_n: float | None
    """Mean information bound of the changes that were detected and detectable."""
    error: Mapping[str, float]
    """rms relative error of M, B and K at the end."""
    doubt: str
    """Seed of the first inconclusive trial, with the reason; empty if there is none."""

    @classmethod
    def of(cls, rows: Sequence[Row]) -> Summary:
        counted, sound = counts(rows), valid(rows)
        found = [change for each in sound for change in changes(each)]
        noticed = [change for change in found if change.latency_n is not None]
        latencies = sorted(change.latency_n for change in noticed if change.latency_n is not None)
        bounds = [change.bound_n for change in noticed if change.bound_n is not None]
        errors = [each["errors"] for each in sound if each["errors"]]
        rates = {name: rate.known(counted, CONFIDENCE).bounds for name, rate in RATES.items()}
        return cls(
            **counted,
            trials=len(rows),
            passed=sum(each["outcome"] == "passed" for each in rows),
            failed=sum(each["outcome"] == "failed" for each in rows),
            inconclusive=len(rows) - len(sound),
            false_alarm_rate=rates["false_alarms"],
            late=sum(change.late for change in found),
            miss_rate=rates["missed"],
            latency_n=statistics.fmean(latencies) if latencies else None,
            latency_p95_n=float(latencies[-(-95 * len(latencies) // 100) - 1]) if latencies else None,
            bound_n=statistics.fmean(bounds) if bounds else None,
            error={
                name: statistics.fmean(each[i] ** 2 for each in errors) ** 0.5
                for i, name in enumerate(PARAMETERS)
                if errors
            },
            doubt=next((f"seed {each['seed']}: {each.get('why', '')}" for each in rows if not is_valid(each)), ""),
        )


def label(plan: Plan, cell: Cell) -> dict[str, str]:
    """Labels that identify a cell: rig and device where there are several, and the values of the grid."""
    out = {}
    if len(plan.rigs) > 1:
        out["rig"] = str(plan.rigs[cell.rig]["name"])
    if len(plan.devices) > 1:
        out["device"] = str(plan.devices[cell.device]["name"])
    return out | {axis: f"{value:g}" for axis, value in cell.values.items()}


def anytime_text(counted: Mapping[str, int]) -> str:
    """Rates of the events that ``rows.counts`` counts, with bounds, in one line."""
    parts = []
    for name, rate in RATES.items():
        if counted[rate.exposure]:
            below = rate.known(counted, CONFIDENCE).bounds[1]
            events, exposure = counter_text(counted[name], name), counter_text(counted[rate.exposure], rate.unit)
            parts.append(f"{events} in {exposure} (rate below {below:.2g})")
    return ", ".join(parts)


@dataclass(frozen=True)
class Column:
    """Column of the tables."""

    title: str
    short: str
    """Title where there is little room."""
    form: str
    of: Callable[[Summary], float | None]

    def cell(self, summary: Summary, absent: str) -> str:
        value = self.of(summary)
        return absent if value is None else format(value, self.form)


COLUMNS = (
    Column("trials", "trials", ",", lambda summary: summary.trials),
    Column("failed", "failed", ",", lambda summary: summary.failed),
    Column("inconclusive", "inconcl.", ",", lambda summary: summary.inconclusive),
    Column("missed", "missed", ",", lambda summary: summary.missed),
    Column("visible", "of", ",", lambda summary: summary.visible),
    Column("miss rate at most", "at most", ".2g", lambda summary: summary.miss_rate[1] if summary.visible else None),
    Column("false alarms", "false al.", ",", lambda summary: summary.false_alarms),
    Column(
        "per sample at most",
        "rate below",
        ".2g",
        lambda summary: summary.false_alarm_rate[1] if summary.armed else None,
    ),
    Column("latency", "latency", ".1f", lambda summary: summary.latency_n),
    Column("95th percentile", "p95", ".1f", lambda summary: summary.latency_p95_n),
    Column("bound", "bound", ".1f", lambda summary: summary.bound_n),
)


def text(results: Results) -> str:
    """Results as several lines of text, without a final newline."""
    spec, total = results.plan.spec, results.total()
    cells = results.cells()
    labels = [label(results.plan, cell) for cell, _ in cells]
    names = list(labels[0]) if len(cells) > 1 else []
    counts = ((len(cells), "cell"), (total.trials, "trial"), (total.samples, "sample"))
    head = f"campaign {spec.name}: {', '.join(number_of(*each) for each in counts)}: "
    rows = [[*names, *(column.short for column in COLUMNS)]]
    rows += [
        [*(each[name] for name in names), *_numbers(summary)] for each, (_, summary) in zip(labels, cells, strict=True)
    ]
    if len(cells) > 1:
        rows.append([*("all" if name == names[0] else "" for name in names), *_numbers(total)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(value.rjust(width) for value, width in zip(row, widths, strict=True)) for row in rows]
    notes = [f"bounds at {CONFIDENCE:.0%}, whenever the campaign ended; latency, p95 and bound in samples"]
    if total.inconclusive:
        notes.append(f"{number_of(total.inconclusive, 'trial')} inconclusive, such as {total.doubt}")
    return "\n".join(
        [head + results.outcome().upper(), "", *(f"  {line}" for line in lines), "", *(f"  {note}" for note in notes)]
    )


def as_json(results: Results) -> dict[str, Any]:
    """Results as plain values; rates as [low, high]."""
    cells = [{**label(results.plan, cell), **vars(summary)} for cell, summary in results.cells()]
    return {
        "campaign": results.plan.spec.name,
        "outcome": results.outcome(),
        "total": vars(results.total()),
        "cells": cells,
    }


def _numbers(summary: Summary) -> list[str]:
    return [column.cell(summary, "-") for column in COLUMNS]
