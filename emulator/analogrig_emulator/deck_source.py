"""What the sources of a deck do: DC, a constant; PULSE and PWL, levels that step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TypeAlias

from .errors import CircuitError

__all__ = ["LONGEST_STEP_S", "Step", "split_source", "steps"]

MAX_EDGES = 1_000_000

LONGEST_STEP_S = 1e-9
"""Rise time up to which a source counts as stepping."""

Step: TypeAlias = tuple[float, float]
"""(instant in s, level from then on)."""


def split_source(words: Sequence[str]) -> tuple[str, str | None, Sequence[str]]:
    """The constant level, the shape (pulse or pwl, or none) and the shape's numbers, of the words behind the nodes.

    Raises CircuitError for other shapes.
    """
    dc = "0"
    while words:
        word = words[0].lower()
        if word in {"pulse", "pwl"}:
            return dc, word, words[1:]
        if word == "dc":
            words = words[1:]
        elif word.isalpha():
            raise CircuitError(f"{word.upper()} sources are not supported; there are DC, PULSE and PWL")
        dc, words = (words[0] if words else "0"), words[1:]
    return dc, None, ()


def steps(shape: str, numbers: Sequence[float], stop_s: float) -> tuple[Step, ...]:
    """The levels of a source, the first from 0 s on, until stop_s.

    Raises CircuitError for a level that ramps, for instants out of order, and for more than MAX_EDGES edges.
    """
    return tuple(_pwl(numbers, stop_s) if shape == "pwl" else _pulse(numbers, stop_s))


def _pwl(numbers: Sequence[float], end_s: float) -> Iterator[Step]:
    points = list(zip(numbers[::2], numbers[1::2], strict=False))
    if not points or len(numbers) % 2 or points[0][0] < 0:
        raise CircuitError("PWL needs pairs of an instant, from 0 s on, and a level")
    yield 0.0, points[0][1]
    for (start_s, before), (stop_s, after) in pairwise(points):
        if stop_s <= start_s:
            raise CircuitError(f"PWL: {stop_s:g} s does not come after {start_s:g} s")
        if before != after:
            _check_step(stop_s - start_s)
            if start_s <= end_s:
                yield start_s, after


def _pulse(numbers: Sequence[float], stop_s: float) -> Iterator[Step]:
    if not 5 <= len(numbers) <= 7:
        raise CircuitError("PULSE needs two levels, delay, rise, fall, and may have width and period")
    low, high, delay_s, rise_s, fall_s = numbers[:5]
    width_s = numbers[5] if len(numbers) > 5 else math.inf
    period_s = numbers[6] if len(numbers) > 6 else math.inf
    _check_step(rise_s)
    _check_step(fall_s)
    if delay_s < 0 or width_s < 0 or not period_s >= rise_s + width_s + fall_s:
        raise CircuitError(
            "PULSE: its delay and width must not be negative, and its period must hold rise, width and fall"
        )
    if 2 * (stop_s - delay_s) / period_s > MAX_EDGES:
        raise CircuitError(f"PULSE has more than {MAX_EDGES} edges")
    yield 0.0, low
    cycle = 0
    while (start_s := delay_s + (cycle * period_s if cycle else 0.0)) <= stop_s:
        yield start_s, high
        if start_s + rise_s + width_s <= stop_s:
            yield start_s + rise_s + width_s, low
        cycle += 1


def _check_step(rise_s: float) -> None:
    if not 0 < rise_s <= LONGEST_STEP_S:
        raise CircuitError(f"a source must step: within {LONGEST_STEP_S:g} s, but not in 0 s; got {rise_s:g} s")
