"""The properties that any estimator behind the catalogue's messages should have, as tests to run against yours.

    pytest --pyargs analogrig.testing.properties --hil-dut serial:/dev/ttyACM0 --hil-profile nightly

What fails is shrunk to the simplest scenario that still fails, and left as files (see --hil-runs-dir). How seldom a
sound device fails one is derived in harness/docs/background/properties.md.
"""

from __future__ import annotations

from collections.abc import Callable

from analogrig.errors import ConfigurationError
from analogrig.rigs.rig import Rig
from analogrig.scenario import Scenario
from analogrig.testing import experiment
from analogrig.testing.experiment import Play
from analogrig.testing.played import Played
from analogrig.testing.statement import Finding

__all__ = ["TRIES", "Play", "is_playable", "with_some_seed"]

TRIES = 5
"""Number of consecutive seeds with which a statement subject to chance must fail before its test fails."""


def is_playable(rig: Rig, scenario: Scenario) -> bool:
    """True if the rig has the waveform and the pots. A rig that has next to none fails hypothesis's health check."""
    try:
        rig.perform(scenario, 0)
    except ConfigurationError:
        return False
    return True


def with_some_seed(
    play: Play, scenario: str | Scenario, seed: int, judge: Callable[[Played], Finding], tries: int = TRIES
) -> Finding:
    """Finding: a statement holds for a play with ``seed``, or with one of the ``tries - 1`` seeds after it.

    If one play fails a sound device with probability p, this fails it with probability p ** ``tries``. A play that is
    INCONCLUSIVE ends the search; then the finding does not hold.

    :param play: the fixture ``hil_play``.
    :param scenario: a shipped name, a .toml file or a Scenario.
    :param judge: the statement, such as ``Played.stays_quiet``.
    """
    return experiment.with_some_seed(play, scenario, seed, judge, tries)
