"""What the page and ``claims.json`` are made of: figures, printed numbers, errata and claims. Data only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Signal = NDArray[np.float64]
"""(n,)"""

Ink = Literal["first", "second", "third", "truth"]

Verdict = Literal["holds", "holds with a reading", "does not hold", "not reproduced"]


@dataclass(frozen=True, eq=False)
class Curve:
    """One signal of a panel; NaN where there is nothing to draw."""

    label: str
    values: Signal
    """(n,) as many as the panel's x."""
    ink: Ink = "first"
    style: Literal["line", "step", "dash"] = "line"


@dataclass(frozen=True)
class Mark:
    """A vertical line in every panel of a figure."""

    at: float
    kind: Literal["change", "alarm", "false"]
    label: str = ""


@dataclass(frozen=True, eq=False)
class Panel:
    """One plot."""

    title: str
    y_label: str
    curves: tuple[Curve, ...]
    x: Signal | None = None
    """(n,) increasing; the index of the sample when it is not given."""
    x_label: str = "sample"
    log_x: bool = False
    shown: tuple[float, float] | None = None
    """The vertical range to begin with: transients would otherwise squash the rest."""


@dataclass(frozen=True, eq=False)
class Figure:
    """One figure of the thesis, or one of ours that sets something beside it."""

    number: str
    """As in the thesis; ours have a letter."""
    title: str
    """As in the thesis."""
    panels: tuple[Panel, ...]
    text: str
    """What it shows, and what had to be assumed; HTML of ours."""
    marks: tuple[Mark, ...] = ()


@dataclass(frozen=True)
class Number:
    """A printed number beside ours."""

    where: str
    name: str
    printed: float | None
    ours: float
    unit: str = ""
    note: str = ""

    @property
    def deviation(self) -> float | None:
        """Of ours from the printed one, relative to that."""
        return None if not self.printed else self.ours / self.printed - 1.0


@dataclass(frozen=True)
class Erratum:
    """A slip of the printed text."""

    where: str
    printed: str
    right: str
    derivation: str


@dataclass(frozen=True)
class Claim:
    """A sentence of the thesis, and what became of it."""

    ident: str
    where: str
    quote: str
    verdict: Verdict
    because: str
    """In a sentence or two; with a reading: which. HTML of ours."""
    measured: Mapping[str, Any]
    """The figures behind it, in plain values."""
    figures: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Chapter:
    """The experiments of one chapter."""

    number: int
    title: str
    introduction: str
    figures: tuple[Figure, ...]
    numbers: tuple[Number, ...]
    errata: tuple[Erratum, ...]
    claims: tuple[Claim, ...]
