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

from analogrig.storage import replace_file
from analogrig_thesis import chapter3, chapter4, chapter5
from analogrig_thesis.circuit_runs import RECORDED, CircuitRuns, play_circuit
from analogrig_thesis.document import ReproducedChapter, Signal
from analogrig_thesis.rendering import render
from analogrig_thesis.scheme_comparison import SchemeComparison, compare

FORMAT, VERSION = "analogrig-thesis", 1

PAGE, CLAIMS, RECORDINGS = "thesis.html", "claims.json", "recordings"

FILES = (CLAIMS, *(f"{RECORDINGS}/{name}.npz" for name in (*RECORDED, "simulated")))
"""Files beside the page."""

DIGITS = 6
"""Significant digits of every value in claims.json; the rest is rounding."""


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Results of ``analogrig thesis``."""

    chapters: tuple[ReproducedChapter, ...]
    comparison: SchemeComparison
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
            "figures": [figure.number for chapter in self.chapters for figure in chapter.text.figures],
            "numbers": [
                {**vars(number), "ours": ours, "deviation": ours / number.printed - 1.0}
                for chapter in self.chapters
                for number, ours in zip(chapter.text.numbers, chapter.numbers, strict=True)
            ],
            "errata": [vars(erratum) for chapter in self.chapters for erratum in chapter.text.errata],
            "claims": [
                {**vars(claim), "measured": chapter.measured[claim.ident]}
                for chapter in self.chapters
                for claim in chapter.text.claims
            ],
            "comparison": vars(self.comparison),
        }
        return json.dumps(_plain(table), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def reproduce() -> Reproduction:
    """Simulate, play, estimate and judge; deterministic, some ten seconds.

    :raises ConfigurationError: a file of texts is not valid.
    :raises DeviceError, LinkError, RigError: the circuit could not be played.
    """
    example, simulation, circuit = chapter3.play_example(), chapter4.simulate(), play_circuit()
    return Reproduction(
        (
            chapter3.reproduce_chapter(example),
            chapter4.reproduce_chapter(simulation),
            chapter5.reproduce_chapter(circuit),
        ),
        compare(simulation, circuit),
        circuit,
        {**chapter3.simulated_data(example), **chapter4.simulated_data(simulation)},
    )


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
