"""Estimates against the exact response of the circuit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.signal import cont2discrete

from analogrig.bench import Bench
from analogrig.devices.registry import open_dut
from analogrig.judging.response import StepResponse, step_responses
from analogrig.judging.verdict import judge
from analogrig.reporting import run_summary
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig.testing.one_play import Played

SEED = 7


def play(scenario: str, rig: str, device: str = "inproc") -> Run:
    with open_rig(rig) as opened, open_dut(device) as dut:
        return Bench(opened, dut).play(Scenario.load(scenario), SEED)


def with_theta(run: Run, theta: np.ndarray) -> Run:
    return dataclasses.replace(run, theta=np.repeat(theta[None].astype(np.float32), run.samples, axis=0))


def of_program(run: Run) -> Run:
    """The same run as of a rig without a machine, which has the response of the program."""
    return dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, rig={"name": "real"}))


@pytest.fixture(scope="module")
def real() -> Run:
    """Front suspension on real components, which deviate by about a per cent."""
    return play("thesis", "emulator-real")


def test_estimates_follow_the_real_components_and_not_the_program(real: Run) -> None:
    of_circuit = [each.error or 1.0 for each in step_responses(real)]
    assert len(of_circuit) == 5
    assert max(of_circuit) < 0.003
    assert min(each.error or 0.0 for each in step_responses(of_program(real))) > 0.01


def test_theta_of_the_textbook_has_the_response_of_the_program() -> None:
    """Zero-order hold of scipy; the estimate of another plant is off by its gain."""
    run = play("healthy", "emulator-ideal")
    conditions, (mass, damping, stiffness) = run.conditions, run.segments[0][2].values
    plant = ([1.0], [mass, damping, stiffness])
    b, a, _ = cont2discrete(plant, conditions.sample_period_problem_s)
    codes = conditions.input.lsb / conditions.output.lsb
    theta = np.array([*a[1:], *(b[0] * codes), 0.0])
    for judged in (run, of_program(run)):
        (exact,) = step_responses(with_theta(judged, theta))
        (off,) = step_responses(with_theta(judged, theta * [1, 1, 1.05, 1.05, 1.05, 1]))
        assert exact.error is not None
        assert exact.error < 2e-4  # ideal amplifiers and resistors of three digits
        assert off.error == pytest.approx(0.05, abs=3e-4)


def test_unstable_estimate_has_no_error_and_is_found(real: Run) -> None:
    wild = with_theta(real, np.array([-2.1, 1.1, 0.0, 1.0, 0.0, 0.0]))
    assert {each.error for each in step_responses(wild)} == {None}
    finding = Played(wild).responds(1.0)
    assert not finding
    assert "unstable at sample 1200" in finding.why


@pytest.mark.parametrize("scenario", ["two-mass", "dc-motor", "shock"])
def test_estimates_of_linear_programs_respond_like_their_circuits(scenario: str) -> None:
    played = Played(play(scenario, "emulator-real"))
    assert played.responds(0.015)
    assert not played.responds(1e-6)


def test_program_that_is_not_linear_has_no_response_to_judge() -> None:
    played = Played(play("duffing", "emulator"))
    assert not step_responses(played.run)
    assert "the program is not linear" in played.responds(0.1).why


def test_rows_of_long_runs_keep_their_cells_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    run = play("dc-motor", "emulator-ideal")
    monkeypatch.setattr(run_summary, "step_responses", lambda _: (StepResponse(0, 200_000, 0.0001),))
    lines = run_summary.summary(run, judge(run)).splitlines()
    assert "      0-199999 0.01% of the static gain" in lines
