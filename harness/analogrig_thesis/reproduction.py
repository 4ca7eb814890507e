"""All chapters together, and the files that come of them."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from analogrig.storage import replacing
from analogrig_thesis import chapter3, chapter3_claims, chapter4, chapter4_claims, chapter5, chapter5_claims
from analogrig_thesis.comparison import Comparison, as_json, compare
from analogrig_thesis.document import Chapter, Signal
from analogrig_thesis.page import render

FORMAT, VERSION = "analogrig-thesis", 1

PAGE, CLAIMS, RECORDINGS = "thesis.html", "claims.json", "recordings"

FILES = (CLAIMS, *(f"{RECORDINGS}/{name}.npz" for name in (*chapter5.RECORDED, "simulated")))
"""What is written beside the page."""

DIGITS = 6
"""Significant ones of every figure in claims.json: the rest is rounding."""


@dataclass(frozen=True, eq=False)
class Reproduction:
    """What ``analogrig thesis`` knows in the end."""

    chapters: tuple[Chapter, ...]
    comparison: Comparison
    circuit: chapter5.Circuit
    simulated: Mapping[str, Signal]
    """The data of chapters 3 and 4, force and displacement by figure."""

    def write(self, folder: Path) -> None:
        """The page, the claims, and the recordings; page and claims are the same bytes every time.

        :raises RecordingError: a file cannot be written.
        """
        for name, text in ((PAGE, self.page()), (CLAIMS, self.claims())):
            with replacing(folder / name) as file:
                file.write(text.encode())
        for name, run in self.circuit.recordings.items():
            run.save(folder / RECORDINGS / f"{name}.npz")
        with replacing(folder / RECORDINGS / "simulated.npz") as file:
            np.savez_compressed(file, allow_pickle=False, **self.simulated)

    def page(self) -> str:
        return render(self.chapters, self.comparison)

    def claims(self) -> str:
        """As JSON."""
        table = {
            "format": FORMAT,
            "version": VERSION,
            "figures": [figure.number for chapter in self.chapters for figure in chapter.figures],
            "numbers": [
                {**vars(number), "deviation": number.deviation}
                for chapter in self.chapters
                for number in chapter.numbers
            ],
            "errata": [vars(erratum) for chapter in self.chapters for erratum in chapter.errata],
            "claims": [vars(claim) for chapter in self.chapters for claim in chapter.claims],
            "comparison": as_json(self.comparison),
        }
        return json.dumps(_plain(table), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def reproduce() -> Reproduction:
    """Simulate, play, estimate, judge: some ten seconds; deterministic.

    :raises DeviceError, LinkError, RigError: the circuit could not be played.
    """
    example, simulation, circuit = chapter3.Example.play(), chapter4.simulate(), chapter5.play_circuit()
    return Reproduction(
        (
            chapter3.chapter(example, chapter3_claims.claims(example)),
            chapter4.chapter(simulation, chapter4_claims.claims(simulation)),
            chapter5.chapter(circuit, chapter5_claims.claims(circuit)),
        ),
        compare(simulation, circuit),
        circuit,
        {**chapter3.recorded(), **chapter4.recorded(simulation)},
    )


def _plain(value: Any) -> Any:
    """In types that JSON has; figures to so many digits as are not rounding."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value
