"""Reproduction of all chapters, and its files."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from analogrig import judge
from analogrig.output import replace_file
from analogrig_thesis import chapter3, chapter4, chapter5
from analogrig_thesis.chapter4 import Simulation
from analogrig_thesis.chapter5 import (
    NOISY,
    RECORDED,
    TRACKING,
    CircuitRuns,
    TrackedRun,
    circuit_schemes,
    filtered_schemes,
    play_alone,
    play_circuit,
)
from analogrig_thesis.models import DEFAULT, OURS, PROFILE, SignalPair, TrackQuality, assess
from analogrig_thesis.rendering import render
from analogrig_thesis.texts import Chapter, Signal, Table

FORMAT, VERSION = "analogrig-thesis", 1

PAGE, CLAIMS, RECORDINGS = "thesis.html", "claims.json", "recordings"

FILES = (CLAIMS, *(f"{RECORDINGS}/{name}.npz" for name in (*RECORDED, "simulated")))
"""Files beside the page."""

TABLES = ("numbers", "errata", "claims")
"""Tables of every chapter in claims.json."""

SEEDS = range(20)

CODES_PER_M = 4096 / 0.1996
"""Scale of the card: 10 V are 0.1996 m."""

DIGITS = 6
"""Significant digits of every value in claims.json; the rest is rounding."""


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Results of ``analogrig thesis``."""

    chapters: tuple[Chapter, ...]
    comparison: Table
    """Quality of all schemes on the same data."""
    circuit: CircuitRuns
    simulated: Mapping[str, Signal]
    """Force and displacement of chapters 3 and 4, by figure."""

    def write(self, folder: Path) -> None:
        """Write the page, the claims and the recordings; page and claims are the same bytes every time.

        :raises RecordingError: a file cannot be written.
        """
        for name, text in ((PAGE, self.page()), (CLAIMS, self.claims())):
            with replace_file(folder / name) as file:
                file.write(text.encode())
        for name, run in self.circuit.by_file.items():
            run.save(folder / RECORDINGS / f"{name}.npz")
        with replace_file(folder / RECORDINGS / "simulated.npz") as file:
            np.savez_compressed(file, allow_pickle=False, **self.simulated)

    def page(self) -> str:
        """Return the page as HTML."""
        return render(self.chapters, self.comparison)

    def claims(self) -> str:
        """Return figures, numbers, errata, claims and the comparison as JSON."""
        table = {
            "format": FORMAT,
            "version": VERSION,
            "figures": [number for chapter in self.chapters for number in chapter.figures],
            **{name: [row for chapter in self.chapters for row in getattr(chapter, name)] for name in TABLES},
            "comparison": self.comparison,
        }
        return json.dumps(_plain(table), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def reproduce() -> Reproduction:
    """Simulate, play, estimate and judge; deterministic, some ten seconds.

    :raises DeviceError, LinkError, RigError: the circuit could not be played.
    """
    simulation, circuit = chapter4.simulate(), play_circuit()
    return Reproduction(
        (chapter3.reproduce_chapter(), chapter4.reproduce_chapter(simulation), chapter5.reproduce_chapter(circuit)),
        compare(simulation, circuit),
        circuit,
        {**chapter3.simulate_example(), **chapter4.simulated_data(simulation)},
    )


def compare(simulation: Simulation, circuit: CircuitRuns) -> Table:
    """Quality of all schemes on the same data: the question of section 5.6; deterministic.

    ``data``: quality by key of the scheme, and the first-order bound of the mean latency at a false alarm in 100,000
    samples by change. ``seeds``: figures over many seeds. ``instructions``: of the C a sample on x86-64, counted by
    tests/thesis/cost.py.
    """
    noisy = circuit.noisy
    ours = SignalPair(simulation.u, simulation.y * CODES_PER_M, 1.0 / CODES_PER_M).track(DEFAULT)
    filtered = {key: assess(each, noisy.segments) for key, each in filtered_schemes(noisy.run).items()}
    del filtered["mean-of-magnitudes"]
    played: dict[str, list[TrackQuality]] = {}
    for seed in SEEDS:
        codes = play_alone(NOISY, TRACKING, seed)
        for key, config in circuit_schemes(codes.m_per_unit).items():
            played.setdefault(key, []).append(assess(codes.track(config), noisy.segments))
    return {
        "data": [
            _compared("simulation, no noise", {**simulation.qualities, OURS: assess(ours, PROFILE)}),
            _compared("circuit, 12 bits, no noise", circuit.quantised.qualities, circuit.quantised),
            _compared("circuit, 12 bits, 1 LSB of noise", noisy.qualities, noisy),
            _compared(
                "the same, filtered off line at 5 Hz and detrended as in section 4.3, which only the thesis needs",
                filtered,
            ),
        ],
        "seeds": {key: _summarise(each) for key, each in played.items()},
        "instructions": json.loads((Path(__file__).parent / "cost.json").read_text(encoding="utf-8"))["instructions"],
    }


def _compared(name: str, qualities: Mapping[str, TrackQuality], tracked: TrackedRun | None = None) -> Table:
    bound_n = [] if tracked is None else [change.bound_n for change in judge(tracked.run).changes]
    return {"name": name, "schemes": qualities, "bound_n": bound_n}


def _summarise(qualities: Sequence[TrackQuality]) -> Table:
    """Figures of one scheme over many seeds: mean latency of detected changes, median convergence of all."""
    latencies = [n for each in qualities for n in each.latency_n if n is not None]
    settled = [np.inf if n is None else float(n) for each in qualities for n in each.reconverged_n]
    median = float(np.median(settled))
    return {
        "missed": sum(each.missed for each in qualities),
        "changes": len(settled),
        "extra_alarms": sum(each.extra_alarms for each in qualities),
        "samples": len(qualities) * TRACKING.samples,
        "latency_n": float(np.mean(latencies)) if latencies else None,
        "reconverged_n": median if np.isfinite(median) else None,
    }


def _plain(value: Any) -> Any:
    """Return a value in JSON types, numbers to ``DIGITS`` digits, non-finite ones as None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value
