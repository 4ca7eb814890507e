"""Evidence pages of the documentation site, one a theme, written from the figures of build/bench.json."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from . import (
    bench_campaign,
    bench_certificates,
    bench_detectors,
    bench_live,
    bench_multipliers,
    bench_programs,
    bench_reality,
    bench_silverbox,
    bench_two_mass,
)

FOLDER = Path("harness/docs/evidence")

TITLES: Mapping[str, str] = {
    "engine": "Speed of the engine, beside ngspice",
    "multipliers": "Speed of programs with multipliers, beside ngspice",
    "link": "Speed of the links",
    "live": "The live bench in real time, and under hostile clients",
    "adapters": "Speed of the adapters",
    "detection": "Detection on the thesis's profile",
    "statistics": "Detection delay and false alarms of simulated plants",
    "isolation": "Isolation",
    "fit": "Watch of the fit",
    "trials": "Closed-loop trials and certificates",
    "two-mass": "Two-mass quarter car",
    "certificates": "Error probabilities of certificates",
    "calibration": "Calibration of drawn rigs",
    "campaign": "Campaigns of many trials",
    "self-test": "Self-test of drawn rigs",
    "onset": "Dating of changes",
    "properties": "False failures of the shipped properties",
    "detectors": "Detectors at the same measured ARL0",
    "reality": "The shipped device under the conditions that users meet",
    "programs": "Random programs, beside scipy and ngspice",
    "silverbox": "Twin of the Silverbox",
}
"""Page titles by the name of the benchmark."""

CROSSED = {"certificates", "detectors", "reality", "silverbox"}
"""Benchmarks whose figures are named ROW: COLUMN, and whose page is a table of these."""

NOTES: Mapping[str, str] = {
    "campaign": bench_campaign.NOTE,
    "certificates": bench_certificates.NOTE,
    "detectors": bench_detectors.NOTE,
    "live": bench_live.NOTE,
    "multipliers": bench_multipliers.NOTE,
    "programs": bench_programs.NOTE,
    "reality": bench_reality.NOTE,
    "silverbox": bench_silverbox.NOTE,
    "two-mass": bench_two_mass.NOTE,
}
"""Paragraphs below the tables."""


def write(theme: str, entries: Iterable[Mapping[str, Any]], folder: Path = FOLDER) -> Path:
    """Write the page of a theme and return its path.

    entries: figures of the theme as in build/bench.json, with ``measured`` (date, commit).
    """
    path = folder / f"{theme}.md"
    title = f"# {TITLES[theme]}"
    origin = f"Written by `make bench ARGS={theme}`. Two shared x86-64 cores."
    table = _crossed(entries) if theme in CROSSED else _listed(entries)
    note = ["", NOTES[theme]] if theme in NOTES else []
    path.write_text("\n".join([title, "", origin, "", *table, *note]) + "\n", encoding="utf-8")
    return path


def _listed(entries: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Table with a row for each figure."""
    yield "| figure | value | compared with | ratio | bounds | measured |"
    yield "|---|---|---|---|---|---|"
    for entry in entries:
        ratio = entry.get("ratio")
        yield _row(
            entry["name"],
            _value(entry),
            entry.get("compared_with") or "",
            "" if ratio is None else f"{ratio:.4g}",
            _bounds(entry),
            entry.get("measured", ""),
        )


def _crossed(entries: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Table of the figures named ROW: COLUMN."""
    rows: dict[str, dict[str, str]] = {}
    for entry in entries:
        row, _, column = entry["name"].partition(": ")
        details = ", ".join(each for each in (_bounds(entry), entry.get("compared_with")) if each)
        rows.setdefault(row, {})[column] = f"{_value(entry)} ({details})" if details else _value(entry)
        rows[row]["measured"] = entry.get("measured", "")
    columns = dict.fromkeys(column for cells in rows.values() for column in cells if column != "measured")
    yield _row("", *columns, "measured")
    yield "|---" * (len(columns) + 2) + "|"
    for name, cells in rows.items():
        yield _row(name, *(cells.get(column, "") for column in (*columns, "measured")))


def _value(entry: Mapping[str, Any]) -> str:
    return f"{entry['value']:.4g} {entry['unit']}"


def _bounds(entry: Mapping[str, Any]) -> str:
    return " to ".join(f"{each:.4g}" for each in entry.get("bounds") or ())


def _row(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"
