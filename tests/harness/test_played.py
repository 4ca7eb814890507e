"""What a play shows, as a test says it."""

from __future__ import annotations

import numpy as np
import pytest

from harness.plant import Plant
from harness.played import Played, rate_below
from tests.harness.runs import made_run

FRONT = Plant(294.0, 3021.0, 24500.0)


@pytest.mark.parametrize("samples", [0, 400])
def test_nothing_holds_of_a_play_that_is_not_valid(samples: int) -> None:
    run = made_run(np.zeros(samples), [(0, FRONT)], faults=("the device died",), samples_asked=1000)
    played = Played(run)
    findings = [
        played.detects(),
        played.stays_quiet(),
        played.isolates(),
        played.estimates(within=1e9),
        played.follows(run.theta, 1.0),
        rate_below(0.5, [played, played], confidence=0.9),
    ]
    assert not any(findings)
    assert all(finding.why.startswith("INCONCLUSIVE: ") and "the device died" in finding.why for finding in findings)
