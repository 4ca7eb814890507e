"""Statements about a play, and the rate over several."""

from __future__ import annotations

import math

import numpy as np
import pytest

from analogrig.catalogue import Cause
from analogrig.judging.verdict import CURES
from analogrig.testing.one_play import Played, rate_below
from tests.harness.runs import ESTIMATOR, made_run

from .plants import front

FRONT = front(294.0, 3021.0, 24500.0)


@pytest.mark.parametrize("samples", [0, 400])
def test_nothing_holds_of_a_play_that_is_not_valid(samples: int) -> None:
    run = made_run(np.zeros(samples), [(0, FRONT)], faults=("the device died",), samples_asked=1000)
    played = Played(run)
    findings = [
        played.detects(),
        played.stays_quiet(),
        played.isolates(),
        played.estimates(within=1e9),
        played.follows(run.theta, 1.0),
        rate_below(0.5, [played, played], confidence=0.9),
    ]
    assert not any(findings)
    assert all(finding.why.startswith("INCONCLUSIVE: ") and "the device died" in finding.why for finding in findings)


def test_estimates_that_are_no_numbers_follow_nothing() -> None:
    run = made_run(np.zeros(4), [(0, FRONT)], theta=np.full((4, 6), np.nan))
    assert not Played(run).follows(np.zeros((4, 6)), 1.0)


def test_reference_that_is_no_number_allows_any_estimate() -> None:
    run = made_run(np.zeros(4), [(0, FRONT)], theta=np.full((4, 6), 7.0))
    assert Played(run).follows(np.full((4, 6), np.nan), 1.0)
    assert not Played(run).follows(np.zeros((4, 6)), 1.0)


@pytest.mark.parametrize("within", [math.nan, math.inf])
def test_limit_that_is_no_finite_number_is_refused(within: float) -> None:
    played = Played(made_run(np.zeros(400), [(0, FRONT)]))
    with pytest.raises(ValueError, match="estimates: within: must be a number within"):
        played.estimates(within)


def test_rate_counts_the_same_play_once_and_says_how_many_samples_it_takes() -> None:
    once = Played(made_run(np.zeros(1000), [(0, FRONT)]))
    again = Played(made_run(np.zeros(1000), [(0, FRONT)]))
    finding = rate_below(1e-5, [once, again], confidence=0.999)
    assert finding.why.startswith(rate_below(1e-5, [once], confidence=0.999).why)
    assert "for any dependence within a play, and at most 1000 alarms in each; " in finding.why
    assert "with so many alarms takes 784532 plays like these, or the hold-off of the device" in finding.why
    bursts = rate_below(1e-5, [once], confidence=0.999, burst=5.0)
    assert bursts.why.endswith("; to show 1e-05 with so many alarms takes 3453878 samples")
    alone = rate_below(1e-5, [once], confidence=0.999, burst=1.0)
    assert alone.why.endswith("; to show 1e-05 with so many alarms takes 690776 samples")


def test_rate_leaves_out_the_plays_with_a_misfit_if_asked_and_names_their_causes() -> None:
    watching = {**ESTIMATOR, "misfit": True}
    quiet = Played(made_run(np.linspace(0.0, 2900.0, 1000), [(0, FRONT)], estimator=watching))
    alarms, misfits = [100, 200, 300], [(250, Cause.HUM, 0.0025, 3.0)]
    poor = Played(made_run(np.zeros(1000), [(0, FRONT)], alarms=alarms, misfits=misfits, estimator=watching))
    assert not rate_below(0.003, [quiet, poor], confidence=0.9, burst=1.0)
    finding = rate_below(0.003, [quiet, poor], confidence=0.9, burst=1.0, or_misfit=True)
    assert finding
    assert finding.why.endswith(f"misfit in 1 of 2 plays: hum at 50 Hz in samples 250-999: {CURES['hum']}")
    assert rate_below(0.003, [poor], confidence=0.9, burst=1.0, or_misfit=True)
    assert not rate_below(1e-6, [quiet, poor], confidence=0.9, or_misfit=True)


def test_statement_that_fails_on_a_plant_that_the_model_does_not_fit_says_what_to_do() -> None:
    watching, misfits = {**ESTIMATOR, "misfit": True}, [(250, Cause.NONLINEAR, 0.0, 3.0)]
    poor = Played(made_run(np.zeros(1000), [(0, FRONT)], alarms=[600], misfits=misfits, estimator=watching))
    assert poor.stays_quiet().why.startswith("1 false alarm in 1000 samples: 600; the model does not fit (nonlinear)")
    assert poor.stays_quiet().why.endswith(f"changes missed; {CURES['nonlinear']}")
    quiet = Played(made_run(np.zeros(1000), [(0, FRONT)], misfits=misfits, estimator=watching))
    assert "nonlinear" not in quiet.stays_quiet().why


def test_rate_above_the_limit_asks_for_no_longer_run() -> None:
    noisy = Played(made_run(np.linspace(0.0, 2900.0, 1000), [(0, FRONT)], alarms=[200, 400, 600]))
    assert rate_below(1e-3, [noisy], confidence=0.9).why.endswith("; 0.001 was asked, which is less than observed")
