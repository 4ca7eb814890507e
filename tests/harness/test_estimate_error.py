"""Estimates that the samples contradict fail a run; those that the samples leave open do not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.campaigns.together import direct_bench
from analogrig.catalogue import Cause
from analogrig.devices.registry import describe
from analogrig.judging.estimates import estimate_findings
from analogrig.judging.verdict import judge
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.run import UNREPORTED, Run
from analogrig.scenario import Expectations, PotChange, Scenario

Theta = NDArray[np.float32]
Change = Callable[[Theta], None]

A, B, OFFSET = slice(0, 2), slice(2, 5), 5
"""Columns of theta of the default device: A, B and the offset."""

SHORT = dataclasses.replace(Scenario.load("healthy"), samples=1300, random_phase=False)


MASS_FALLS = dataclasses.replace(SHORT, samples=1500, changes=(PotChange(1150, {"M": 40.0}),))


def play(scenario: Scenario = SHORT, rig_name: str = "emulator", seed: int = 1) -> Run:
    with open_rig(rig_name) as rig:
        assert isinstance(rig, EmulatorRig)
        return direct_bench(rig, describe("inproc")).play(scenario, seed)


@pytest.fixture(scope="module")
def healthy() -> Run:
    return play()


@pytest.fixture(scope="module")
def thesis() -> Run:
    return play(Scenario.load("thesis"))


def changed(run: Run, change: Change) -> Run:
    theta = run.theta.copy()
    change(theta)
    return dataclasses.replace(run, theta=theta)


def scale(columns: slice, factor: float, since: int = 0) -> Change:
    """Change that multiplies columns of theta from a sample on."""

    def change(theta: Theta) -> None:
        theta[since:, columns] *= np.float32(factor)

    return change


def exchange_order(theta: Theta) -> None:
    theta[:, A] = theta[:, 1::-1].copy()


def forget(theta: Theta) -> None:
    theta[:] = 0.0


def slow_poles(theta: Theta) -> None:
    """Double the frequency of the poles exp(s T): a device that takes half of the sample rate."""
    for row in theta[1000:]:
        poles = np.roots([1.0, row[0], row[1]])
        gain = row[B].sum() / (1.0 + row[A].sum())
        row[A] = np.poly(poles**2)[1:].real
        row[B] *= gain * (1.0 + row[A].sum()) / row[B].sum()


WRONG: dict[str, Change] = {
    "input twice as large": scale(B, 0.5),
    "input a tenth": scale(B, 10.0),
    "output a tenth": scale(B, 0.1),
    "output in the other direction": scale(B, -1.0),
    "gain off by 40 %": scale(B, 1.4),
    "gain off by -30 %": scale(B, 0.7),
    "all of theta halved": scale(slice(0, 6), 0.5),
    "A in the reverse order": exchange_order,
    "A with the other sign": scale(A, -1.0),
    "never learnt": forget,
    "another sample rate": slow_poles,
    "overwritten near the end": scale(B, 0.5, since=1250),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_estimates_fail_the_run(healthy: Run, wrong: str) -> None:
    verdict = judge(changed(healthy, WRONG[wrong]))
    assert verdict.outcome == "failed"
    (reason,) = verdict.reasons
    assert reason.startswith("the estimate at the end of samples 0-1299 is off by more than 25% ([expect] estimate_err")


def freeze(theta: Theta) -> None:
    theta[300:] = theta[300]


def test_frozen_estimates_fail_after_a_change() -> None:
    """Least squares finds M within 11 %, the device is 188 % off."""
    run = play(MASS_FALLS)
    assert judge(run).outcome == "passed"
    reasons = judge(changed(run, freeze)).reasons
    assert any("M is 11" in reason and "instead of 40" in reason for reason in reasons), reasons


def alternate(theta: Theta) -> None:
    theta[::2] = 0.0


@pytest.mark.parametrize("wrong", [forget, alternate])
def test_estimate_without_a_number_is_shown_as_none(healthy: Run, wrong: Change) -> None:
    (reason,) = judge(changed(healthy, wrong)).reasons
    assert "M is no number instead of 115" in reason


def test_estimate_that_is_shown_is_off_by_more_than_the_limit(healthy: Run) -> None:
    """The last estimate of all is right."""
    (reason,) = judge(changed(healthy, spoil_all_but_the_last)).reasons
    assert "M is 2" in reason and "M is 115" not in reason, reason


def spoil_all_but_the_last(theta: Theta) -> None:
    theta[:-1, B] *= 0.5


def test_finding_names_value_and_truth(healthy: Run) -> None:
    (reason,) = judge(changed(healthy, scale(B, 2.0))).reasons
    for name, truth in {"M": 115.0, "B": 3021.0, "K": 24500.0}.items():
        (found,) = [part.split(f"{name} is ")[1].split() for part in reason.split(", ") if f"{name} is " in part]
        assert float(found[0]) == pytest.approx(truth / 2.0, rel=0.01)
        assert f"instead of {truth:g}" in reason


@pytest.mark.parametrize(("segment", "since"), [("1202-1399", 1200), ("1602-1799", 1600)])
def test_segment_after_a_detected_change_is_judged(thesis: Run, segment: str, since: int) -> None:
    reasons = judge(changed(thesis, scale(B, 0.5, since))).reasons
    assert any(reason.startswith("the estimate at the end of samples") for reason in reasons)
    assert judge(thesis).outcome == "passed"
    assert segment


@pytest.mark.parametrize("wrong", [scale(B, 0.85), scale(B, 1.2), scale(B, 0.5, since=1295)])
def test_small_errors_and_a_short_excursion_pass(healthy: Run, wrong: Change) -> None:
    assert judge(changed(healthy, wrong)).outcome == "passed"


def test_limit_is_that_of_the_scenario(healthy: Run) -> None:
    wrong = changed(healthy, scale(B, 0.85))
    assert [*estimate_findings(wrong, 0.1)]
    assert not [*estimate_findings(changed(healthy, scale(B, 0.5)), 2.0)]
    with pytest.raises(ValueError, match="^estimate_error must be more than 0, not 0"):
        Expectations(estimate_error=0.0)


def excited(**changes: float | str) -> Scenario:
    return dataclasses.replace(SHORT, excitation=dataclasses.replace(SHORT.excitation, **changes))  # type: ignore[arg-type]


OPEN: dict[str, Scenario] = {
    "constant force": excited(low_v=5.0, high_v=5.01),
    "force of two codes": excited(low_v=5.0, high_v=5.005),
    "last edge long ago": excited(frequency_hz=10.0),
    "too short a run": dataclasses.replace(SHORT, samples=540),
}


@pytest.mark.parametrize("case", OPEN)
def test_what_the_samples_leave_open_is_not_judged(case: str) -> None:
    assert not [*estimate_findings(changed(play(OPEN[case]), scale(B, 0.5)), 0.25)]


def test_slow_sine_determines_the_stiffness_alone() -> None:
    wrong = changed(play(excited(shape="sine", frequency_hz=5.0)), scale(B, 0.5))
    (reason,) = estimate_findings(wrong, 0.25)
    assert "K is" in reason
    assert "M is" not in reason
    assert "B is" not in reason


def with_misfit(run: Run) -> Run:
    columns = {"index": 1200, "cause": Cause.HUM, "frequency": 0.0025, "strength": 2.0}
    arrays: dict[str, Any] = {
        f"misfit_{name}": np.array([value], getattr(run, f"misfit_{name}").dtype) for name, value in columns.items()
    }
    return dataclasses.replace(run, **arrays)


def without_reports(run: Run) -> Run:
    return dataclasses.replace(run, flags=run.flags | np.uint8(UNREPORTED))


def with_late_alarm(run: Run) -> Run:
    alarm = {"index": 1200, "kind": 3, "statistic": 12.0}
    arrays: dict[str, Any] = {
        f"alarm_{name}": np.array([value], getattr(run, f"alarm_{name}").dtype) for name, value in alarm.items()
    }
    return dataclasses.replace(run, **arrays)


def without_orders(run: Run) -> Run:
    sheet = {"theta_n": 6}
    conditions = dataclasses.replace(run.conditions, dut={"name": "bob", "datasheet": sheet})
    return dataclasses.replace(run, conditions=conditions)


@pytest.mark.parametrize("excuse", [with_misfit, without_reports, with_late_alarm, without_orders])
def test_estimates_that_the_device_does_not_claim_are_not_judged(healthy: Run, excuse: Callable[[Run], Run]) -> None:
    wrong = changed(healthy, scale(B, 0.5))
    assert [*estimate_findings(wrong, 0.25)]
    assert not [*estimate_findings(excuse(wrong), 0.25)]


def test_change_without_an_alarm_is_not_judged_by_its_estimates(thesis: Run) -> None:
    """A device that averages over all samples keeps the old plant; that it missed the change is said already."""
    silent = dataclasses.replace(
        thesis, **{name: getattr(thesis, name)[:0] for name in ("alarm_index", "alarm_kind", "alarm_statistic")}
    )
    assert not [*estimate_findings(changed(silent, scale(B, 0.5, since=1200)), 0.25)]


@pytest.mark.parametrize("rig", ["emulator", "emulator-real", "emulator-skewed", "emulator-0-10v", "emulator-ideal"])
@pytest.mark.parametrize("scenario", ["thesis", "shock", "thesis-free-running"])
def test_sound_device_is_within_the_limit_on_every_rig(rig: str, scenario: str) -> None:
    for seed in range(3):
        assert not [*estimate_findings(play(Scenario.load(scenario), rig, seed), 0.25)]
