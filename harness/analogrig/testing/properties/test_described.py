"""A device runs the estimator that its file describes, for any settings and samples, and converses as catalogued.

The bundled library in this process states what is due. The last two properties ask nothing of how a device estimates:
every setting has its effect and loses it, and a record may end anywhere.
"""

from __future__ import annotations

import dataclasses

import pytest

from analogrig.scenario import PotChange, Scenario
from analogrig.testing.properties.cases import CASES, DRAWN_N, HEALTHY, MISFITS, case_of
from analogrig.testing.properties.claimed import answers_as_claimed, computes_what_it_describes
from analogrig.testing.properties.conversed import PORTS, converses_as_catalogued
from analogrig.testing.properties.scripts import SCRIPTS, is_for
from analogrig.testing.properties.switches import OPTIONS, option_comes_and_goes, record_may_end_anywhere
from analogrig.testing.statement import Finding, Play

SEED = 1


def computes(play: Play, case: str) -> Finding:
    return computes_what_it_describes(play, case_of(case).scenario, SEED, case=case)


@pytest.mark.hil_needs("change", "excite")
@pytest.mark.parametrize("case", CASES)
def test_device_computes_what_it_describes(hil_play: Play, case: str) -> None:
    assert computes(hil_play, case)


@pytest.mark.hil_needs("change", "excite")
@pytest.mark.parametrize("number", range(DRAWN_N))
def test_drawn_cases_are_computed_as_described(hil_play: Play, number: int) -> None:
    assert computes(hil_play, str(number))


@pytest.mark.hil_needs("change", "excite")
@pytest.mark.parametrize("disturbance", MISFITS)
def test_device_states_misfits_as_described(hil_play: Play, disturbance: str) -> None:
    assert computes(hil_play, disturbance)


@pytest.mark.parametrize(
    ("script", "port"),
    [(script, port) for script in SCRIPTS for port in PORTS if is_for(script, can=bool(port))],
    ids=lambda value: value or "own port",
)
def test_device_converses_as_catalogued(hil_play: Play, script: str, port: str) -> None:
    assert converses_as_catalogued(hil_play, Scenario.load("healthy"), SEED, script=script, port=port)


CLAIM_SEED = 11

PLAYS_N = 2
"""Successive plays: the second shows what the first has left."""

SHORT = dataclasses.replace(Scenario.load("thesis"), name="claimed")

WRAP_N = 1 << 16
"""Samples after which a counter of 16 bits wraps."""

LONG = dataclasses.replace(
    SHORT,
    name="claimed-beyond-2-16",
    samples=WRAP_N + 1200,
    changes=(PotChange(WRAP_N - 400, {"K": 20_000.0}), PotChange(WRAP_N + 300, {"K": 24_500.0})),
)
"""The plant changes before and after the counters wrap."""


@pytest.mark.hil_needs("change", "excite")
@pytest.mark.parametrize("gaps", [False, True], ids=["whole", "with gaps"])
def test_answers_are_those_of_the_bundled_library(hil_play: Play, *, gaps: bool) -> None:
    assert answers_as_claimed(hil_play, SHORT, CLAIM_SEED, plays=PLAYS_N, gaps=gaps)


@pytest.mark.hil_needs("change", "excite")
def test_answers_beyond_65536_samples_are_those_of_the_bundled_library(hil_play: Play) -> None:
    assert answers_as_claimed(hil_play, LONG, CLAIM_SEED, plays=1)


BRIEF = dataclasses.replace(HEALTHY, samples=180, name="short")

ENDS_N = 15
"""One more than the samples of a block."""


@pytest.mark.hil_needs("change", "excite")
@pytest.mark.parametrize("option", OPTIONS)
def test_option_has_its_effect_and_loses_it(hil_play: Play, option: str) -> None:
    assert option_comes_and_goes(hil_play, OPTIONS[option].case.scenario, SEED, option=option)


@pytest.mark.hil_needs("excite")
def test_a_record_may_end_anywhere(hil_play: Play) -> None:
    assert record_may_end_anywhere(hil_play, BRIEF, SEED, ends=ENDS_N)
