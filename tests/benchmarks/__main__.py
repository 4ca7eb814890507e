"""All benchmarks, or those named: prints one table and writes build/bench.json.

python -m tests.benchmarks [NAME ...]

bench.json is a list of {name, value, unit, compared_with, ratio, bounds}; earlier figures of other names stay.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from . import (
    bench_calibration,
    bench_detection,
    bench_engine,
    bench_isolation,
    bench_link,
    bench_onset,
    bench_properties,
    bench_self_test,
    bench_statistics,
    bench_trials,
)
from .figure import Figure

RESULTS = Path("build/bench.json")

BENCHES: Mapping[str, Callable[[], Iterator[Figure]]] = {
    "engine": bench_engine.figures,
    "link": bench_link.figures,
    "detection": bench_detection.figures,
    "statistics": bench_statistics.figures,
    "isolation": bench_isolation.figures,
    "trials": bench_trials.figures,
    "calibration": bench_calibration.figures,
    "self-test": bench_self_test.figures,
    "onset": bench_onset.figures,
    "properties": bench_properties.figures,
}


def keep(measured: Sequence[Figure], path: Path = RESULTS) -> None:
    """Put the figures into the file, in place of older ones of the same name."""
    older = json.loads(path.read_text()) if path.exists() else []
    names = {figure.name for figure in measured}
    kept = [entry for entry in older if entry["name"] not in names]
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(kept + [asdict(figure) for figure in measured], indent=1) + "\n")


def main(names: Sequence[str]) -> None:
    unknown = [name for name in names if name not in BENCHES]
    if unknown:
        sys.exit(f"no benchmark is called {', '.join(unknown)}; there are {', '.join(BENCHES)}")
    for name in names or BENCHES:
        measured = []
        for figure in BENCHES[name]():
            print(figure, flush=True)
            measured.append(figure)
        keep(measured)


if __name__ == "__main__":
    main(sys.argv[1:])
