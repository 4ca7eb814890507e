"""Evidence pages of the documentation site, one a theme, written from the figures of build/bench.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

FOLDER = Path("harness/docs/evidence")

TITLES: Mapping[str, str] = {
    "engine": "Speed of the engine, beside ngspice",
    "link": "Speed of the links",
    "adapters": "Speed of the adapters",
    "detection": "Detection on the thesis's profile",
    "statistics": "Detection delay and false alarms of simulated plants",
    "isolation": "Isolation",
    "trials": "Closed-loop trials and certificates",
    "calibration": "Calibration of drawn rigs",
    "self-test": "Self-test of drawn rigs",
    "onset": "Dating of changes",
    "properties": "False failures of the shipped properties",
}
"""Page titles by the name of the benchmark."""


def write(theme: str, entries: Iterable[Mapping[str, Any]], folder: Path = FOLDER) -> Path:
    """Write the page of a theme and return its path.

    entries: figures of the theme as in build/bench.json, with ``measured`` (date, commit).
    """
    path = folder / f"{theme}.md"
    rows = [_row(entry) for entry in entries]
    lines = [
        f"# {TITLES[theme]}",
        "",
        f"Written by `make bench ARGS={theme}`. Two shared x86-64 cores.",
        "",
        "| figure | value | compared with | ratio | bounds | measured |",
        "|---|---|---|---|---|---|",
        *rows,
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _row(entry: Mapping[str, Any]) -> str:
    compared, ratio, bounds = entry.get("compared_with"), entry.get("ratio"), entry.get("bounds")
    cells = (
        entry["name"],
        f"{entry['value']:.4g} {entry['unit']}",
        compared or "",
        "" if ratio is None else f"{ratio:.4g}",
        "" if not bounds else " to ".join(f"{each:.4g}" for each in bounds),
        entry.get("measured", ""),
    )
    return f"| {' | '.join(str(cell).replace('|', '/') for cell in cells)} |"
