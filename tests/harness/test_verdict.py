"""Verdicts on synthetic runs."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence

import numpy as np
import pytest

from analogrig.catalogue import Change
from analogrig.judging.verdict import NOTHING_TO_DETECT, DiagnosisVerdict, as_json, judge
from analogrig.plant import Plant
from analogrig.run import LOST
from tests.harness.runs import ESTIMATOR, made_run

from .plants import front

FRONT = front(115.0, 3021.0, 24500.0)
SOFT = front(115.0, 3021.0, 18000.0)
LOADED = np.full(800, 2900.0)
CHANGE = [(0, FRONT), (400, SOFT)]


def test_quiet_run_without_changes_passes() -> None:
    verdict = judge(made_run(LOADED, [(0, FRONT)]))
    assert (verdict.outcome, verdict.reasons, verdict.false_alarms) == ("passed", (), ())


def test_alarm_after_the_change_is_its_detection() -> None:
    verdict = judge(made_run(LOADED, CHANGE, alarms=[404]))
    (change,) = verdict.changes
    assert (change.sample, change.what, change.latency_n) == (400, "K", 4)
    assert (change.before, change.after) == ({"K": 24500.0}, {"K": 18000.0})
    assert verdict.outcome == "passed"


def test_alarm_at_the_instant_of_the_change_is_false() -> None:
    """The sample at which a pot jumps was taken before the jump could act."""
    verdict = judge(made_run(LOADED, CHANGE, alarms=[400, 404]))
    assert verdict.false_alarms == (400,)
    assert verdict.changes[0].latency_n == 4
    assert verdict.outcome == "failed"


def test_second_alarm_after_a_change_is_false() -> None:
    verdict = judge(made_run(LOADED, CHANGE, alarms=[404, 405, 700]))
    assert verdict.false_alarms == (405, 700)


def test_detectable_change_without_an_alarm_is_missed() -> None:
    verdict = judge(made_run(LOADED, CHANGE))
    assert verdict.changes[0].missed
    assert verdict.outcome == "failed"
    assert verdict.reasons == ("missed 1 of 1 change (K at 400), at most 0 expected",)


def test_change_just_before_the_end_without_an_alarm_is_not_missed() -> None:
    late = judge(made_run(LOADED, [(0, FRONT), (785, SOFT)]))
    assert late.changes[0].bound_n is not None
    assert late.changes[0].result == "unseeable"
    assert late.reasons == (NOTHING_TO_DETECT,)
    assert judge(made_run(LOADED, [(0, FRONT), (760, SOFT)])).changes[0].missed


def test_undetectable_change_without_an_alarm_proves_nothing() -> None:
    verdict = judge(made_run(np.zeros(800), CHANGE))
    assert verdict.changes[0].bound_n is None
    assert not verdict.changes[0].missed
    assert (verdict.outcome, verdict.reasons) == ("inconclusive", (NOTHING_TO_DETECT,))


def test_alarm_after_a_change_without_information_is_false() -> None:
    verdict = judge(made_run(np.zeros(800), CHANGE, alarms=[404]))
    assert verdict.false_alarms == (404,)
    assert verdict.changes[0].result == "unseeable"
    assert verdict.outcome == "failed"


def test_late_alarm_fails_and_names_its_deadline() -> None:
    verdict = judge(made_run(LOADED, CHANGE, alarms=[500]))
    assert verdict.changes[0].late
    assert verdict.outcome == "failed"
    deadline = f"later than its deadline of {verdict.changes[0].deadline_n} samples (bound "
    assert f"K at 400 was detected after 100 samples, {deadline}" in verdict.reasons[0]
    assert verdict.reasons[0].endswith("; [expect] late_information_ratio = 4, late_slack_n = 15)")


def test_scenario_sets_the_limits_of_missed_changes_and_false_alarms() -> None:
    expect = {"missed": 1, "false_alarms": 2}
    assert judge(made_run(LOADED, CHANGE, alarms=[10, 20], expect=expect)).outcome == "passed"


def test_bound_assumes_the_arl0_of_the_trigger() -> None:
    strict = judge(made_run(LOADED, CHANGE, estimator={**ESTIMATOR, "ceiling": math.log(1e12)}))
    usual = judge(made_run(LOADED, CHANGE))
    assert strict.changes[0].bound_n is not None and usual.changes[0].bound_n is not None
    assert strict.changes[0].bound_n > usual.changes[0].bound_n
    assert usual.arl0 == pytest.approx(1e5, rel=1e-4)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"faults": ("device host: gone",)}, "device host: gone"),
        ({"samples_asked": 900}, "the run ended after 800 of 900 samples: the rig, recording or log gave no more"),
        ({"clipped": np.arange(800) % 3 == 0}, "267 of 800 samples were clipped"),
    ],
    ids=["fault", "short", "clipped"],
)
def test_invalid_run_is_inconclusive_even_with_perfect_detections(changes: dict[str, object], reason: str) -> None:
    verdict = judge(made_run(LOADED, CHANGE, alarms=[404], **changes))  # type: ignore[arg-type]
    assert verdict.outcome == "inconclusive"
    assert not verdict.valid
    assert reason in verdict.reasons[0]


@pytest.mark.parametrize(
    ("lost", "most", "counted", "reasons"),
    [
        ([30, 31], 2, 2, ()),
        ([30, 799], 2, 1, ()),
        ([30, 31], 1, 2, ("2 samples were lost on the way to the device, more than 1",)),
        ([], 0, 3, ("the device counted 3 lost samples, the harness 0",)),
        ([30], 5, 0, ("the device counted 0 lost samples, the harness 1",)),
    ],
    ids=["allowed", "last", "too many", "unknown", "untrue"],
)
def test_lost_samples_must_match_the_device_and_stay_within_the_limit(
    lost: list[int], most: int, counted: int, reasons: tuple[str, ...]
) -> None:
    """The device cannot count samples lost after the last one it received."""
    run = made_run(LOADED, CHANGE, alarms=[404])
    run.flags[lost] |= LOST
    conditions = dataclasses.replace(
        run.conditions, dut={**run.conditions.dut, "most_lost_n": most}, counters={"samples_lost": counted}
    )
    verdict = judge(dataclasses.replace(run, conditions=conditions))
    assert verdict.reasons == reasons
    assert verdict.outcome == ("inconclusive" if reasons else "passed")


def test_change_after_the_end_of_a_short_run_is_not_judged() -> None:
    verdict = judge(made_run(LOADED[:300], CHANGE, samples_asked=800))
    assert verdict.changes == ()
    assert verdict.outcome == "inconclusive"


def test_theta_hash_is_sha256_of_the_float32_bits() -> None:
    theta = np.linspace(-1.0, 1.0, 12).reshape(2, 6)
    expected = hashlib.sha256(theta.astype("<f4").tobytes()).hexdigest()
    assert judge(made_run(LOADED[:2], [(0, FRONT)], theta=theta)).theta_hash == expected


def test_json_has_the_documented_keys() -> None:
    out = as_json(judge(made_run(LOADED, CHANGE, alarms=[404])))
    promised = {"sample": 400, "what": "K", "from": {"K": 24500.0}, "to": {"K": 18000.0}, "latency": 4}
    assert out["changes"][0].items() >= promised.items()
    assert {"outcome", "valid", "false_alarms", "estimates", "theta_hash", "arl0"} <= out.keys()


# ---- diagnoses


def told(
    *diagnoses: tuple[int, Change, int, float], after: Plant = SOFT, alarms: Sequence[int] = (404,)
) -> DiagnosisVerdict | None:
    """Verdict on ``diagnoses`` of an excited run whose plant changes at sample 400."""
    force = np.where(np.arange(800) // 50 % 2, 2900.0, 0.0)
    verdict = judge(made_run(force, [(0, FRONT), (400, after)], alarms=alarms, diagnoses=diagnoses))
    return verdict.changes[0].diagnosis


def test_right_diagnosis_has_delay_extent_and_onset_against_the_truth() -> None:
    said = told((420, Change.STIFFNESS, 398, 0.75))
    assert said is not None
    assert (said.named, said.right, said.delay_n, said.onset_error_n, said.extent) == ("K", True, 20, -2, 0.75)
    assert said.extent_error == pytest.approx(0.75 / (18000.0 / 24500.0) - 1.0)
    assert said.bound_n is not None
    assert 2 < said.bound_n < 40


def test_wrong_diagnosis_has_no_error_of_its_extent() -> None:
    said = told((420, Change.MASS, 398, 1.3))
    assert said is not None
    assert (said.named, said.right, said.extent_error) == ("M", False, None)
    assert said.extent == pytest.approx(1.3)


def test_several_is_right_if_more_than_one_has_changed() -> None:
    said = told((420, Change.SEVERAL, 404, 1.0), after=front(115.0, 2000.0, 18000.0))
    assert said is not None
    assert (said.named, said.right, said.extent, said.extent_error) == ("several", True, None, None)
    said = told((420, Change.SEVERAL, 404, 1.0))
    assert said is not None
    assert (said.named, said.right) == ("several", False)


def test_fault_of_a_channel_is_wrong_where_a_parameter_has_changed() -> None:
    said = told((420, Change.FORCE_GAIN, 398, 1.2))
    assert said is not None
    assert (said.named, said.right, said.extent, said.extent_error) == ("force gain", False, None, None)


def test_diagnosis_without_a_detection_is_not_attributed() -> None:
    assert told((403, Change.STIFFNESS, 395, 0.75)) is None
    assert told((420, Change.STIFFNESS, 395, 0.75), alarms=()) is None
    assert told() is None


def test_wrong_diagnosis_does_not_fail_a_run() -> None:
    run = made_run(LOADED, CHANGE, alarms=[404], diagnoses=[(420, Change.MASS, 398, 1.3)])
    assert judge(run).outcome == "passed"


def test_json_has_the_diagnosis_of_each_change() -> None:
    run = made_run(LOADED, CHANGE, alarms=[404], diagnoses=[(420, Change.STIFFNESS, 398, 0.75)])
    (change,) = as_json(judge(run))["changes"]
    assert (change["diagnosis"]["named"], change["diagnosis"]["right"]) == ("K", True)
    (change,) = as_json(judge(made_run(LOADED, CHANGE, alarms=[404])))["changes"]
    assert change["diagnosis"] is None


def test_verdict_is_neither_true_nor_false() -> None:
    """``assert judge(run)`` would hold whatever the device does."""
    with pytest.raises(TypeError, match="neither true nor false"):
        bool(judge(made_run(np.zeros(10), [(0, FRONT)])))
