"""Chapters of the page and of ``claims.json``: texts from TOML, numbers from the experiments."""

from __future__ import annotations

import dataclasses
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from analogrig.config import build, read_toml

Signal = NDArray[np.float64]
"""(n,)"""

Facts = Mapping[str, Any]
"""Measured values by name."""

T = TypeVar("T", "Chapter", "Figure", "Erratum", "Claim")

Verdict = Literal["holds", "holds with a reading", "does not hold", "not reproduced"]


@dataclass(frozen=True)
class Curve:
    """Legend entry of a panel."""

    label: str
    ink: Literal["first", "second", "third", "truth"] = "first"
    style: Literal["line", "step", "dash"] = "line"


@dataclass(frozen=True)
class Panel:
    """Axes of one plot."""

    title: str
    y_label: str
    curves: tuple[Curve, ...]
    x_label: str = "sample"
    log_x: bool = False
    shown: tuple[float, float] | None = None
    """Initial vertical range: transients would otherwise squash the rest."""


@dataclass(frozen=True)
class Figure:
    """Texts of one figure of the thesis, or of one of ours beside it."""

    number: str
    """Number in the thesis; ours end in a letter."""
    title: str
    text: str
    """Explanation and assumptions; HTML, a template."""
    panels: tuple[str, ...]
    """Keys of ``Chapter.panels``."""


@dataclass(frozen=True)
class Number:
    """Printed number and the name of the fact beside it."""

    where: str
    name: str
    printed: float
    ours: str
    """Field of the facts, e.g. ``shock.a1``."""
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Erratum:
    """Slip of the printed text; ``right`` and ``derivation`` are templates."""

    where: str
    printed: str
    right: str
    derivation: str


@dataclass(frozen=True)
class Claim:
    """Quoted sentence of the thesis with our verdict."""

    ident: str
    where: str
    quote: str
    verdict: Verdict
    because: str
    """Reason, and the reading if there is one; HTML, a template over the facts and the measured values."""
    figures: tuple[str, ...] = ()


@dataclass(frozen=True)
class Chapter:
    """Texts of one chapter, one TOML file."""

    number: int
    title: str
    introduction: str
    panels: Mapping[str, Panel]
    figures: tuple[Figure, ...]
    errata: tuple[Erratum, ...]
    claims: tuple[Claim, ...]
    numbers: tuple[Number, ...] = ()


@dataclass(frozen=True)
class Mark:
    """Vertical line in every panel of a figure."""

    at: float
    kind: Literal["change", "alarm", "false"]
    label: str = ""


@dataclass(frozen=True, eq=False)
class Drawing:
    """Signals of one figure."""

    panels: Sequence[Sequence[Signal]]
    """Values (n,) of each curve, by panel; NaN leaves a gap."""
    marks: Sequence[Mark] = ()
    x: Signal | None = None
    """(n,) increasing; the sample index if omitted."""


@dataclass(frozen=True, eq=False)
class ReproducedChapter:
    """One chapter with its texts filled in, its signals and its measured values."""

    text: Chapter
    drawings: Mapping[str, Drawing]
    """By number of the figure."""
    numbers: tuple[float, ...]
    """Our value of each of ``text.numbers``."""
    measured: Mapping[str, Facts]
    """Values behind each claim, by identifier."""

    @classmethod
    def load(
        cls, number: int, facts: Facts, drawings: Mapping[str, Drawing], measured: Mapping[str, Facts]
    ) -> ReproducedChapter:
        """Read ``chapterN.toml`` and fill in its texts.

        :param facts: values for all templates of the chapter.
        :raises ConfigurationError: the file has an unknown or missing key.
        :raises KeyError: a template, figure or claim has no value.
        """
        path = Path(__file__).parent / f"chapter{number}.toml"
        text = build(Chapter, read_toml(path), str(path))
        filled = dataclasses.replace(
            _fill(text, facts, "introduction"),
            figures=tuple(_fill(each, facts, "text") for each in text.figures),
            errata=tuple(_fill(each, facts, "right", "derivation") for each in text.errata),
            claims=tuple(_fill(each, {**facts, **measured[each.ident]}, "because") for each in text.claims),
        )
        numbers = tuple(float(_Template().get_field(each.ours, (), facts)[0]) for each in text.numbers)
        return cls(filled, drawings, numbers, measured)


class _Template(string.Formatter):
    """``str.format`` that also formats None, and sequences and mappings element by element."""

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Look up a fact, whose name may have dots, and then its attributes and items."""
        head, bracket, rest = field_name.partition("[")
        if head in kwargs:
            return super().get_field(f"fact{bracket}{rest}", (), {"fact": kwargs[head]})
        return super().get_field(field_name, args, kwargs)

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Mapping):
            return "; ".join(f"{key}: {self.format_field(each, format_spec)}" for key, each in value.items())
        if isinstance(value, list | tuple):
            return ", ".join(self.format_field(each, format_spec) for each in value)
        if value is None:
            return "–" if format_spec.endswith("%") else "never"
        return format(value, format_spec)


def _fill(item: T, facts: Facts, *fields: str) -> T:
    """Return a dataclass with the named fields filled in."""
    filled: dict[str, Any] = {name: _Template().vformat(getattr(item, name), (), facts) for name in fields}
    return dataclasses.replace(item, **filled)
