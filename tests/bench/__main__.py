"""Benchmarks, all or those named: print one table, write build/bench.json and the evidence pages of the site.

python -m tests.bench [NAME [OPTION ...] ...]

Options follow the name of a benchmark that has some: "reality --rows hum,drift", "statistics random-plants". With
--quick nothing is written.

bench.json is a list of {theme, name, value, unit, compared_with, ratio, bounds, measured}; earlier figures of other
names stay. ``measured`` is date and commit.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from . import (
    bench_adapters,
    bench_calibration,
    bench_campaign,
    bench_certificates,
    bench_detection,
    bench_detectors,
    bench_engine,
    bench_fit,
    bench_isolation,
    bench_link,
    bench_live,
    bench_multipliers,
    bench_onset,
    bench_programs,
    bench_properties,
    bench_reality,
    bench_self_test,
    bench_silverbox,
    bench_statistics,
    bench_trials,
    bench_two_mass,
    pages,
)
from .figure import Figure

RESULTS = Path("build/bench.json")

BENCHES: Mapping[str, Callable[..., Iterator[Figure]]] = {
    "engine": bench_engine.figures,
    "multipliers": bench_multipliers.figures,
    "link": bench_link.figures,
    "live": bench_live.figures,
    "adapters": bench_adapters.figures,
    "detection": bench_detection.figures,
    "statistics": bench_statistics.figures,
    "isolation": bench_isolation.figures,
    "fit": bench_fit.figures,
    "trials": bench_trials.figures,
    "two-mass": bench_two_mass.figures,
    "certificates": bench_certificates.figures,
    "calibration": bench_calibration.figures,
    "campaign": bench_campaign.figures,
    "self-test": bench_self_test.figures,
    "onset": bench_onset.figures,
    "properties": bench_properties.figures,
    "detectors": bench_detectors.figures,
    "reality": bench_reality.figures_of,
    "silverbox": bench_silverbox.figures,
    "programs": bench_programs.figures,
}

OPTIONED = {"campaign", "live", "programs", "reality", "statistics"}
"""Benchmarks that take options."""


def keep(theme: str, measured: Sequence[Figure], path: Path = RESULTS) -> list[dict[str, Any]]:
    """Put the figures into the file in place of older ones of the same name; return all entries of the theme."""
    older = json.loads(path.read_text()) if path.exists() else []
    names = {figure.name for figure in measured}
    when = {"theme": theme, "measured": _when()}
    entries = [entry for entry in older if entry["name"] not in names]
    entries += [{**when, **asdict(figure)} for figure in measured]
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(entries, indent=1) + "\n")
    return [entry for entry in entries if entry.get("theme") == theme]


def _when() -> str:
    """Return the date and the commit of the checkout."""
    command = ["git", "describe", "--always", "--dirty"]
    told = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return f"{datetime.now(UTC):%Y-%m-%d} {told}".strip()


def requests(words: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Benchmarks that a command line names, all if none, with their options.

    Ends the program if a word is neither a benchmark nor an option of the one before.
    """
    named: list[tuple[str, list[str]]] = []
    for word in words:
        if word in BENCHES:
            named.append((word, []))
        elif named and named[-1][0] in OPTIONED:
            named[-1][1].append(word)
        else:
            sys.exit(f"no benchmark is called {word}; there are {', '.join(BENCHES)}")
    return named or [(name, []) for name in BENCHES]


def main(words: Sequence[str]) -> None:
    for name, options in requests(words):
        measured = []
        for figure in BENCHES[name](*options):
            print(figure, flush=True)
            measured.append(figure)
        if "--quick" not in options:
            pages.write(name, keep(name, measured))


if __name__ == "__main__":
    main(sys.argv[1:])
