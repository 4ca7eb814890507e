"""Numbers that statements, plays and predictions take: what is none, or out of range, gives one line."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.devices.registry import open_dut
from analogrig.errors import AnalogrigError, ConfigurationError
from analogrig.judging.information import detectable, predicted_bounds
from analogrig.judging.verdict import Verdict, judge
from analogrig.rigs.description import open_rig
from analogrig.scenario import PotChange, Scenario
from analogrig.testing.one_play import Played, rate_below
from analogrig.testing.statement import with_some_seed
from tests.harness.commands import error_of
from tests.harness.plants import front
from tests.harness.runs import made_run

FRONT, SOFT = (front(115.0, 3021.0, stiffness) for stiffness in (24500.0, 18000.0))
N = 800
SQUARE_N = np.where(np.arange(N) // 50 % 2, 2000.0, 200.0)
CHANGED = Played(made_run(SQUARE_N, [(0, FRONT), (400, SOFT)], alarms=[410]))

NO_LIMIT: tuple[Any, ...] = (1e308, -1e308, "4", math.nan, math.inf, -math.inf, -1, -1e-9, True, [4.0], 10**400, 4 + 0j)
"""Values that no statement takes as a limit."""

STATEMENTS = {
    "detects": lambda value: CHANGED.detects(within=value),
    "estimates": lambda value: CHANGED.estimates(within=value),
    "responds": lambda value: CHANGED.responds(within=value),
    "rate_below: rate": lambda value: rate_below(value, [CHANGED], confidence=0.9),
    "rate_below: confidence": lambda value: rate_below(0.1, [CHANGED], confidence=value),
    "rate_below: burst": lambda value: rate_below(0.1, [CHANGED], confidence=0.9, burst=value),
    "follows: time_tolerance": lambda value: CHANGED.follows(CHANGED.run.theta, 1.0, time_tolerance=value),
}


def check_line(error: BaseException, *words: str) -> None:
    text = str(error)
    assert "\n" not in text and len(text) < 200
    assert all(word in text for word in words)


@pytest.mark.parametrize("value", NO_LIMIT, ids=lambda value: str(value)[:12])
@pytest.mark.parametrize("statement", STATEMENTS)
def test_wrong_limit_is_one_line_with_its_name(statement: str, value: Any) -> None:
    with pytest.raises(ConfigurationError) as caught:
        STATEMENTS[statement](value)
    assert isinstance(caught.value, ValueError)
    check_line(caught.value, *statement.split(": "), "must be")


@pytest.mark.parametrize("value", [0, 1.0, 99, 1e30])
@pytest.mark.parametrize("statement", ["rate_below: rate", "rate_below: confidence"])
def test_rate_and_confidence_lie_between_0_and_1(statement: str, value: float) -> None:
    with pytest.raises(ConfigurationError, match=rf"^{statement}: must be between 0 and 1, both excluded, not "):
        STATEMENTS[statement](value)


@pytest.mark.parametrize("value", [0, 0.5])
def test_burst_has_at_least_one_alarm(value: float) -> None:
    with pytest.raises(ConfigurationError, match=r"^rate_below: burst: must be 1 or more, not "):
        STATEMENTS["rate_below: burst"](value)


@pytest.mark.parametrize("tolerance", ["4", math.nan, -1.0, [1.0, 2.0], [[1.0], [2.0, 3.0]], True, None], ids=str)
def test_wrong_tolerance_is_one_line(tolerance: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"^follows: tolerance") as caught:
        CHANGED.follows(CHANGED.run.theta, tolerance)
    check_line(caught.value)


@pytest.mark.parametrize("value", [4, np.float32(4.0), np.int64(4), np.float64(4.0), 1e30, 0])
def test_numbers_of_any_kind_are_limits(value: Any) -> None:
    for finding in (CHANGED.detects(within=value), CHANGED.estimates(within=value), CHANGED.responds(within=value)):
        assert finding.why
    assert CHANGED.follows(CHANGED.run.theta, value, time_tolerance=10**12)


@pytest.mark.parametrize("tries", [0, -1, 1001, 2.5, "3", True, math.nan], ids=str)
def test_wrong_number_of_tries_is_one_line(tries: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"^with_some_seed: tries: must be"):
        with_some_seed(None, "thesis", 1, lambda played: played.passes(), tries)  # type: ignore[arg-type]


# --------------------------------------------------------------------------------------------------------------- seeds


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        yield Bench(rig, dut)


@pytest.mark.parametrize("seed", ["4", -1, 2**63, 1e308, math.nan, math.inf, 4.5, True, [4], None], ids=str)
def test_wrong_seed_is_one_line(bench: Bench, seed: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"^seed must be a whole number from 0 to 2\^63 - 1, not ") as caught:
        bench.play("healthy", seed)
    check_line(caught.value)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"burst": "0", "bounds": "bursts"}, "burst must be 1 to 1000, not 0"),
        ({"burst": "nan", "bounds": "bursts"}, "burst must be 1 to 1000, not nan"),
        ({"confidence": "99"}, "confidence must be more than 0.5 and less than 1, not 99"),
        ({"far": "nan"}, "far must be more than 0 and less than 0.1 per sample, not nan"),
    ],
    ids=str,
)
def test_wrong_option_of_certify_is_one_line(options: Mapping[str, str], why: str) -> None:
    words = [word for name, value in options.items() for word in (f"--{name}", value)]
    said = error_of("certify", "--dut", "inproc", "--workers", "1", "--far", "0.01", *words)
    assert why in said and said.count("\n") == 1


# --------------------------------------------------------------------------------------------------------- predictions


@pytest.mark.parametrize("arl0", ["1e5", -1, 0, 1, math.nan, math.inf, True, None, [1e5]], ids=str)
def test_wrong_arl0_is_one_line(arl0: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"^arl0 must be a finite number of samples above 1, not") as caught:
        detectable("thesis", arl0, rig="emulator")
    check_line(caught.value)


def check_bounds(predicted: list[int | None], verdict: Verdict) -> None:
    """Equal but for one sample, which the start of the play in other real parts may cost."""
    for expected, change in zip(predicted, verdict.changes, strict=True):
        assert (expected is None) == (change.bound_n is None)
        assert abs((expected or 0) - (change.bound_n or 0)) <= 1


def fixed(scenario: Scenario) -> Scenario:
    return dataclasses.replace(scenario, random_phase=False, samples=1200)


@pytest.mark.parametrize(
    ("changed", "program"),
    [(parameter, name) for parameter in "MK" for name in ("front", "bump-stop", "two-mass")] + [("M", "shock")],
)
def test_prediction_with_a_program_is_that_of_the_table_of_a_run(bench: Bench, changed: str, program: str) -> None:
    change = PotChange(sample=1000, set={changed: {"M": 92.0, "K": 18000.0}[changed]})
    scenario = dataclasses.replace(fixed(Scenario.of_program("front")), changes=(change,))
    verdict = judge(bench.play(scenario.on_program(program), 1))
    predicted = predicted_bounds(scenario, verdict.arl0, rig="emulator", program=program)
    check_bounds(predicted, verdict)
    assert detectable(scenario, verdict.arl0, rig="emulator", program=program) == (None not in predicted)


@pytest.mark.parametrize("program", ["dc-motor", "pendulum"])
def test_prediction_of_a_scenario_on_its_own_program_is_that_of_the_table_of_a_run(bench: Bench, program: str) -> None:
    scenario = fixed(Scenario.of_program(program))
    verdict = judge(bench.play(scenario, 1))
    predicted = predicted_bounds(scenario, verdict.arl0, rig="emulator", program=program)
    check_bounds(predicted, verdict)


def test_prediction_with_a_program_that_lacks_the_changed_parameter_is_one_line() -> None:
    with pytest.raises(AnalogrigError, match="program dc-motor: unknown parameter 'K'"):
        detectable("thesis", 1e5, rig="emulator", program="dc-motor")


def test_prediction_loads_the_scenario_that_is_named() -> None:
    scenario = Scenario.load("thesis")
    assert predicted_bounds("thesis", 1e5, rig="emulator") == predicted_bounds(scenario, 1e5, rig="emulator")
    assert scenario.changes and isinstance(scenario.changes[0], PotChange)
