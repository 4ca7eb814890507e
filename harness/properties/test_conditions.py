"""What the generator, the card and the line do is not taken for a change of the plant."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given

from emulator.excitation import Excitation
from harness.bench import Bench
from harness.devices import InprocDevice, describe
from harness.dut import Dut, open_dut
from harness.errors import AnalogrigError
from harness.played import Finding, Played
from harness.properties import Play, with_some_seed
from harness.properties.test_detection import stays_quiet
from harness.rig import EmulatorRig, Rig
from harness.scenario import Scenario
from harness.statistics import Design
from harness.strategies import link_faults, profile, seeds
from harness.trials import Trials, are_possible
from harness.verdict import judge

SHORT = Scenario(samples=300, excitation=Excitation(low_v=0.1, high_v=9.9), name="short")
CERTIFIED = Design(rate=1e-5, confidence=0.999, allowed=5)
CERTIFIED_RUN_N = 20_000


def passes(played: Played) -> Finding:
    return Finding(played.verdict.outcome == "passed", "; ".join(played.verdict.reasons))


@pytest.mark.needs("tweak", "excite")
@profile()
@given(seed=seeds())
def test_edges_that_drift_against_the_samples_are_no_change(play: Play, seed: int) -> None:
    assert with_some_seed(play, "thesis-free-running", seed, stays_quiet)


@pytest.mark.parametrize("rig", ["emulator-0-10v"], indirect=True)
@profile()
@given(seed=seeds())
def test_samples_that_are_missing_are_no_change(play: Play, seed: int) -> None:
    assert with_some_seed(play, "thesis", seed, passes)


@profile()
@given(faults=link_faults(), seed=seeds())
def test_faults_of_the_line_leave_the_estimate_or_the_run_is_inconclusive(
    rig: Rig, dut: Dut, faults: str, seed: int
) -> None:
    described = describe(dut.name)
    if not isinstance(described, InprocDevice):
        pytest.skip(f"every time-out on a real line takes its time: --dut inproc, or make faults, not {dut.name}")
    clean = Bench(rig, dut).play(SHORT, seed)
    try:
        with open_dut(dut.name, wire_faults=faults) as spoiled:
            run = Bench(rig, spoiled).play(SHORT, seed)
    except AnalogrigError:
        return  # refused before the run, with the cause
    assert judge(run).outcome == "inconclusive" or run.theta_hash() == clean.theta_hash()


@pytest.mark.needs("excite")
def test_false_alarms_are_rarer_than_one_in_a_hundred_thousand_samples(rig: Rig, dut: Dut) -> None:
    described = describe(dut.name)
    if not isinstance(rig, EmulatorRig) or not are_possible(rig, described):
        pytest.skip(
            f"takes {CERTIFIED.trials} samples: analogrig certify --far 1e-5 --confidence 0.999 --dut {dut.name}"
        )
    trials = Trials(rig, described)
    scenario = dataclasses.replace(Scenario.load("healthy"), samples=CERTIFIED_RUN_N)
    warm_n = CERTIFIED_RUN_N - described.estimator.warm_up_n
    runs = -(-CERTIFIED.trials // warm_n)
    alarms = sum(len(trials.alarms(scenario, seed)) for seed in range(runs))
    assert alarms <= CERTIFIED.allowed, f"{alarms} false alarms in {runs * warm_n} samples"
