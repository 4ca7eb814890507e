"""Advice: each sentence appears under its condition, and none on a sound run."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from analogrig.catalogue import Change
from analogrig.judging.advice import advice
from analogrig.judging.verdict import judge
from analogrig.run import LOST, UNREPORTED, Run
from tests.harness.runs import ESTIMATOR, made_run

from .plants import front

FRONT = front(115.0, 3021.0, 24500.0)
SOFT = front(115.0, 3021.0, 18000.0)
LOADED = np.full(800, 2900.0)
GOOD_THETA = np.tile([-1.7503, 0.769, 0.0, 0.00587, 0.00538, 0.0], (800, 1))
"""Thesis Equ 4.8, in codes of the runs made by hand, nearly."""


def advised(run: Run) -> str:
    return "\n".join(advice(run, judge(run)))


def excited(**excitation: Any) -> Run:
    run = made_run(LOADED, [(0, FRONT)], theta=GOOD_THETA)
    scenario = {**run.conditions.scenario, "excitation": excitation}
    return dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, scenario=scenario))


def test_sound_run_has_no_advice() -> None:
    assert advised(made_run(LOADED, [(0, FRONT), (400, SOFT)], alarms=[404], theta=GOOD_THETA)) == ""


def test_statement_that_only_pytest_judges_is_named() -> None:
    run = made_run(LOADED, [(0, FRONT)], theta=GOOD_THETA)
    scenario = {**run.conditions.scenario, "statement": {"name": "detects", "limits": {"within": 1.5}}}
    stated = dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, scenario=scenario))
    assert "[statement] detects is not judged here" in advised(stated)


def test_fault_of_a_channel_that_the_device_diagnosed_is_named() -> None:
    named = [(10 * k, Change.DISPLACEMENT_STUCK, 5, 1.0) for k in range(1, 8)]
    said = advised(made_run(LOADED, [(0, FRONT)], theta=GOOD_THETA, diagnoses=[*named, (90, Change.MASS, 80, 1.2)]))
    assert "(displacement stuck) at sample 10 and 6 later samples, not a change of the plant" in said
    assert "displacement: check its cable and its input" in said


def test_more_noise_than_the_device_is_set_for_is_named() -> None:
    settings = {**ESTIMATOR, "noise_variance": 1.2, "noise_estimated": False}
    run = made_run(LOADED, [(0, FRONT)], noise_lsb=2.0, theta=GOOD_THETA, estimator=settings)
    assert "variance of 4.1 codes^2, the device is set for 1.2" in advised(run)


def test_noise_that_the_device_follows_needs_no_advice() -> None:
    settings = {**ESTIMATOR, "noise_variance": 1.2, "noise_estimated": True}
    run = made_run(LOADED, [(0, FRONT)], noise_lsb=20.0, theta=GOOD_THETA, estimator=settings)
    assert advised(run) == ""


@pytest.mark.parametrize(
    ("excitation", "told"),
    [
        ({"clock": "free", "frequency_hz": 180.0}, True),
        ({"clock": "free", "frequency_hz": 200.0, "drift_ppm": 200.0}, True),
        ({"clock": "free", "frequency_hz": 200.0, "drift_ppm": 20.0}, False),
        ({"clock": "card", "frequency_hz": 180.0}, False),
    ],
    ids=str,
)
def test_edges_off_the_sample_grid_are_named(excitation: dict[str, Any], told: bool) -> None:  # noqa: FBT001
    assert ("whole number of samples apart" in advised(excited(**excitation))) == told


def test_many_false_alarms_devalue_latencies() -> None:
    run = made_run(LOADED, [(0, FRONT), (400, SOFT)], alarms=[10, 20, 30, 404], theta=GOOD_THETA)
    assert "may be coincidence" in advised(run)


def test_undetectable_change_is_named() -> None:
    assert "K at 400 is not judged: not detectable" in advised(
        made_run(np.zeros(800), [(0, FRONT), (400, SOFT)], theta=GOOD_THETA)
    )


def test_change_within_the_warm_up_is_named() -> None:
    run = made_run(np.zeros(800), [(0, FRONT), (400, SOFT)], theta=GOOD_THETA)
    dut = {**run.conditions.dut, "estimator": {**run.conditions.dut["estimator"], "warm_up_n": 550}}
    told = advised(dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, dut=dut)))
    assert "K at 400 changes within the device's warm-up of 550 samples" in told


def test_implausible_estimate_is_named() -> None:
    assert "samples 0-799 describes no plant" in advised(made_run(LOADED, [(0, FRONT)]))


@pytest.mark.parametrize("flag", [UNREPORTED, LOST])
def test_estimate_that_was_never_reported_is_not_called_implausible(flag: int) -> None:
    run = made_run(LOADED, [(0, FRONT)])
    text = advised(dataclasses.replace(run, flags=np.full(800, flag, np.uint8)))
    assert "no estimate until the end of samples 0-799" in text
    assert "describes no plant" not in text


@pytest.mark.parametrize(("frequency_hz", "told"), [(20.0, True), (200.0, False)])
def test_warm_up_that_ends_before_the_second_edge_is_named(frequency_hz: float, told: bool) -> None:  # noqa: FBT001
    run = excited(clock="card", frequency_hz=frequency_hz)
    estimator = {**run.conditions.dut["estimator"], "warm_up_n": 150}
    dut = {**run.conditions.dut, "estimator": estimator}
    run = dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, dut=dut))
    assert ("warm-up of 150 samples ends before edge 2" in advised(run)) == told
