"""Results of a campaign as a table for the terminal and as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analogrig.campaigns.results import Results
from analogrig.campaigns.summary import CONFIDENCE, ERROR_STEP, RATES, Summary
from analogrig.errors import ConfigurationError
from analogrig.storage import replace_file
from analogrig.wording import counter_text, number_of

_MARK, _FORMAT = b'data-page="analogrig-campaign"', b'"format": "analogrig-campaign"'
"""Markers that identify the page and the aggregated results of a campaign."""

BOUNDS = f"bounds at {CONFIDENCE:.0%}, whenever the campaign ended and whatever the dependence within a trial"
"""Note on the bounds in the tables."""


def labelled(results: Results) -> list[tuple[dict[str, str], Summary]]:
    """Cells with the labels that identify them: rig and device where there are several, and the values of the grid."""
    plan, out = results.plan, []
    for cell, summary in results.cells:
        labels = {"rig": str(plan.rigs[cell.rig]["name"])} if len(plan.rigs) > 1 else {}
        labels |= {"device": str(plan.devices[cell.device]["name"])} if len(plan.devices) > 1 else {}
        out.append((labels | {axis: f"{value:g}" for axis, value in cell.values.items()}, summary))
    return out


def counts_text(counted: Mapping[str, int]) -> str:
    """Events so far, with their exposures, in one line."""
    parts = []
    for name, rate in RATES.items():
        if counted[rate.exposure]:
            parts.append(f"{counter_text(counted[name], name)} in {counter_text(counted[rate.exposure], rate.unit)}")
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
    Column("late", "late", ",", lambda summary: summary.late),
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
    spec, total = results.plan.spec, results.total
    cells = labelled(results)
    names = list(cells[0][0]) if len(cells) > 1 else []
    counts = ((len(cells), "cell"), (total.trials, "trial"), (total.samples, "sample"))
    head = f"campaign {spec.name}: {', '.join(number_of(*each) for each in counts)}: "
    rows = [[*names, *(column.short for column in COLUMNS)]]
    rows += [[*(labels[name] for name in names), *_numbers(summary)] for labels, summary in cells]
    if len(cells) > 1:
        rows.append([*("all" if name == names[0] else "" for name in names), *_numbers(total)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(value.rjust(width) for value, width in zip(row, widths, strict=True)) for row in rows]
    notes = [f"{BOUNDS}; latency, p95 and bound in samples"]
    if total.inconclusive:
        notes.append(f"{number_of(total.inconclusive, 'trial')} inconclusive, such as {total.doubt}")
    return "\n".join(
        [head + results.outcome.upper(), "", *(f"  {line}" for line in lines), "", *(f"  {note}" for note in notes)]
    )


def as_json(results: Results) -> dict[str, Any]:
    """Results as plain values; rates as [low, high]."""
    cells = [{**labels, **vars(summary)} for labels, summary in labelled(results)]
    found = results.distribution
    return {
        "format": "analogrig-campaign",
        "campaign": results.plan.spec.name,
        "outcome": results.outcome,
        "total": vars(results.total),
        "latency_n": {
            "values": results.latencies.values.tolist(),
            "counts": results.latencies.counts.tolist(),
        },
        "errors": {
            "step": ERROR_STEP,
            "counts": dict(zip(results.plan.estimates, found.errors.tolist(), strict=False)),
        },
        "drawn": {
            "axes": {axis: list(ends) for axis, ends in found.axes.items()},
            **{name: getattr(found, name).tolist() for name in ("visible", "missed", "detected", "latency_n")},
        },
        "cells": cells,
    }


def _numbers(summary: Summary) -> list[str]:
    return [column.cell(summary, "-") for column in COLUMNS]


def places_of(out: Path) -> tuple[Path, Path]:
    """Paths of the aggregated results and of the page, beside the trials.

    :raises ConfigurationError: something else stands at one of them, or the trials themselves would.
    """
    if not out.name or (out.exists() and not out.is_file()):
        raise ConfigurationError(f"--out {out}: is no file that results could be written to")
    for path, mark, what in ((out.with_suffix(".json"), _FORMAT, "results"), (out.with_suffix(".html"), _MARK, "page")):
        if path == out:
            raise ConfigurationError(f"--out {out}: the {what} of the campaign is to be called so: choose another name")
        try:
            is_free = not path.exists() or mark in path.read_bytes()
        except OSError as error:
            raise ConfigurationError(f"{path}: {error.strerror or error}") from error
        if not is_free:
            raise ConfigurationError(f"{path}: is no {what} of a campaign: choose another --out, or remove it")
    return out.with_suffix(".json"), out.with_suffix(".html")


def write_json(results: Results, path: Path) -> None:
    """Write the aggregated results. Equal plans give equal bytes.

    :raises RecordingError: the file cannot be written.
    """
    with replace_file(path) as file:
        file.write(f"{json.dumps(as_json(results), indent=1)}\n".encode())
