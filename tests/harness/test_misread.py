"""Signs that the answers of a device are misread."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.answers import plausible_orders
from analogrig.catalogue import SteppedFlag
from analogrig.judging.misread import misreadings
from analogrig.judging.verdict import judge
from analogrig.run import LOST, Run
from tests.harness.runs import ESTIMATOR, made_run

from .plants import front
from .test_advice import FRONT, GOOD_THETA, LOADED, SOFT

N = 800


def signs(run: Run) -> str:
    return "\n".join(misreadings(run, judge(run)))


def of_theta(theta: NDArray[Any], **changes: Any) -> Run:
    return made_run(LOADED, [(0, FRONT)], theta=theta, **changes)


ROWS = {
    "a flag with a hold time": (range(300, 350), "alarms in 50 samples in a row, from sample 300 on"),
    "to the end": (range(206, N), "alarms in 594 samples in a row, from sample 206 on"),
    "from the start": (range(5), "alarms in 5 samples in a row, from sample 0 on"),
    "the longer of two": ([*range(10, 20), *range(100, 130)], "alarms in 30 samples in a row, from sample 100 on"),
    "four": (range(100, 104), ""),
    "every other sample": (range(0, N, 2), ""),
    "one": ([7], ""),
    "none": ([], ""),
}


@pytest.mark.parametrize("name", ROWS)
def test_alarms_in_a_row_are_taken_for_a_level(name: str) -> None:
    alarms, told = ROWS[name]
    found = signs(made_run(LOADED, [(0, FRONT)], alarms=list(alarms), theta=GOOD_THETA))
    assert found.startswith(told)
    assert bool(found) == bool(told)


def test_device_that_is_described_as_a_level_needs_no_note() -> None:
    run = made_run(LOADED, [(0, FRONT)], alarms=list(range(300, 350)), theta=GOOD_THETA)
    dut = {**run.conditions.dut, "alarm_is": "level"}
    described = dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, dut=dut))
    assert signs(described) == ""


def test_device_that_latches_needs_no_note() -> None:
    run = made_run(LOADED, [(0, FRONT)], alarms=list(range(300, 350)))
    dut = {"name": "fixed", "datasheet": {"latches": True}}
    conditions = dataclasses.replace(run.conditions, dut=dut)
    assert "in a row" not in signs(dataclasses.replace(run, conditions=conditions, theta=run.theta[:, :0]))


def permuted(values: NDArray[Any], order: tuple[int, ...]) -> NDArray[np.float32]:
    """The values with the bytes of each in another order."""
    raw = values.astype(np.float32).view(np.uint8).reshape(-1, 4)[:, list(order)]
    return np.ascontiguousarray(raw).view(np.float32).reshape(values.shape)


WALK = GOOD_THETA * (1.0 + 0.01 * np.sin(np.arange(N))[:, np.newaxis])
"""Estimates that move, as those of every estimator do."""


@pytest.mark.parametrize(
    ("order", "told"),
    [
        ((3, 2, 1, 0), "plausible byte-swapped"),
        ((2, 3, 0, 1), "plausible word-swapped"),
        ((1, 0, 3, 2), "plausible with swapped bytes in each half"),
        ((0, 1, 2, 3), ""),
    ],
)
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
def test_byte_order_of_floats_is_told(order: tuple[int, ...], told: str, scale: float) -> None:
    walk = permuted(scale * (2.0 + np.sin(np.arange(N) / 3.0))[:, np.newaxis] * np.ones(6), order)
    found = [name for name, *_ in plausible_orders(walk)]
    assert found == ([told.removeprefix("plausible ")] if told else [])


@pytest.mark.parametrize(
    "values", [np.zeros(100), np.full(100, 1e-30), np.array([np.nan, 1e38]), np.linspace(-1, 1, 9)]
)
def test_no_byte_order_is_told_from_values_that_prove_none(values: NDArray[Any]) -> None:
    assert list(plausible_orders(values.astype(np.float32))) == []


def test_swapped_estimates_of_a_run_are_a_note() -> None:
    found = signs(of_theta(permuted(WALK, (3, 2, 1, 0))))
    assert found.startswith("theta is implausible as it is read, such as ")
    assert "plausible byte-swapped" in found


def test_lost_samples_prove_no_byte_order() -> None:
    run = of_theta(permuted(WALK, (3, 2, 1, 0)))
    assert signs(dataclasses.replace(run, flags=np.full(N, LOST, np.uint8))) == ""


B = slice(2, 5)
"""Elements of theta that u enters."""


@pytest.mark.parametrize("factor", [0.5, 2.0, 0.1, 10.0, 0.85, 1.25, 25 / 10, 1e3, 1e-3, 1e-5, math.pi / 180])
def test_one_factor_of_all_estimates_is_told(factor: float) -> None:
    scaled = np.array(GOOD_THETA)
    scaled[:, B] /= factor
    found = re.match(
        r"every estimate is ([\d.]+) of its true value: is u scaled by \1, or y by", signs(of_theta(scaled))
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(factor, rel=0.02)


@pytest.mark.parametrize("segments", [[(0, FRONT)], [(0, FRONT), (400, SOFT)]])
def test_sound_estimates_have_no_common_factor(segments: list[Any]) -> None:
    assert signs(made_run(LOADED, segments, theta=GOOD_THETA)) == ""


def test_estimates_with_factors_of_their_own_are_no_note() -> None:
    assert signs(made_run(LOADED, [(0, front(115.0, 2000.0, 49000.0))], theta=GOOD_THETA)) == ""


REFUSALS: dict[str, tuple[dict[str, int], dict[str, Any], list[int], str]] = {
    "saturated": (
        {"refused": 3, "saturated": 3},
        {"code_low": 0.0, "code_high": 4095.0},
        [40, 41, 90],
        "the device refused 3 samples: 3 with u or y saturated, at or beyond codes 0 to 4095, the first is sample 40",
    ),
    "stuck": (
        {"refused": 2, "stuck": 2},
        {"stuck_n": 16},
        [7, 8],
        "2 with a stuck y (stuck_n = 16), the first is sample 7",
    ),
    "both": (
        {"refused": 5, "saturated": 1, "stuck": 4},
        {"code_low": 10.0, "code_high": 4000.0, "stuck_n": 16},
        [1],
        "1 with u or y saturated, at or beyond codes 10 to 4000, 4 with a stuck y (stuck_n = 16)",
    ),
    "for another reason": (
        {"refused": 1},
        {},
        [5],
        "the device refused 1 sample: the first is sample 5, with the codes",
    ),
    "nowhere in the flags": ({"refused": 1}, {}, [], "the device refused 1 sample"),
    "a device without counters": (
        {},
        {},
        [9],
        "the device did not use 1 sample: the first is sample 9, with the codes u",
    ),
    "none": ({}, {}, [], ""),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_refused_samples_are_told_with_their_causes(name: str) -> None:
    counters, settings, at, told = REFUSALS[name]
    run = made_run(LOADED, [(0, FRONT)], theta=GOOD_THETA, estimator={**ESTIMATOR, **settings})
    flags = np.zeros(N, np.uint8)
    flags[at] = SteppedFlag.REFUSED
    run = dataclasses.replace(run, flags=flags, conditions=dataclasses.replace(run.conditions, counters=counters))
    found = [*judge(run).reasons, signs(run)]
    assert any(told in each for each in found)
    assert bool("".join(found)) == bool(told)
