"""Chapters of the page and of ``claims.json``: texts from TOML, numbers from the experiments."""

from __future__ import annotations

import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.config import read_toml

Signal = NDArray[np.float64]
"""(n,)"""

Facts = Mapping[str, Any]
"""Measured values by name."""

Table = dict[str, Any]
"""Texts by name, as in the TOML files."""


class Mark(NamedTuple):
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
class Chapter:
    """One chapter with its texts filled in, its signals and its measured values.

    The introduction, the texts of figures and the reasons of claims are HTML.
    """

    number: int
    title: str
    introduction: str
    figures: Mapping[str, Table]
    """Figures of the thesis, and ours beside them, by number; ours end in a letter."""
    drawings: Mapping[str, Drawing]
    """Signals by number of the figure."""
    numbers: Sequence[Table]
    """Printed numbers, with our values."""
    errata: Sequence[Table]
    """Slips of the printed text."""
    claims: Sequence[Table]
    """Quoted sentences with our verdicts, the reasons, and the values behind them."""


def load_chapter(number: int, facts: Facts, drawings: Mapping[str, Drawing], measured: Mapping[str, Facts]) -> Chapter:
    """Read ``chapterN.toml`` and fill in its texts.

    :param facts: values for all texts of the chapter, besides the measured values of all claims.
    :param measured: values behind each claim, by identifier; its own text needs no identifier for them.
    :raises KeyError: a text, figure or claim has no value.
    """
    table = read_toml(Path(__file__).parent / f"chapter{number}.toml")
    known = {**facts, **measured}
    claims = {ident: _fill(claim, {**known, **measured[ident]}) for ident, claim in table.pop("claims").items()}
    numbers = [
        {**dict(zip(("where", "name", "printed", "ours", "unit", "note"), row, strict=True)), "printed": float(row[2])}
        for row in table.pop("numbers", ())
    ]
    for each in numbers:
        each["ours"] = float(_Template().get_field(each["ours"], (), facts)[0])
        each["deviation"] = each["ours"] / each["printed"] - 1.0
    panels = {key: {**panel, "curves": table["curves"][panel["curves"]]} for key, panel in table["panels"].items()}
    figures = {
        number: {**_fill(figure, known), "panels": [panels[key] for key in figure["panels"]]}
        for number, figure in table["figures"].items()
    }
    return Chapter(
        number,
        table["title"],
        _fill(table["introduction"], known),
        figures,
        {number: drawings[number] for number in figures},
        numbers,
        [{"where": where, **_fill(erratum, known)} for where, erratum in table["errata"].items()],
        [
            {"ident": ident, **claim, "figures": claim.get("figures", []), "measured": measured[ident]}
            for ident, claim in claims.items()
        ],
    )


class _Template(string.Formatter):
    """``str.format`` that also formats None, and sequences and mappings element by element.

    The format ``counts`` gives missed changes and extra alarms in words.
    """

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Look up a fact, whose name may have dots, and then its attributes and items."""
        head, bracket, rest = field_name.partition("[")
        if head in kwargs:
            return super().get_field(f"fact{bracket}{rest}", (), {"fact": kwargs[head]})
        return super().get_field(field_name, args, kwargs)

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec == "counts":
            return f"{value['missed']} missed, {value['extra_alarms']} extra"
        if isinstance(value, Mapping):
            return "; ".join(f"{key}: {self.format_field(each, format_spec)}" for key, each in value.items())
        if isinstance(value, list | tuple):
            return ", ".join(self.format_field(each, format_spec) for each in value)
        if value is None:
            return "–" if format_spec.endswith("%") else "never"
        return format(value, format_spec)


def _fill(item: Any, facts: Facts) -> Any:
    """Return texts, or a table or list of them, filled in."""
    if isinstance(item, dict):
        return {key: _fill(each, facts) for key, each in item.items()}
    if isinstance(item, list):
        return [_fill(each, facts) for each in item]
    return _Template().vformat(item, (), facts)
