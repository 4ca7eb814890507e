"""Scales of the samples in a log, compared with those that the scenario's machine yields."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from analogrig.wording import number_of

Values = NDArray[np.float64]

_LEAST = 16
"""Samples from which on a scale is compared."""

_LEAST_SWING = 40.0
"""Codes over which the expected values must move: noise has no scale."""

_LEAST_EDGES = 3
"""Crossings of the mean after which an excitation has shown all its levels, whatever its phase."""

_ALIKE = 0.98
"""Correlation from which on two courses are the same."""

_ERRORS = (0.05, 0.2)
"""Relative errors of scale and offset of u and y that need a word: real parts may differ from the scenario's."""

_LEAST_SHARE = 0.05
"""Share of the expected swing below which quantisation and noise hide the course of a quantity that is scaled."""

_THAN = ("the excitation of the scenario", "the output that the rig plays")


def scale_findings(names: tuple[str, str], logged: Values, expected: Values) -> Iterator[str]:
    """Sentences on quantities that are scaled, turned round, shifted or at rest in a log.

    :param names: signals of u and y, as ``Message.Signal``.
    :param logged: (n, 2) codes in the log.
    :param expected: (n, 2) codes of the scenario on the rig. The phase of its excitation may be another.
    """
    lag = _lag(logged[:, 0], expected[:, 0]) if len(logged) >= _LEAST else None
    if len(logged) >= _LEAST and lag is None and _lag(logged[:, 1], expected[:, 0]) is not None:
        yield f"{names[1]} follows {_THAN[0]}, {names[0]} does not: are u and y exchanged?"
        return
    n = len(logged) - abs(lag or 0)
    aligned = logged[max(0, lag or 0) :][:n], expected[max(0, -(lag or 0)) :][:n]
    for column, name in enumerate(names):
        here, there = (each[:, column] for each in aligned)
        if n < _LEAST or np.ptp(there) < _LEAST_SWING:
            continue
        has_edges = np.count_nonzero(np.diff(there > np.mean(there))) >= _LEAST_EDGES
        if not np.ptp(here):
            if lag is not None or has_edges:
                yield f"{name} is at code {here[0]:.0f} in all {len(here)} samples, while {_THAN[column]} moves"
        elif lag is not None:
            yield from _compare(name, here, there, column)
        elif not column and has_edges:
            yield from _compare_levels(name, here, there)


def _lag(logged: Values, expected: Values) -> int | None:
    """Samples by which the logged excitation is late; None if it is another one."""
    if abs(_correlation(logged, expected)) > _ALIKE:
        return 0
    half = len(logged) // 2
    lags = [*range(1, half), *range(-1, -half, -1)]
    pairs = [(logged[max(0, lag) :], expected[max(0, -lag) :]) for lag in lags]
    alike = [_correlation(one[: len(other)], other[: len(one)]) for one, other in pairs]
    best = int(np.argmax(alike)) if alike else 0
    return lags[best] if alike and alike[best] > _ALIKE else None


def _correlation(one: Values, other: Values) -> float:
    return float(np.corrcoef(one, other)[0, 1]) if np.ptp(one) and np.ptp(other) else 0.0


def _compare(name: str, here: Values, there: Values, column: int) -> Iterator[str]:
    correlation, than = _correlation(here, there), _THAN[column]
    if correlation < -_ALIKE:
        yield f"{name} is turned round: its correlation with {than} is {correlation:.3f}; wrong sign?"
    elif correlation > _ALIKE:
        factor, offset = (float(each) for each in np.polyfit(there, here, 1))
        shift = offset + (factor - 1.0) * float(np.mean(there))
        if abs(factor - 1.0) > _ERRORS[column]:
            yield f"{name} is {factor:.3f} times {than}, in {len(here)} samples: is it scaled as in the DBC?"
        elif abs(shift) > _ERRORS[column] * float(np.ptp(there)):
            side = "above" if shift > 0 else "below"
            yield f"{name} is {abs(shift):.0f} codes {side} {than}: is its offset that of the DBC?"
    elif np.ptp(here) < _LEAST_SHARE * np.ptp(there):
        moves = number_of(round(float(np.ptp(here))), "code")
        by = f"{than} by {np.ptp(there):.0f}, in {len(here)} samples"
        yield f"{name} moves by {moves}, {by}: is it scaled as in the DBC?"


def _compare_levels(name: str, here: Values, there: Values) -> Iterator[str]:
    """Compare an excitation of another course by its lowest and highest values."""
    (low, high), (low_e, high_e) = (np.percentile(each, (5, 95)) for each in (here, there))
    if abs((high - low) / (high_e - low_e) - 1.0) > _ERRORS[0] or abs(low - low_e) > _ERRORS[0] * (high_e - low_e):
        levels = f"codes {low:.0f} to {high:.0f}, that of the scenario {low_e:.0f} to {high_e:.0f}"
        yield f"{name} has another course than {_THAN[0]}: {levels}; another scenario, or another reading of its bits?"
