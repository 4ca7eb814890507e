"""Cases in which the C is compared with the reference, beside those that are shipped."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import Cause
from analogrig.scenario import PotChange, Scenario
from analogrig.testing.properties import cases as shipped
from analogrig.testing.properties.cases import (
    ARMED,
    CHANGES,
    DISPLACED,
    DISPLACED_LATER,
    EARLY,
    FAULTS,
    FAULTY,
    FIXED,
    FREE,
    HEALTHY,
    LATE,
    LOCKED,
    LONG,
    ONE_CLOCK,
    PLANT,
    SHORT_MEMORY,
    SOFTER,
    SOFTER_LATER,
    SQUARE,
    SUCCESSION,
    TWO_B,
    Codes,
    PlayedCase,
    Spoil,
    U,
    Y,
    edges_of,
    gap_from,
    leave_out_before_edges,
    scenario_of,
    strike,
)

RINGING = PLANT | {"B": 900.0}
CREEPING = PLANT | {"B": 3600.0}
"""Plants with complex poles, and with poles far apart."""

LARGE = {
    "M falls by half": ("M", 70.0, 35.0),
    "M doubles": ("M", 35.0, 70.0),
    "B falls to a third": ("B", 2400.0, 800.0),
    "B triples": ("B", 1400.0, 4200.0),
    "K falls by half": ("K", 24_500.0, 12_250.0),
    "K doubles": ("K", 12_250.0, 24_500.0),
}
"""Changes against which the isolation has a prior: parameter, before, after."""


def _large(name: str, high_v: float, phase: float) -> Scenario:
    parameter, before, after = LARGE[name]
    excitation = dataclasses.replace(FREE, high_v=high_v, phase=phase % 1.0)
    return dataclasses.replace(
        scenario_of(f"{name}, {high_v} V", excitation, 560, **{parameter: after}), set=PLANT | {parameter: before}
    )


SUCCESSIONS = dataclasses.replace(
    SUCCESSION,
    samples=6300,
    changes=tuple(
        PotChange(at, {"K": 24_500.0 if n % 2 else 23_700.0})
        for n, at in enumerate((200, 300, 400, 500, 5940, 6040, 6140))
    ),
    name="small changes in close succession, twice",
)


def _jump_after_gap(samples: int) -> Spoil:
    """A displacement that jumps so far that it is noticed at once, so many samples after a gap."""

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:
        missing[300:312] = True
        codes[312 + samples :, Y] += 90

    return spoil


def leave_out_later(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """Few samples shortly before a change."""
    missing[[edges_of(codes)[-3] - 9]] = True
    missing[404] = True


def leave_out_after_alarm(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """One sample between the alarm for a change of K and its diagnosis."""
    missing[427] = True


def strike_twice(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """Two successive samples far beyond their neighbours, after one alone."""
    codes[300, Y] += 70
    codes[340:342, Y] += 70


def strike_edges(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """Outliers twice after an edge, after the next but one, and further away; a gap before an edge."""
    edges = edges_of(codes).tolist()
    for at in (edges[4], edges[4] + 2, edges[6] + 2, edges[9] + 2, edges[10] + 3):
        codes[at, Y] += 80
    missing[edges[8] - 8 : edges[8]] = True


def strike_slow_noise(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """A slow noise, and an outlier in every third block, at each phase of a block."""
    steps = np.random.default_rng(1995).normal(0.0, 1.5, len(codes))
    noise = np.zeros(len(codes))
    for n in range(1, len(codes)):
        noise[n] = 0.8 * noise[n - 1] + steps[n]
    codes[:, Y] = np.round(codes[:, Y] + noise)
    codes[260::47, Y] += 250


def _with_noise(codes: Codes, channel: int, span: slice, deviation: float) -> None:
    true = codes[span, channel].astype(np.float64)
    codes[span, channel] = np.round(true + np.random.default_rng(1995).normal(0.0, deviation, len(true)))


def _noisy_force(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """A noise of the force that ends long before a change."""
    _with_noise(codes, U, slice(360, 420), 40.0)


def _noisy_at_last(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """A noise of the displacement once the edges are known to come anywhere."""
    _with_noise(codes, Y, slice(590, None), 3.0)


def _coarse_and_stuck(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """A displacement in steps of 6 codes, most of which repeat, and which gets stuck."""
    codes[:, Y] = 6 * np.round(codes[:, Y] / 6)
    FAULTS["stuck displacement"](codes, missing)


CASES: Mapping[str, PlayedCase] = {
    **shipped.CASES,
    "edges become late, delayed": PlayedCase(LATE, {**FIXED, "warm_up_n": 100, "nk": 1}),
    "edges anywhere after the warm-up": PlayedCase(DISPLACED_LATER, {**FIXED, "warm_up_n": 190}, _noisy_at_last),
    "edges anywhere, known noise": PlayedCase(DISPLACED, {**FIXED, "noise_estimated": False}),
    "missing before edges, one clock": PlayedCase(LOCKED, ONE_CLOCK, leave_out_before_edges),
    "extended by one": PlayedCase(
        SOFTER, {**TWO_B, "nc": 1, "c": (-0.5,), "refresh_n": 0, "trigger": "none"}, is_optional=True
    ),
    "extended with an offset": PlayedCase(
        SOFTER,
        {**ARMED, **TWO_B, "nc": 1, "offset": True, "c": (-0.5,), "refresh_n": 0, "p0": 1e-4, "forgetting": 0.97},
        is_optional=True,
    ),
    **{
        f"gap {n} samples after {kind} edge": PlayedCase(scenario, SHORT_MEMORY, gap_from(edge + n))
        for kind, scenario, edge in (("a late", LATE, 251), ("an early", EARLY, 200))
        for n in (2, 5)
    },
    **{
        f"{name}, {high_v} V": PlayedCase(_large(name, high_v, 0.07 + 0.09 * number), ARMED)
        for number, (name, high_v) in enumerate(itertools.product(LARGE, (0.4, 1.0, 3.0)))
    },
    "M falls at an edge": PlayedCase(
        scenario_of("M falls at an edge", dataclasses.replace(FREE, phase=0.968), 530, **CHANGES["M falls"]), ARMED
    ),
    "M falls, one clock": PlayedCase(scenario_of("M falls, one clock", SQUARE, 530, **CHANGES["M falls"]), ONE_CLOCK),
    "ringing plant": PlayedCase(
        dataclasses.replace(scenario_of("ringing", FREE, 530, B=1250.0), set=RINGING), SHORT_MEMORY
    ),
    "creeping plant": PlayedCase(
        dataclasses.replace(scenario_of("creeping", FREE, 530, B=2600.0), set=CREEPING), SHORT_MEMORY
    ),
    "K falls, missing after the alarm": PlayedCase(
        scenario_of("K falls, missing", dataclasses.replace(FREE, phase=0.133), 530, **CHANGES["K falls"]),
        SHORT_MEMORY,
        leave_out_after_alarm,
    ),
    "B rises, missing": PlayedCase(scenario_of("B rises", FREE, 560, **CHANGES["B rises"]), ARMED, leave_out_later),
    "stuck displacement of coarse codes": PlayedCase(
        dataclasses.replace(FAULTY, excitation=dataclasses.replace(FREE, frequency_hz=40.0, high_v=0.6, phase=0.7)),
        {"warm_up_n": 150, "stuck_n": 0, "arl0": 100.0},
        _coarse_and_stuck,
    ),
    **{
        f"fault {n} samples after a gap": PlayedCase(HEALTHY, {**FIXED, **ARMED}, _jump_after_gap(n))
        for n in range(5, 9)
    },
    "lone outliers, known noise": PlayedCase(
        SOFTER_LATER, {**FIXED, **ARMED, "noise_estimated": False, "refresh_n": 40}, strike
    ),
    "outliers at edges": PlayedCase(SOFTER_LATER, {**ONE_CLOCK, "stuck_n": 0}, strike_edges),
    "outliers in slow noise": PlayedCase(LONG, {**FIXED, **ARMED}, strike_slow_noise),
    "two outliers": PlayedCase(SOFTER, {**FIXED, **ARMED}, strike_twice),
    "K falls after a noisy force": PlayedCase(SOFTER_LATER, ARMED, _noisy_force),
    "alarms may be justified again": PlayedCase(
        SUCCESSIONS,
        {**FIXED, "warm_up_n": 100, "noise_estimated": False, "noise_variance": 6.0, "arl0": 1e3, "isolation": False},
    ),
}

STATED: Mapping[str, tuple[tuple[int, Cause], ...]] = {
    "none": (),
    "hum": ((1, Cause.HUM),),
    "hum with gaps": ((1, Cause.HUM),),
    "hum ends": ((1, Cause.HUM), (5, Cause.NONE)),
    "hum begins": ((4, Cause.HUM),),
    "another hum": ((1, Cause.HUM), (4, Cause.NOISE), (5, Cause.HUM)),
    "drift": ((1, Cause.DRIFT),),
    "slow noise": ((1, Cause.NOISE),),
    "slow noise ends": ((1, Cause.NOISE), (5, Cause.NONE)),
    "outliers": ((1, Cause.NOISE),),
    "bent characteristic": ((1, Cause.NONLINEAR),),
}
"""Misfits that are due for each of ``shipped.MISFITS``: number of the block after which, and cause."""
