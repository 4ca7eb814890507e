"""Synthetic run with every feature of a report, and an independent reader of the page."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from analogrig.judging.verdict import ChangeVerdict, DiagnosisVerdict, SegmentEstimate, Verdict
from analogrig.run import Run
from tests.harness.runs import M_PER_CODE, N_PER_CODE, made_run

from .plants import front

SAMPLES = 1800
PERIOD_S = 0.01
PLANTS = (
    (0, front(115.0, 3021.0, 24500.0)),
    (1200, front(115.0, 3021.0, 18000.0)),
    (1500, front(30.0, 3021.0, 18000.0)),
)
NOTICED, FALSE_ALARM = 1203, 700
CLIPPED = slice(300, 320)


SAID = DiagnosisVerdict("K", right=True, delay_n=17, bound_n=9, onset_error_n=-1, extent=0.75, extent_error=0.0208)


def reported_run() -> Run:
    """Run with two changes (one detected at ``NOTICED``, one missed), a false alarm, and clipping over ``CLIPPED``."""
    force_n = np.where(np.arange(SAMPLES) // 50 % 2, 2900.0, 30.0)
    clipped = np.zeros(SAMPLES, bool)
    clipped[CLIPPED] = True
    run = made_run(force_n, PLANTS, clipped=clipped, alarms=(FALSE_ALARM, NOTICED), theta=_theta())
    rng = np.random.default_rng(1)
    codes = run.codes.copy()
    codes[:, 1] = np.clip(np.round(_displacement_m(force_n) / M_PER_CODE + rng.normal(size=SAMPLES)), 0, 4095)
    codes[:, 2:] = rng.integers(1000, 3000, (SAMPLES, 2))
    statistic = rng.exponential(1.0, SAMPLES).astype(np.float32)
    statistic[[FALSE_ALARM, NOTICED]] = 900.0
    innovation = rng.normal(size=SAMPLES).astype(np.float32)
    innovation[:5] = 500.0  # before convergence
    return replace(run, codes=codes, statistic=statistic, innovation=innovation)


def reported_verdict(run: Run) -> Verdict:
    """Verdict on ``reported_run``, written by hand."""
    return Verdict(
        outcome="failed",
        reasons=("missed 1 of 2 changes",),
        changes=(
            ChangeVerdict(
                *(1200, "K", {"K": 24500.0}, {"K": 18000.0}),
                latency_n=3,
                bound_n=2,
                deadline_n=20,
                diagnosis=SAID,
            ),
            ChangeVerdict(1500, "M", {"M": 115.0}, {"M": 30.0}, latency_n=None, bound_n=4, deadline_n=20),
        ),
        false_alarms=(FALSE_ALARM,),
        estimates=(
            SegmentEstimate(0, 1200, PLANTS[0][1].parameters(), {"M": 113.85, "B": 3021.0, "K": 24745.0}),
            SegmentEstimate(1200, SAMPLES, PLANTS[1][1].parameters(), None),
        ),
        arl0=1e5,
        ceiling=11.5,
        missing_n=20,
        armed_n=SAMPLES - 40,
        after_warm_up_n=SAMPLES,
        theta_hash=run.theta_hash(),
    )


def empty_run() -> Run:
    """Run that ended before its first sample."""
    return made_run(np.zeros(0), PLANTS[:1], samples_asked=100, faults=("the line is dead",))


@dataclass
class Page(HTMLParser):
    """Elements of a page, and the text outside of scripts and styles."""

    source: str
    elements: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    text: str = ""
    raw: dict[str, list[str]] = field(default_factory=lambda: {"script": [], "style": [], "title": []})
    rows: list[list[str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()
        self._open = ""
        self._in_cell = False
        self.feed(self.source)
        self.close()

    def handle_starttag(self, tag: str, attrs: Sequence[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._open = tag
        if tag == "tr":
            self.rows.append([])
        if tag in {"td", "th"}:
            self.rows[-1].append("")
            self._in_cell = True

    def handle_endtag(self, tag: str) -> None:
        self._open = ""
        self._in_cell &= tag not in {"td", "th"}

    def handle_data(self, data: str) -> None:
        if self._open in self.raw:
            self.raw[self._open].append(data)
            return
        self.text += data
        if self._in_cell:
            self.rows[-1][-1] += data

    def row(self, name: str) -> list[str]:
        """The cells of the first row of all tables that begins with ``name``."""
        return next(row for row in self.rows if row[0] == name)

    def value(self, name: str) -> str:
        """Cell beside ``name`` in a table of two columns."""
        (row,) = [row for row in self.rows if len(row) == 2 and row[0] == name]
        return row[1]

    def data(self) -> dict[str, Any]:
        """Data of the plots."""
        (text,) = [raw for raw in self.raw["script"] if raw.startswith("{")]
        data: dict[str, Any] = json.loads(text)
        return data

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Signals as a browser must show them, (n,) each."""
        data = self.data()
        raw = zlib.decompress(base64.b64decode(data["deflated"]))
        out = {}
        for column in data["columns"]:
            dtype = np.dtype(column["type"]).newbyteorder("<")
            size = data["points"] * dtype.itemsize
            out[column["name"]] = column["offset"] + column["scale"] * np.frombuffer(raw[:size], dtype).astype(float)
            raw = raw[size:]
        assert not raw
        return out


def _theta() -> NDArray[np.float64]:
    """The true ARX(2, 3) parameters in codes, sample by sample (SciPy's zero-order hold); at first, and just after the
    first alarm, something far off, as while an estimator converges."""
    theta = np.zeros((SAMPLES, 6))
    for start, plant in PLANTS:
        numerator, denominator, _ = signal.cont2discrete(
            ([1.0], [plant.parameters()["M"], plant.parameters()["B"], plant.parameters()["K"]]), PERIOD_S
        )
        theta[start:, :2] = denominator[1:]
        theta[start:, 2:5] = numerator[0] * N_PER_CODE / M_PER_CODE
    theta[:20, 2:5] *= 0.05
    theta[NOTICED : NOTICED + 20, 2:5] *= 20.0
    return theta


def _displacement_m(force_n: NDArray[np.float64]) -> NDArray[np.float64]:
    plant = PLANTS[0][1]
    system = signal.lti([1.0], [plant.parameters()["M"], plant.parameters()["B"], plant.parameters()["K"]])
    _, x_m, _ = signal.lsim(system, force_n, np.arange(len(force_n)) * PERIOD_S, interp=False)
    return np.asarray(x_m)
