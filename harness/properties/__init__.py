"""The properties that any estimator behind the catalogue's messages should have, as tests to run against yours.

    pytest --pyargs harness.properties --dut serial:/dev/ttyACM0 --hil-profile nightly

What fails is shrunk to the simplest scenario that still fails, and left as files (see --runs-dir). How seldom a sound
device fails one is derived in harness/README.md.
"""

from __future__ import annotations

from collections.abc import Callable

from harness.errors import ConfigurationError
from harness.played import Finding, Played
from harness.rigs.rig import Rig
from harness.scenario import Scenario

__all__ = ["TRIES", "Play", "is_playable", "with_some_seed"]

Play = Callable[..., Played]

TRIES = 5
"""What chance may spoil has failed when it did so with as many seeds, one after the other."""


def is_playable(rig: Rig, scenario: Scenario) -> bool:
    """Whether the rig has the waveform and the pots; one that has next to none fails hypothesis's health check."""
    try:
        rig.perform(scenario, 0)
    except ConfigurationError:
        return False
    return True


def with_some_seed(
    play: Play, scenario: str | Scenario, seed: int, statement: Callable[[Played], Finding], tries: int = TRIES
) -> Finding:
    """Whether a statement about a play holds with this seed, or the next, ...: the last finding.

    With a chance p of one play to fail a sound device, that of this to fail it is p to the power of ``tries``.
    """
    for number in range(tries):
        finding = statement(play(scenario, seed + number))
        if finding:
            break
    return finding
