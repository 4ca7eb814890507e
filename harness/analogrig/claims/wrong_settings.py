"""Other configurations of the estimator, one setting at a time; and hypotheses with a number that is fitted."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from analogrig.claims.answered import DeviceAnswers
from analogrig.claims.feed import Feed, Library, library_of
from analogrig.claims.sample_faults import Suspect, changed
from analogrig.estimator_config import EstimatorConfig

_VALUES: Mapping[str, Sequence[Any]] = {
    "forgetting": (0.9, 0.95, 0.97, 0.98, 0.985, 0.99, 0.992, 0.994, 0.995, 0.996, 0.997, 0.998, 0.999, 0.9995, 1.0),
    "noise_variance": (0.1, 0.25, 0.5, 1.0, 1.0954451, 1.2, 1.44, 2.0, 2.4, 4.0, 5.0, 10.0, 12.0, 100.0),
    "p0": (0.01, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4, 1e6),
    "p0_offset": (1.0, 10.0, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8),
    "edge_codes": (1.0, 4.0, 6.4, 8.0, 10.0, 16.0, 32.0, 50.0, 64.0, 100.0, 128.0, 200.0, 256.0, 512.0, 640.0, 1024.0),
    "refresh_n": (0, 1, 10, 20, 39, 40, 41, 50, 80, 100, 200, 400, 1000),
    "stuck_n": (0, 4, 8, 16, 32, 64),
    "idle_n": (0, 10, 100, 200, 500, 1000, 2000, 10_000),
    "random_walk": (0.0, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3),
    "warm_up_n": (0, 1, 10, 38, 50, 55, 100, 150, 200, 250, 300, 400, 500, 549, 550, 551, 600, 1000, 2000, 5500),
    "hold_off_n": (0, 1, 2, 4, 5, 8, 10, 16, 20, 50, 100, 200, 500),
    "edge_instants": ("locked", "may-slip", "anywhere"),
    "reset": ("covariance", "all"),
    "noise_estimated": (False, True),
    "absolute": (False, True),
    "nk": (0, 1),
    "offset": (False, True),
    "trigger": ("none", "prediction-error", "mean-between-faults", "cusum"),
    "c": ((0.0, 0.0), (-1.6, 0.64), (-1.8, 0.81), (-1.0, 0.25), (0.64, -1.6), (1.6, 0.64), (-0.8, 0.0)),
    "code_low": (-1e6, -1.0, 0.0, 1.0),
    "code_high": (1e6, 4096.0, 4095.0, 4094.0, 4000.0, 2048.0, 1024.0),
}

_ARL0, _CEILINGS = (1e2, 1e3, 1e4, 5e4, 1e5, 2e5, 1e6, 1e7, 1e8), (0.1, 0.5, 2.0, 10.0)
"""Rates whose ceilings are tried, and multiples of the ceiling."""


def setting_hypotheses(config: EstimatorConfig) -> Iterator[Suspect]:
    """Hypotheses about the configuration of the estimator."""
    default = EstimatorConfig()
    others = {each.name: getattr(default, each.name) for each in dataclasses.fields(default) if each.name != "orders"}
    if any(getattr(config, name) != value for name, value in others.items()):
        yield Suspect("EST_CONFIG_DEFAULT instead of the settings in [estimator]", unchanged, others)
    for name, values in _VALUES.items():
        for value in values:
            if value != getattr(config, name):
                given = list(value) if isinstance(value, tuple) else value
                yield Suspect(f"{name} = {given} instead of {getattr(config, name)}", unchanged, {name: value})
    ceiling = config.statistic_ceiling
    if config.trigger == "none" or ceiling is None:
        return
    others_of = {math.log(arl0): f": that of arl0 = {arl0:g}" for arl0 in _ARL0}
    for value, which in (others_of | {factor * ceiling: "" for factor in _CEILINGS}).items():
        cause = f"ceiling = {value:.6g} instead of {ceiling:.6g}{which}"
        yield Suspect(cause, unchanged, {"ceiling": value, "arl0": None})


def unchanged(feed: Feed) -> Feed:
    return feed


# ------------------------------------------------------------------------------------------------------ fitted numbers

_WINDOW_N = 600
"""Samples after the first difference that the numbers are fitted to."""

_GRID, _ROUNDS = 21, 7
"""Values in each round, and rounds; each narrows the range to the two neighbours of the best."""

_DIGITS = (1, 2, 3, 4, 5)
"""Numbers of digits to which a fitted number is rounded, the fewest first."""

Range = tuple[float, float]

_FITTED: Mapping[str, Range] = {
    "forgetting": (-5.0, -1.0),
    "noise_variance": (-4.0, 4.0),
    "p0": (-6.0, 6.0),
    "p0_offset": (-3.0, 8.0),
    "edge_codes": (-1.0, 3.5),
    "ceiling": (-1.0, 3.0),
}
"""Settings that are fitted, with the range of the decimal logarithms of their values."""


def fitted(answered: DeviceAnswers, library: Library, feed: Feed) -> Iterator[Suspect]:
    """Hypotheses whose number is fitted, with few digits, and as it is."""
    n = min(len(answered.values), answered.first_difference(library.replay(feed)) + _WINDOW_N)
    shown, short = answered.upto(n), feed.upto(n)
    for names in (("u",), ("y",), ("u", "y")):
        yield from _best(functools.partial(_scaled, names), (-1.5, 1.5), _exponential, shown, short, library)
        yield from _best(functools.partial(_shifted, names), (-2100.0, 2100.0), float, shown, short, library)
    for name, span in _FITTED.items():
        yield from _best(functools.partial(_set, library.config, name), span, _exponential, shown, short, library)


def _exponential(logarithm: float) -> float:
    return math.pow(10.0, logarithm)


def _scaled(names: Sequence[str], factor: float) -> Suspect:
    return Suspect(f"{' and '.join(names)} scaled by {factor:g}", changed(names, lambda x: x * np.float32(factor)))


def _shifted(names: Sequence[str], offset: float) -> Suspect:
    cause = f"{' and '.join(names)} shifted by {offset:g} codes"
    return Suspect(cause, changed(names, lambda x: x + np.float32(offset)))


def _set(config: EstimatorConfig, name: str, value: float) -> Suspect:
    """Hypothesis of a setting; forgetting is fitted as what is forgotten."""
    value = 1.0 - value if name == "forgetting" else value
    cause = f"{name} = {value:g} instead of {getattr(config, name)}"
    return Suspect(cause, unchanged, {name: value, "arl0": None} if name == "ceiling" else {name: value})


def _best(
    hypothesis: Callable[[float], Suspect],
    span: Range,
    number: Callable[[float], float],
    answered: DeviceAnswers,
    feed: Feed,
    library: Library,
) -> Iterator[Suspect]:
    """Hypotheses with the number for which the answers deviate least.

    :param span: range that is searched, of which ``number`` makes the number.
    """
    scale = np.abs(answered.values).mean(axis=0) + 1e-9
    low, high = span
    for _ in range(_ROUNDS):
        values, costs = np.linspace(low, high, _GRID), []
        for value in values.tolist():
            suspect = hypothesis(number(value))
            chosen = library_of(library.config, **suspect.settings) if suspect.settings else library
            answers = answered.values if chosen is None else chosen.replay(suspect.alter(feed))
            deviation = np.abs(answered.values - answers) * answered.compared
            costs.append(math.inf if chosen is None else float(np.minimum(deviation / scale, 10.0).sum()))
        at = int(np.argmin(costs))
        low, high = values[max(at - 1, 0)], values[min(at + 1, _GRID - 1)]
    found = number(float((low + high) / 2.0))
    return map(hypothesis, dict.fromkeys(float(f"{found:.{digits}g}") for digits in _DIGITS))
