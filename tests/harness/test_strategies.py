"""The strategies draw scenarios that are playable, within what the device is held to, and simple when it is shrunk."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Callable

import hypothesis
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings

from analogrig import config
from analogrig.bench import Bench
from analogrig.campaigns.together import direct_bench
from analogrig.devices.library import InprocDevice
from analogrig.devices.registry import open_dut
from analogrig.errors import AnalogrigError
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.information import detectable, predicted_bounds
from analogrig.judging.verdict import judge
from analogrig.program import Program
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorDescription, EmulatorRig
from analogrig.scenario import PotChange, Scenario
from analogrig.testing.one_play import Played
from analogrig.testing.strategies import (
    BETWEEN_CHANGES_N,
    DAMPING_RATIO,
    FIRST_CHANGE_N,
    REACH,
    link_faults,
    random_suspensions,
    rigs,
    scenarios,
    seeds,
)
from analogrig_emulator import Excitation
from tests.harness.plants import front
from tests.harness.runs import made_run

quick = settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])


@pytest.fixture(scope="module")
def bench() -> Bench:
    rig = open_rig("emulator")
    assert isinstance(rig, EmulatorRig)
    return direct_bench(rig, InprocDevice(name="inproc"))


def test_drawn_scenario_makes_a_valid_run_and_can_be_written_to_a_file(bench: Bench) -> None:
    @quick
    @given(scenario=scenarios(together=2), seed=seeds())
    def check(scenario: Scenario, seed: int) -> None:
        assert judge(bench.play(scenario, seed)).valid
        table = tomllib.loads(config.to_toml(scenario.as_table()))
        assert Scenario.from_table(table, "the file") == scenario

    check()


@pytest.mark.parametrize("name", ["dc-motor", "two-mass", "duffing"])
def test_scenarios_of_any_program_stay_in_its_ranges_and_are_judged(bench: Bench, name: str) -> None:
    program = Program.load(name)

    @settings(quick, max_examples=5)
    @given(scenario=scenarios(program=program, most_changes=1), seed=seeds())
    def check(scenario: Scenario, seed: int) -> None:
        assert scenario.program == program
        for segment in scenario.segments():
            for parameter, value in segment.plant.parameters().items():
                row = program.parameters[parameter]
                assert row.low <= value <= row.high
        verdict = judge(bench.play(scenario, seed))
        assert verdict.valid
        assert len(verdict.changes) == 1

    check()


def test_drawn_rig_can_be_set_up() -> None:
    @quick
    @given(rig=rigs())
    def check(rig: EmulatorDescription) -> None:
        EmulatorRig(rig).set_up(Scenario(10, Excitation()), 1)

    check()


def test_drawn_faults_are_such_that_a_line_has() -> None:
    @quick
    @given(faults=link_faults())
    def check(faults: str) -> None:
        assert InprocDevice(name="inproc", wire_faults=faults).faults() is not None or not faults

    check()


def test_changes_come_after_the_warm_up_of_the_default_device() -> None:
    assert EstimatorConfig().warm_up_n < FIRST_CHANGE_N


def test_random_plants_are_those_that_the_device_is_held_to() -> None:
    for plant in random_suspensions(200, seed=3):
        ratio = plant.parameters()["B"] / (2.0 * (plant.parameters()["K"] * plant.parameters()["M"]) ** 0.5)
        assert DAMPING_RATIO[0] - 1e-4 <= ratio <= DAMPING_RATIO[1] + 1e-4
        for name, (low, high) in REACH.items():
            assert low <= plant.parameters()[name] <= high


@pytest.mark.parametrize(
    ("fails", "expected"),
    [
        (lambda _: True, {"samples": FIRST_CHANGE_N + BETWEEN_CHANGES_N, "changes": 1}),
        (lambda scenario: len(scenario.changes) == 2, {"changes": 2}),
        (lambda scenario: any("M" in change.set for change in scenario.changes), {"changes": 1}),
    ],
)
def test_failing_scenario_shrinks_to_the_usual_in_all_that_does_not_matter(
    fails: Callable[[Scenario], bool], expected: dict[str, int]
) -> None:
    found = hypothesis.find(scenarios(), fails, settings=settings(quick, max_examples=200, phases=list(Phase)))
    assert found.plant == front()
    assert found.excitation == Excitation(low_v=0.1, high_v=9.9)
    assert len(found.changes) == expected["changes"]
    assert found.samples == expected.get("samples", found.samples)


HALF = Excitation(low_v=0.1, high_v=9.9)
FALLS = Scenario(1000, HALF, changes=(PotChange(600, {"K": 18000.0}),))


def test_change_of_nothing_that_shows_is_not_detectable() -> None:
    assert detectable(FALLS, 1e5, rig="emulator")
    still = dataclasses.replace(HALF, low_v=0.0, high_v=0.0)
    assert not detectable(dataclasses.replace(FALLS, excitation=still), 1e5, rig="emulator")
    assert not detectable(dataclasses.replace(FALLS, samples=602), 1e300, rig="emulator")


def test_predicted_bound_is_that_of_the_run(bench: Bench) -> None:
    (predicted,) = predicted_bounds(FALLS, 1e5, rig="emulator")
    (change,) = judge(bench.play(FALLS, 1)).changes
    assert predicted is not None and change.bound_n is not None
    assert abs(predicted - change.bound_n) <= 1


def test_played_says_what_it_shows_and_why(bench: Bench) -> None:
    played = Played(bench.play(dataclasses.replace(FALLS, name="falls"), 1))
    assert played.detects(within=6.0) and played.stays_quiet() and played.estimates(0.05) and played.isolates()
    late = played.detects(within=0.0)
    assert not late and "K at 600" in late.why and "allowed 1" in late.why
    assert not Played(bench.play(dataclasses.replace(FALLS, changes=()), 1)).detects()


def test_estimate_follows_itself_within_a_tube_and_not_what_comes_later(bench: Bench) -> None:
    played = Played(bench.play(FALLS, 1))
    theta = played.run.theta.astype(float)
    assert played.follows(theta, 0.0)
    shifted = theta.copy()
    shifted[5:] = theta[:-5]
    assert not played.follows(shifted, 1e-9)
    shifted[-5:] = np.nan  # what comes later is not known there
    assert played.follows(shifted, 1e-9, time_tolerance=5)
    with pytest.raises(ValueError, match="reference has the shape"):
        played.follows(theta[:-1], 0.1)


def test_alarms_without_a_change_are_counted() -> None:
    finding = Played(made_run(np.zeros(100), [(0, front())], alarms=[7, 50])).stays_quiet()
    assert not finding and finding.why == "2 false alarms in 100 samples: 7, 50"


def test_prediction_takes_the_card_of_the_rig_and_the_program_of_the_scenario() -> None:
    """The channels of dc-motor have 25 V on 12 bits, those of front 10 or 20 V."""
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        for name in ("dc-motor", "pendulum", "rc-battery"):
            scenario = dataclasses.replace(Scenario.load(name), random_phase=False)
            verdict = judge(Bench(rig, dut).play(scenario, 1))
            predicted = predicted_bounds(scenario, verdict.arl0, rig=rig)
            for expected, change in zip(predicted, verdict.changes, strict=True):
                assert (expected is None) == (change.bound_n is None)
                assert expected is None or abs(expected - (change.bound_n or 0)) <= 1


@pytest.mark.parametrize("rig", ["recording:fixtures/recordings/simulated.npz", "red-pitaya"])
def test_prediction_needs_an_emulated_rig(rig: str) -> None:
    with pytest.raises(AnalogrigError):
        detectable(FALLS, 1e5, rig=rig)


def test_prediction_has_no_default_rig() -> None:
    with pytest.raises(TypeError, match="rig"):
        detectable(FALLS, 1e5)  # type: ignore[call-arg]
