"""A device computes what it describes: every setting, against the project's own reference in float64."""

from __future__ import annotations

import pytest

from analogrig.testing.properties.described import computes_what_it_describes
from analogrig.testing.reference.cases import CASES
from analogrig.testing.statement import Play

SEED = 1


@pytest.mark.hil_needs("tweak", "excite")
@pytest.mark.parametrize("case", CASES)
def test_device_computes_what_it_describes(hil_play: Play, case: str) -> None:
    assert computes_what_it_describes(hil_play, CASES[case].scenario, SEED, case=case)
