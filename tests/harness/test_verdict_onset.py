"""Verdicts on changes whose instant is known only as an interval."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig.campaigns.trials import Trial
from analogrig.catalogue import Change
from analogrig.errors import RecordingError
from analogrig.judging.verdict import Verdict, as_json, judge
from analogrig.plant import Segment
from analogrig.reporting.page import render
from analogrig.reporting.run_summary import summary
from analogrig.run import Run
from analogrig.testing.one_play import Played
from analogrig.testing.plugin.junit import latency_property
from tests.harness.runs import made_run

from .plants import front

FRONT = front(115.0, 3021.0, 24500.0)
SOFT = front(115.0, 3021.0, 18000.0)
LIGHT = front(60.0, 3021.0, 18000.0)
LOADED = np.full(800, 2900.0)
SWITCHED = np.where(np.arange(800) // 50 % 2, 2900.0, 0.0)


def learned(*segments: Segment, alarms: Sequence[int], force_n: Any = LOADED, **made: Any) -> Run:
    """Run that begins with the front suspension, followed by ``segments``."""
    run = made_run(force_n, [(0, FRONT)], alarms=alarms, **made)
    return dataclasses.replace(
        run, conditions=dataclasses.replace(run.conditions, segments=(Segment(0, FRONT), *segments))
    )


def between(low: int, likeliest: int, high: int, **more: Any) -> Segment:
    return Segment(likeliest, SOFT, start_low=low, start_high=high, **more)


def deadline_of(start: int) -> int:
    """Latest sample of an alarm that is not late, for a change at exactly ``start``."""
    (change,) = judge(learned(Segment(start, SOFT), alarms=[start + 2])).changes
    assert change.deadline_n is not None
    return start + change.deadline_n


def test_latency_is_an_interval_from_the_latest_to_the_earliest_instant() -> None:
    (change,) = judge(learned(between(395, 400, 402), alarms=[404])).changes
    assert (change.sample, change.between, change.latency_n, change.latencies_n) == (400, (395, 402), 4, (2, 9))
    assert change.result == "detected"


def test_exact_instant_is_judged_once() -> None:
    (change,) = judge(learned(Segment(400, SOFT), alarms=[404])).changes
    assert change.alternatives == ()
    assert (change.between, change.latencies_n, change.result) == ((400, 400), (4, 4), "detected")


def test_alarm_before_the_earliest_instant_is_false() -> None:
    verdict = judge(learned(between(395, 400, 402), alarms=[395, 404]))
    assert (verdict.false_alarms, verdict.doubtful_alarms) == ((395,), ())
    assert verdict.outcome == "failed"


def test_alarm_after_the_latest_instant_passes_if_it_is_in_time_even_for_the_earliest() -> None:
    assert judge(learned(between(395, 400, 402), alarms=[deadline_of(395)])).outcome == "passed"


def test_detection_is_late_only_if_late_for_the_latest_instant() -> None:
    late = judge(learned(between(395, 400, 402), alarms=[deadline_of(402) + 1]))
    assert (late.outcome, late.changes[0].result) == ("failed", "late")
    assert "K at 400 was detected after" in late.reasons[0]


@pytest.mark.parametrize("alarm", [deadline_of(395) + 1, deadline_of(402)], ids=["just after", "just before"])
def test_between_the_deadlines_of_earliest_and_latest_instant_a_run_is_inconclusive(alarm: int) -> None:
    verdict = judge(learned(between(395, 400, 402), alarms=[alarm]))
    assert verdict.outcome == "inconclusive"
    assert verdict.changes[0].result == "undecided"
    assert verdict.reasons == ("K between 395 and 402 was late or detected, depending on its instant",)


def test_alarm_between_earliest_and_latest_instant_is_false_or_the_detection() -> None:
    verdict = judge(learned(between(380, 400, 402), alarms=[390]))
    assert verdict.outcome == "inconclusive"
    assert (verdict.false_alarms, verdict.doubtful_alarms) == ((), (390,))
    assert verdict.changes[0].result == "undecided"


def test_alarm_that_is_late_for_one_instant_and_false_for_another_may_be_in_time_for_a_third() -> None:
    change = between(390, 403, 442)
    verdict = judge(learned(change, alarms=[425], force_n=SWITCHED))
    assert verdict.changes[0].result == "undecided"
    assert verdict.outcome == "inconclusive"
    exact = judge(learned(Segment(415, SOFT), alarms=[425], force_n=SWITCHED))
    assert exact.outcome == "passed"


def test_one_of_two_alarms_after_the_earliest_instant_is_false() -> None:
    verdict = judge(learned(between(380, 400, 402), alarms=[390, 404]))
    assert verdict.outcome == "failed"
    assert verdict.reasons == ("1 false alarm, at most 0 expected",)
    assert judge(learned(between(380, 400, 402), alarms=[390, 404], expect={"false_alarms": 1})).outcome == "passed"


def test_change_missed_under_all_hypotheses_is_missed() -> None:
    verdict = judge(learned(between(380, 400, 402), alarms=[]))
    assert (verdict.outcome, verdict.changes[0].result) == ("failed", "missed")


def test_missed_change_fails_a_run_with_undecided_changes() -> None:
    undecided = between(380, 400, 402)
    verdict = judge(learned(undecided, Segment(600, LIGHT), alarms=[deadline_of(402)], force_n=SWITCHED))
    assert verdict.changes[1].result == "missed"
    assert verdict.outcome == "failed"


def test_alarms_on_a_ramp_belong_to_it_until_its_latest_end_for_the_latest_instant() -> None:
    turned = Segment(400, SOFT, 50, start_low=390, start_high=410, end_low=440, end_high=470)
    verdict = judge(learned(turned, alarms=[411, 438, 500]))
    assert verdict.outcome == "passed"
    verdict = judge(learned(turned, alarms=[411, 460, 500]))
    assert (verdict.outcome, verdict.doubtful_alarms) == ("inconclusive", (500,))
    verdict = judge(learned(turned, alarms=[411, 480, 500]))
    assert (verdict.outcome, verdict.false_alarms) == ("failed", (500,))


def test_change_that_was_not_found_is_not_judged_and_the_run_cannot_pass() -> None:
    reason = "nothing in the samples 300 to 500 shows that the plant has changed"
    segment = Segment(300, SOFT, 200, unseen=reason)
    for alarms in ([], [450], [310, 450, 600]):
        verdict = judge(learned(segment, alarms=alarms))
        assert (verdict.outcome, verdict.changes[0].result) == ("inconclusive", "not judged")
        assert verdict.reasons == (f"K at 300 is not judged: {reason}",)
        assert [each.start for each in verdict.estimates] == [0], "what the plant became is not known"
    verdict = judge(learned(segment, alarms=[200]))
    assert verdict.outcome == "failed", "an alarm from before all that is false all the same"
    assert verdict.false_alarms == (200,)


def test_truth_of_the_plant_before_ends_at_the_earliest_instant() -> None:
    verdict = judge(learned(between(380, 400, 402), alarms=[404]))
    assert [(each.start, each.end) for each in verdict.estimates] == [(0, 380), (380, 800)]


def test_instants_stay_within_the_record_and_the_run() -> None:
    """The search interval may begin before the record of the change."""
    run = learned(between(300, 310, 320), Segment(790, LIGHT, start_low=700, start_high=900), alarms=[313, 795])
    run = dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, records=(0, 300)))
    assert [change.between for change in judge(run).changes] == [(301, 320), (700, 799)]


# ---- what is shown


def shown(run: Run) -> tuple[str, str, Verdict]:
    verdict = judge(run)
    return summary(run, verdict), render(run, verdict), verdict


def test_interval_is_shown_in_summary_page_json_and_junit() -> None:
    run = learned(between(395, 400, 402), alarms=[404])
    text, page, verdict = shown(run)
    line = next(line for line in text.splitlines() if "24500 -> 18000" in line)
    assert line.split()[-2:] == ["2-9", str(verdict.changes[0].bound_n)]
    assert "between 395 and 402 (the likeliest instant is shown): detected" in text
    assert ">395–402</button>" in page and ">2–9</td>" in page
    (change,) = as_json(verdict)["changes"]
    wanted = {"sample": 400, "between": [395, 402], "latency": 4, "latencies": [2, 9], "result": "detected"}
    assert change.items() >= wanted.items()
    assert latency_property(verdict.changes[0]) == "2..9"


def test_undecided_result_is_shown_in_summary_and_page() -> None:
    text, page, verdict = shown(learned(between(380, 400, 402), alarms=[390]))
    assert "depending on the instants of the changes: alarms at 390" in text
    assert "? depends on its instant" in page and "the alarms at 390 are false" in page
    assert as_json(verdict)["doubtful_alarms"] == [390]
    assert as_json(verdict)["changes"][0]["result"] == "undecided"


def test_change_that_was_not_found_is_shown_with_the_reason() -> None:
    text, page, verdict = shown(learned(Segment(300, SOFT, 200, unseen="nothing to be seen"), alarms=[]))
    assert "K at 300 is not judged: nothing to be seen" in text
    assert "not judged: not found in the samples" in page
    assert as_json(verdict)["changes"][0]["unseen"] == "nothing to be seen"


def test_exact_instants_are_shown_without_an_interval() -> None:
    run = learned(Segment(400, SOFT), alarms=[404])
    text, page, verdict = shown(run)
    assert "between" not in text and ">400</button>" in page
    assert latency_property(verdict.changes[0]) == "4"


# ---- findings of a test


def test_detection_limit_is_checked_for_every_instant() -> None:
    (change,) = judge(learned(between(395, 400, 402), alarms=[404])).changes
    assert [each.bound_n for each in change.hypotheses] == [1, 1, 1]
    assert [each.latency_n for each in change.hypotheses] == [9, 4, 2]  # of them 1 more than so many bounds is allowed
    played = Played(learned(between(395, 400, 402), alarms=[404]))
    assert played.detects(within=8.0)
    assert not played.detects(within=7.0)
    assert "INCONCLUSIVE: K between 395 and 402" in played.detects(within=7.0).why
    assert "INCONCLUSIVE: K between 395 and 402" in played.detects(within=1.0).why
    late = Played(learned(between(395, 400, 402), alarms=[408]))
    assert late.detects(within=1.0).why == "K at 400: 8 samples, allowed 2 (1 x bound 1 + 1)"


def test_run_with_a_possibly_false_alarm_is_not_quiet() -> None:
    allowed = {"missed": 1, "false_alarms": 1}
    played = Played(learned(between(380, 400, 402), alarms=[390], expect=allowed))
    assert played.verdict.outcome == "passed"
    assert "INCONCLUSIVE: the alarm at 390" in played.stays_quiet().why


def test_change_that_was_not_found_is_neither_missed_nor_misnamed() -> None:
    unseen = Segment(300, SOFT, 200, unseen="nothing to be seen")
    run = learned(unseen, alarms=[200, 404], diagnoses=[(420, Change.MASS, 398, 1.3)])
    verdict = judge(run)
    assert Trial.of(run, verdict).changes == ((None, None, False, False),)
    played = Played(run)
    assert played.verdict.outcome == "failed", "for the alarm at 200"
    assert "no change could be seen" in played.detects().why
    assert played.isolates()


# ---- the file


def test_recording_keeps_the_interval(tmp_path: Path) -> None:
    segments = (between(380, 400, 402), Segment(600, LIGHT, 30, 590, 610, 620, 650), Segment(700, SOFT, unseen="no"))
    run = learned(*segments, alarms=[404])
    run.save(tmp_path / "run.npz")
    assert Run.load(tmp_path / "run.npz").conditions.segments[1:] == segments


@pytest.mark.parametrize(
    "segments",
    [
        (between(401, 400, 402),),
        (between(380, 400, 399),),
        (between(0, 400, 402),),
        (between(380, 400, 500), Segment(450, LIGHT)),
    ],
    ids=["low", "high", "start", "overlap"],
)
def test_recording_whose_intervals_do_not_fit_is_refused(tmp_path: Path, segments: tuple[Segment, ...]) -> None:
    learned(*segments, alarms=[]).save(tmp_path / "run.npz")
    with pytest.raises(RecordingError, match="segments do not fit together"):
        Run.load(tmp_path / "run.npz")
