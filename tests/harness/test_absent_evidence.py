"""A run that a device would also pass by staying silent or unarmed proves nothing, and does not pass."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from analogrig.datasheet import Datasheet
from analogrig.judging.exposure import until_latched
from analogrig.judging.verdict import as_json, judge
from analogrig.plant import Plant
from analogrig.run import UNARMED, Run
from analogrig.scenario import Expectations
from analogrig.testing.one_play import Played, rate_below
from analogrig.testing.plugin.junit import play_properties
from tests.harness.runs import made_run

from .plants import front

FRONT, SOFT, BARELY = (front(115.0, 3021.0, stiffness) for stiffness in (24500.0, 18000.0, 24499.0))
N = 2000
SQUARE_N = np.where(np.arange(N) // 50 % 2, 2000.0, 200.0)
QUIET, CHANGED = ((0, FRONT),), ((0, FRONT), (1000, SOFT))
SAYS_ARMED: Mapping[str, Any] = {"armed": True}


def made(
    sheet: Mapping[str, Any],
    armed: Sequence[range] = (range(N),),
    alarms: Sequence[int] = (),
    plants: Sequence[tuple[int, Plant]] = QUIET,
    expect: Mapping[str, float] | None = None,
) -> Run:
    """Run of a device with a data sheet, which reports its trigger as armed in the samples ``armed``."""
    run = made_run(SQUARE_N, plants, alarms=alarms, expect=expect)
    flags = run.flags | np.uint8(UNARMED)
    flags[list(itertools.chain(*armed))] = 0
    conditions = dataclasses.replace(run.conditions, dut={"name": "bob", "datasheet": dict(sheet)})
    return dataclasses.replace(run, conditions=conditions, flags=flags, theta=run.theta[:, :0])


NEVER: Sequence[range] = ()
FEW = "fewer than [expect] least_exposure = 0.5 asks for"
TOO_FEW = "too few to judge it by"
SILENT = "no change of the scenario is detectable"

CASES: dict[str, tuple[Run, str, str]] = {
    "armed in one sample": (made(SAYS_ARMED, [range(700, 701)]), "inconclusive", FEW),
    "armed in the last sample": (made(SAYS_ARMED, [range(N - 1, N)]), "inconclusive", FEW),
    "armed in just less than half": (made(SAYS_ARMED, [range(999)]), "inconclusive", FEW),
    "armed in half": (made(SAYS_ARMED, [range(1000)]), "passed", ""),
    "armed in every fourth sample": (made(SAYS_ARMED, [range(0, N, 4)]), "inconclusive", FEW),
    "never armed": (made(SAYS_ARMED, NEVER), "inconclusive", "armed in none"),
    "warm-up is left out": (made({"armed": True, "warm_up_n": 1200}, [range(1200, 1800)]), "passed", ""),
    "half of the rest": (made({"armed": True, "warm_up_n": 1200}, [range(1200, 1599)]), "inconclusive", FEW),
    "a warm-up up to the last sample": (made({"warm_up_n": N - 1}), "inconclusive", TOO_FEW),
    "a warm-up that leaves less than a twentieth": (made({"warm_up_n": 1901}), "inconclusive", TOO_FEW),
    "armed in the few samples after a long warm-up": (
        made({"armed": True, "warm_up_n": 1950}, [range(1950, N)]),
        "inconclusive",
        TOO_FEW,
    ),
    "a warm-up that leaves a twentieth": (made({"warm_up_n": 1900}), "passed", ""),
    "a long warm-up, and a scenario that asks for none": (
        made({"warm_up_n": N - 1}, expect={"least_exposure": 0.0}),
        "passed",
        "",
    ),
    "a scenario that asks for more": (
        made(SAYS_ARMED, [range(1700)], expect={"least_exposure": 0.9}),
        "inconclusive",
        "least_exposure = 0.9",
    ),
    "a scenario that asks for none": (made(SAYS_ARMED, [range(9)], expect={"least_exposure": 0.0}), "passed", ""),
    "no excitation for the trigger": (made({"edge_codes": 3000.0}), "inconclusive", "was not excited"),
    "excited for a fifth of the run": (made({"edge_codes": 64.0, "idle_n": 10}), "inconclusive", FEW),
    "a change met while armed in few samples": (
        made(SAYS_ARMED, [range(1000, 1020)], [1003], CHANGED),
        "inconclusive",
        FEW,
    ),
    "a false alarm while armed in few samples": (
        made(SAYS_ARMED, [range(1000, 1020)], [1003]),
        "failed",
        "1 false alarm",
    ),
    "never armed, with the right alarm": (
        made(SAYS_ARMED, NEVER, [1003], CHANGED),
        "failed",
        "1 alarm while unarmed, the first at 1003: there the device reported its trigger not armed",
    ),
    "never armed, with four alarms": (
        made(SAYS_ARMED, NEVER, [10, 500, 1003, 1700], CHANGED),
        "failed",
        "4 alarms while unarmed, the first at 10",
    ),
    "disarmed by its own alarm": (made(SAYS_ARMED, [range(1003)], [1003], CHANGED), "passed", ""),
    "an alarm in the stated warm-up": (
        made({"warm_up_n": 800}, alarms=[799], expect={"false_alarms": 9}),
        "failed",
        "warm_up_n = 800",
    ),
    "an alarm just after the stated warm-up": (
        made({"warm_up_n": 800}, alarms=[800], expect={"false_alarms": 9}),
        "passed",
        "",
    ),
    "an alarm in the stated hold-off": (
        made({"hold_off_n": 30}, alarms=[900, 930], expect={"false_alarms": 9}),
        "failed",
        "hold_off_n = 30",
    ),
    "an alarm just after the stated hold-off": (
        made({"hold_off_n": 30}, alarms=[900, 931], expect={"false_alarms": 9}),
        "passed",
        "",
    ),
    "an alarm without a trigger": (
        made({"alarms": False}, alarms=[1003], plants=CHANGED),
        "failed",
        "[datasheet] alarms = false",
    ),
    "held off in most of the run": (
        made({"hold_off_n": 1500}, alarms=[100], expect={"false_alarms": 1}),
        "inconclusive",
        "its hold-off after each alarm takes 1500",
    ),
    "only change too small": (made({}, plants=((0, FRONT), (1000, BARELY))), "inconclusive", SILENT),
    "only change too small, and named": (
        made({}, alarms=[1003], plants=((0, FRONT), (1000, BARELY)), expect={"false_alarms": 1}),
        "inconclusive",
        SILENT,
    ),
    "two changes, both too small": (
        made({}, plants=((0, FRONT), (900, BARELY), (1300, FRONT))),
        "inconclusive",
        SILENT,
    ),
    "only change at the end": (made({}, plants=((0, FRONT), (N - 12, SOFT))), "inconclusive", SILENT),
    "only change in the last sample": (made({}, plants=((0, FRONT), (N - 1, SOFT))), "inconclusive", SILENT),
    "one small and one large change": (
        made({}, alarms=[1003], plants=((0, FRONT), (900, BARELY), (1000, SOFT))),
        "passed",
        "",
    ),
    "too small a change and a false alarm": (
        made({}, alarms=[500], plants=((0, FRONT), (1000, BARELY))),
        "failed",
        "1 false alarm",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_silence_passes_only_where_it_is_evidence(case: str) -> None:
    run, outcome, why = CASES[case]
    verdict = judge(run)
    assert verdict.outcome == outcome, verdict.reasons
    assert any(why in reason for reason in verdict.reasons) == bool(why)
    played = Played(run)
    assert bool(played.passes()) == (outcome == "passed")
    if outcome == "inconclusive" or verdict.unarmed_alarms:
        assert not played.stays_quiet()


def test_reasons_of_an_invalid_run_come_alone() -> None:
    run = made(SAYS_ARMED, NEVER)
    assert judge(run).reasons == (
        "the trigger was armed in none of 2000 samples: the device reported it armed in none",
    )


def test_exposure_stands_in_json_and_junit() -> None:
    played = Played(made({"armed": True, "warm_up_n": 100}, [range(200, 1500)], [150]))
    found = as_json(played.verdict)
    assert found["exposure"] == {"armed": 1300, "after_warm_up": 1900}
    assert found["unarmed_alarms"] == [150]
    properties = dict(play_properties(played))
    assert (properties["armed_n"], properties["after_warm_up_n"], properties["unarmed_alarms"]) == (1300, 1900, 1)


def test_rate_is_not_shown_by_alarms_of_an_unarmed_trigger() -> None:
    finding = rate_below(0.5, [Played(made(SAYS_ARMED, NEVER, [150]))], confidence=0.9)
    assert not finding
    assert "1 alarm while unarmed" in finding.why


@pytest.mark.parametrize("share", [-0.1, 1.5, float("nan")])
def test_least_exposure_is_a_share(share: float) -> None:
    with pytest.raises(ValueError, match="^least_exposure must be in 0 .. 1, not"):
        Expectations(least_exposure=share)


LATCHES: Mapping[str, Any] = {"latches": True}
TWICE = ((0, FRONT), (1000, SOFT), (1400, FRONT))

LATCHED: dict[str, tuple[Run, str]] = {
    "one change, alarms ever after": (made(LATCHES, alarms=range(1003, N), plants=CHANGED), "passed"),
    "later changes": (made(LATCHES, alarms=[1003], plants=TWICE), "passed"),
    "later changes and alarms": (made(LATCHES, alarms=range(1003, N, 3), plants=TWICE), "passed"),
    "no alarm": (made(LATCHES, plants=CHANGED), "failed"),
    "a late alarm": (made(LATCHES, alarms=range(1200, N), plants=CHANGED), "failed"),
    "an early alarm": (made(LATCHES, alarms=range(900, N), plants=CHANGED), "failed"),
    "quiet": (made(LATCHES), "passed"),
    "one false alarm": (made(LATCHES, alarms=range(1500, N)), "failed"),
    "unarmed after its alarm": (made({**SAYS_ARMED, **LATCHES}, [range(1004)], range(1003, N), CHANGED), "passed"),
    "the same of another device": (made({}, alarms=range(1003, N), plants=CHANGED), "failed"),
}


@pytest.mark.parametrize("case", LATCHED)
def test_device_that_latches_is_judged_up_to_its_alarm(case: str) -> None:
    run, outcome = LATCHED[case]
    verdict = judge(run)
    assert verdict.outcome == outcome, verdict.reasons
    if run.datasheet.latches:
        assert len(verdict.false_alarms) <= 1


def test_exposure_of_a_device_that_latches_ends_with_its_alarm() -> None:
    verdict = judge(made({**LATCHES, "warm_up_n": 100}, alarms=range(1003, N), plants=CHANGED))
    assert (verdict.armed_n, verdict.after_warm_up_n) == (904, 904)


@pytest.mark.parametrize("samples", [1, 2, 1000, 2**31])
@pytest.mark.parametrize(
    "sheet", [{}, {"armed": True}, {"warm_up_n": 100}, {"hold_off_n": 3}, {"edge_codes": 2.0, "idle_n": 5}], ids=str
)
def test_device_that_latches_has_one_judged_alarm_in_a_record(sheet: Mapping[str, Any], samples: int) -> None:
    assert Datasheet(**{**sheet, **LATCHES}).most_alarms(samples) == 1


def test_rate_of_a_device_that_latches_takes_plays_of_one_alarm_each() -> None:
    quiet = [Played(made(LATCHES, alarms=[], plants=((0, FRONT),)))]
    assert "at most 1 alarm in each" in rate_below(1e-4, quiet, confidence=0.99).why


def test_alarms_that_a_latched_trigger_holds_are_counted_once() -> None:
    run = made(LATCHES, alarms=range(1500, N))
    assert until_latched(run).alarm_index.tolist() == [1500]
    free = made({}, alarms=range(1500, N))
    assert until_latched(free) is free
