"""Exposure: samples in which the trigger was armed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.campaigns.together import direct_bench
from analogrig.catalogue import SteppedFlag
from analogrig.devices.registry import describe, open_dut
from analogrig.judging.exposure import exposure
from analogrig.judging.verdict import judge
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.run import LOST, Run
from analogrig.scenario import Scenario
from analogrig.testing.one_play import Played, rate_below
from analogrig_emulator import CHANNELS
from tests.harness.runs import ESTIMATOR, made_run

from .plants import front

FRONT = front(294.0, 3021.0, 24500.0)

SQUARE_N = np.where(np.arange(600) // 50 % 2, 2000.0, 200.0)


def made(**changes: object) -> Run:
    """Run of 600 samples with an edge of the input every 50."""
    estimator = {**ESTIMATOR, "edge_codes": 64.0, **{key: value for key, value in changes.items() if key != "alarms"}}
    return made_run(SQUARE_N, [(0, FRONT)], estimator=estimator, alarms=changes.get("alarms", ()))  # type: ignore[arg-type]


def test_no_exposure_before_the_first_edge_and_in_the_warm_up() -> None:
    assert exposure(made()).armed == 550
    assert exposure(made(warm_up_n=150)).armed == 450
    assert exposure(made(warm_up_n=600)).armed == 0
    assert "its warm-up takes 600" in exposure(made(warm_up_n=600)).lack_of_evidence


@pytest.mark.parametrize("flag", [LOST, SteppedFlag.MISSING, SteppedFlag.REFUSED])
def test_warm_up_of_no_sample_is_no_reason(flag: int) -> None:
    run = made(warm_up_n=0)
    lost = dataclasses.replace(run, flags=np.full(600, flag, np.uint8))
    assert "none of 600 samples: each was missing, refused or lost" in exposure(lost).lack_of_evidence


def test_no_exposure_during_the_hold_off() -> None:
    assert exposure(made(hold_off_n=30, alarms=(300, 340, 590))).armed == 550 - 30 - 30 - 9


def test_sample_with_an_alarm_is_armed_unless_it_cannot_be() -> None:
    assert exposure(made(edge_codes=1e6, alarms=(20, 70))).armed == 2
    assert exposure(made(warm_up_n=600, alarms=(20, 70))).armed == 0
    assert exposure(made(trigger="none")).armed == 0


def test_missing_samples_and_those_without_an_equation_are_not_exposed() -> None:
    run = made(warm_up_n=150)
    flags = run.flags.copy()
    flags[300:310], flags[310:313] = SteppedFlag.MISSING, SteppedFlag.GATHERING
    assert exposure(dataclasses.replace(run, flags=flags)).armed == 450 - 13


def test_every_record_has_a_warm_up_of_its_own() -> None:
    run = made(warm_up_n=150)
    conditions = dataclasses.replace(run.conditions, records=(0, 300))
    assert exposure(dataclasses.replace(run, conditions=conditions)).armed == 2 * 150


@pytest.mark.parametrize("idle_n", [0, 400])
def test_constant_input_gives_no_exposure_even_without_the_idle_flag(idle_n: int) -> None:
    estimator = {**ESTIMATOR, "edge_codes": 64.0, "idle_n": idle_n}
    run = made_run(200.0 + 0.01 * SQUARE_N, [(0, FRONT)], estimator=estimator)
    found = exposure(run)
    assert (found.armed, found.unexcited) == (0, 600)
    reason = "the trigger was armed in none of 600 samples: in 600 it was not excited (no edge of the input of"
    assert reason in found.lack_of_evidence
    assert not rate_below(0.5, [Played(run)], confidence=0.9)


def test_idle_samples_of_a_device_in_this_process_are_not_exposed() -> None:
    """Pulses 1400 samples apart, where the device calls it lost after 1000: what it says, sample by sample, is the
    reference for trials that have no messages."""
    healthy = Scenario.load("healthy")
    excitation = dataclasses.replace(healthy.excitation, shape="pulse", duty=0.3, frequency_hz=10.0)
    scenario = dataclasses.replace(healthy, samples=9000, excitation=excitation, random_phase=False)
    rig = open_rig("emulator")
    assert isinstance(rig, EmulatorRig)
    with open_dut("inproc", exchange="block") as dut:
        run = Bench(rig, dut).play(scenario, 1)
    idle = (run.flags & SteppedFlag.IDLE) != 0
    assert 1000 < idle.sum() < 4000
    innovations = (run.flags & (SteppedFlag.MISSING | SteppedFlag.REFUSED | SteppedFlag.GATHERING)) == 0
    warm = np.cumsum(innovations) > 150
    force = run.codes[:, CHANNELS.index("force")].astype(int)
    moved = np.maximum.accumulate(np.abs(force - force[0])) >= 64
    expected = int((innovations & warm & moved & ~idle).sum())
    assert exposure(run).armed == expected
    within = exposure(direct_bench(rig, describe("inproc"), alarms_only=True).play(scenario, 1))
    assert (within.armed, within.unexcited) == (expected, exposure(run).unexcited)


@pytest.mark.parametrize(
    ("estimator", "why"),
    [({"warm_up_n": 600}, "its warm-up takes 600"), ({"trigger": "none"}, "the device has no trigger")],
)
def test_run_in_which_no_alarm_could_come_is_inconclusive(estimator: dict[str, object], why: str) -> None:
    verdict = judge(made(**estimator))
    assert verdict.outcome == "inconclusive"
    assert verdict.reasons == (f"the trigger was armed in none of 600 samples: {why}",)
    assert judge(made()).outcome == "passed"


@pytest.mark.parametrize("lost", ["theta", "innovation", "statistic"])
def test_non_finite_estimate_makes_the_run_inconclusive(lost: str) -> None:
    run = made()
    array = getattr(run, lost).copy()
    array[400:] = np.nan
    broken = dataclasses.replace(run, **{lost: array})
    assert exposure(broken).armed == exposure(run).armed - 200
    assert judge(broken).reasons == ("the device reported non-finite estimates in 200 of 600 samples",)
    assert judge(broken).outcome == "inconclusive"


def test_noise_of_the_card_is_no_edge_even_with_tiny_edge_codes() -> None:
    """Constant force with noise of 1 LSB; the device takes 1 code for an edge."""
    force_n = 1400.0 + np.random.default_rng(4).normal(0.0, 2940.0 / 4096, 2000)
    run = made_run(force_n, [(0, FRONT)], estimator={**ESTIMATOR, "edge_codes": 1.0, "idle_n": 1000})
    assert exposure(run).armed == 0
