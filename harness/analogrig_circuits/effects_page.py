"""Effect sizes at 12 bits (command ``effects``) as text, plain values, and a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from analogrig.output import replace_file
from analogrig_emulator.machine.drawing import PALETTE
from analogrig_emulator.nonidealities import SAMPLES, Effect, measure_effects

EffectsBySet = Mapping[str, Sequence[Effect]]
"""Effects by parameter set; each set has the same effects in the same order."""

_FIGURES = ("median_lsb", "largest_lsb", "draws")
_COLOURS = ("var(--first)", "var(--second)")
_STYLE = f"{PALETTE}.effects text{{fill:var(--ink)}}"
_LEAST_LSB, _MOST_LSB = 1e-3, 1e3


def measure(sets: Sequence[str]) -> EffectsBySet:
    """Measure all effects for these parameter sets; the largest first."""
    found = {name: list(measure_effects(name)) for name in sets}
    largest = [max(row.median_lsb for row in rows) for rows in zip(*found.values(), strict=True)]
    order = sorted(range(len(largest)), key=lambda i: -largest[i])
    return {name: [rows[i] for i in order] for name, rows in found.items()}


def as_json(table: EffectsBySet) -> dict[str, Any]:
    """Effects in plain JSON types."""
    sets = {
        name: [{"effect": row.name, **{field: getattr(row, field) for field in _FIGURES}} for row in rows]
        for name, rows in table.items()
    }
    return {"samples": SAMPLES, "unit": "LSB (10 V / 4096)", "sets": sets}


def text(table: EffectsBySet) -> str:
    """Effects as a table for the terminal."""
    width = 2 + max(len(row.name) for rows in table.values() for row in rows)
    lines = [
        f"Largest change of the displacement over {SAMPLES} samples, in LSB of 12 bits over 10 V",
        "(random effects: median over draws)",
        "",
        f"{'':{width}}" + "".join(f"{name:>10}" for name in table) + f"{'draws':>8}",
    ]
    for rows in zip(*table.values(), strict=True):
        figures = "".join(f"{_format_lsb(row.median_lsb):>10}" for row in rows)
        lines.append(f"{rows[0].name:{width}}{figures}{rows[0].draws:>8}")
    return "\n".join(lines)


def _format_lsb(lsb: float) -> str:
    return f"{lsb:.2g}" if lsb < 10 else f"{lsb:.0f}"


def write_picture(table: EffectsBySet, path: Path) -> None:
    """Write the effects as bars on a logarithmic scale, in SVG.

    :raises RecordingError: the file cannot be written.
    """
    row_px, top_px = 10 * len(table) + 8, 56
    names = [row.name for row in next(iter(table.values()))]
    bottom_px = top_px + row_px * len(names)
    height = bottom_px + 48
    size = f'width="760" height="{height}" viewBox="0 0 760 {height}"'
    font = 'font-family="sans-serif" font-size="12"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="effects" role="group" aria-label="effects" {size} {font}>',
        f"<style>{_STYLE}</style>",
        f'<rect width="760" height="{height}" fill="var(--paper)"/>',
        '<text x="16" y="22" font-size="15">What matters at 12 bits: change of the displacement, in LSB</text>',
    ]
    for i, name in enumerate(table):
        parts.append(f'<rect x="{250 + 90 * i}" y="32" width="10" height="10" fill="{_COLOURS[i]}"/>')
        parts.append(f'<text x="{265 + 90 * i}" y="41">{escape(name)}</text>')
    for decade in range(round(math.log10(_LEAST_LSB)), round(math.log10(_MOST_LSB)) + 1):
        x, colour = _x_px(10.0**decade), "var(--line)" if decade else "var(--muted)"
        parts.append(f'<path d="M{x:.1f} {top_px - 6}V{bottom_px - 2}" stroke="{colour}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom_px + 14}" text-anchor="middle">{10.0**decade:g}</text>')
    middle = (_x_px(_LEAST_LSB) + _x_px(_MOST_LSB)) / 2.0
    title = f"largest change over {SAMPLES} samples [LSB of 12 bits over 10 V], logarithmic"
    parts.append(f'<text x="{middle:.1f}" y="{bottom_px + 36}" text-anchor="middle">{title}</text>')
    parts.append(f'<text x="240" y="{top_px - 15}" text-anchor="end">effect</text>')
    for k, name in enumerate(names):
        y = top_px + row_px * k
        parts.append(f'<text x="240" y="{y + row_px / 2:.1f}" text-anchor="end">{escape(name)}</text>')
        parts += [_bar(rows[k], y + 10 * i, _COLOURS[i]) for i, rows in enumerate(table.values())]
    with replace_file(path) as file:
        file.write("\n".join([*parts, "</svg>", ""]).encode())


def _bar(effect: Effect, y: float, colour: str) -> str:
    left, right = _x_px(_LEAST_LSB), _x_px(effect.median_lsb)
    return (
        f'<rect x="{left:.1f}" y="{y}" width="{right - left:.1f}" height="9" fill="{colour}">'
        f"<title>{escape(effect.name)}: {effect.median_lsb:.3g} LSB</title></rect>"
        f'<text x="{right + 4:.1f}" y="{y + 8.5}" font-size="9">{_format_lsb(effect.median_lsb)}</text>'
    )


def _x_px(lsb: float) -> float:
    """Position on the logarithmic axis, limited to its ends."""
    span = math.log10(_MOST_LSB / _LEAST_LSB)
    return 250.0 + 460.0 * min(max(math.log10(max(lsb, _LEAST_LSB) / _LEAST_LSB) / span, 0.0), 1.0)
