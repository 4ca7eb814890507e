"""A device computes what it describes, and converses as the catalogue demands: every setting and every message.

Both are compared with the project's own reference, in float64.
"""

from __future__ import annotations

import pytest

from analogrig.scenario import Scenario
from analogrig.testing.properties.conversed import PORTS, converses_as_catalogued
from analogrig.testing.properties.described import computes_what_it_describes
from analogrig.testing.reference.cases import CASES
from analogrig.testing.reference.scripts import SCRIPTS
from analogrig.testing.statement import Play

SEED = 1


@pytest.mark.hil_needs("tweak", "excite")
@pytest.mark.parametrize("case", CASES)
def test_device_computes_what_it_describes(hil_play: Play, case: str) -> None:
    assert computes_what_it_describes(hil_play, CASES[case].scenario, SEED, case=case)


@pytest.mark.parametrize("port", PORTS, ids=[port or "own port" for port in PORTS])
@pytest.mark.parametrize("script", SCRIPTS)
def test_device_converses_as_catalogued(hil_play: Play, script: str, port: str) -> None:
    assert converses_as_catalogued(hil_play, Scenario.load("healthy"), SEED, script=script, port=port)
