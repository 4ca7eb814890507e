"""False-failure rates of the shipped properties for a sound device: the table of background/properties.md.

python -m tests.bench properties

Plays in this process, of other seeds than those of the properties themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import hypothesis
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from numpy.typing import NDArray

from analogrig.bench import Bench
from analogrig.campaigns.together import direct_bench
from analogrig.datasheet import DEFAULT_ARL0
from analogrig.devices.registry import describe
from analogrig.judging.information import detectable
from analogrig.judging.statistics import upper_rate
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.scenario import Scenario
from analogrig.testing.one_play import Played
from analogrig.testing.properties.experiments import is_playable
from analogrig.testing.properties.test_detection import (
    DOUBTFUL_LATENCY,
    MOST_INFORMATION,
    MOST_LATENCY,
    MOST_PLAYS_N,
    PATIENT,
    PLAYS_N,
)
from analogrig.testing.properties.test_estimates import WITHIN
from analogrig.testing.statement import TRIES
from analogrig.testing.strategies import profile, scenarios, seeds

from .figure import Figure

PLAYS, DRAWN, CONFIDENCE = 4000, 2000, 0.999
EXAMPLES = profile("ci").max_examples


def figures() -> Iterator[Figure]:
    """Probabilities of a false failure in a run of all tests."""
    yield from _latency()
    clipped = _bench("emulator-0-10v")
    thesis = Scenario.load("thesis")
    failed = sum(not Played(clipped.play(thesis, seed)).passes() for seed in range(10_000, 10_000 + PLAYS))
    yield _of_some_seed("missing samples", failed, PLAYS)
    bench = _bench("emulator")
    patient = scenarios(expect=PATIENT)
    level = DEFAULT_ARL0**MOST_INFORMATION
    found = _failures(patient, bench, Played.passes, lambda each: detectable(each, level, rig="emulator"))
    yield _of_some_seed("changes are found", *found)
    healthy = scenarios(most_changes=0)
    yield _of_some_seed("estimates", *_failures(healthy, bench, lambda each: each.estimates(WITHIN), lambda _: True))


def _bench(name: str) -> Bench:
    rig = open_rig(name)
    assert isinstance(rig, EmulatorRig)
    return direct_bench(rig, describe("inproc"))


def _of_some_seed(name: str, failed: int, plays: int) -> Figure:
    """Probability that one example fails with every seed, from the failures of single plays."""
    chance = EXAMPLES * upper_rate(failed, plays, CONFIDENCE) ** TRIES
    return Figure(f"chance to fail a sound device: {name} ({failed} of {plays} plays failed)", chance, "a run")


def _failures(
    drawn: hypothesis.strategies.SearchStrategy[Scenario],
    bench: Bench,
    statement: Callable[[Played], object],
    is_meant: Callable[[Scenario], bool],
) -> tuple[int, int]:
    """Number of drawn scenarios that fail, and of those played."""
    rig = open_rig("emulator")
    held: list[bool] = []

    @hypothesis.seed(5)
    @settings(
        max_examples=DRAWN,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(scenario=drawn, seed=seeds())
    def play(scenario: Scenario, seed: int) -> None:
        if is_playable(rig, scenario) and is_meant(scenario):
            held.append(bool(statement(Played(bench.play(scenario, seed)))))

    play()
    return held.count(False), len(held)


def _latency() -> Iterator[Figure]:
    """Ratio of latency to bound, and the probability to fail a sound device: Chernoff's bound, as the tail is long."""
    bench, thesis = _bench("emulator"), Scenario.load("thesis")
    latency_n, bound_n = np.array([_sums(Played(bench.play(thesis, 1000 + seed))) for seed in range(PLAYS)]).T
    ratio = latency_n.sum() / bound_n.sum()
    error = np.std(latency_n - ratio * bound_n) / bound_n.mean() / np.sqrt(PLAYS_N)
    yield Figure(f"mean latency over mean bound, thesis, {PLAYS} plays", ratio, "")
    yield Figure(f"its standard error over {PLAYS_N} plays", error, "")
    at_once = _beyond(latency_n - DOUBTFUL_LATENCY * bound_n, PLAYS_N)
    later = _beyond(latency_n - MOST_LATENCY * bound_n, MOST_PLAYS_N)
    yield Figure("chance to fail a sound device: latency over bound", at_once + later, "a run")


def _sums(played: Played) -> tuple[float, float]:
    """Sums of the latencies and of the bounds of a play, in samples."""
    changes = played.verdict.changes
    return float(sum(each.latency_n or 0 for each in changes)), float(sum(each.bound_n or 0 for each in changes))


def _beyond(values: NDArray[np.float64], count: int) -> float:
    """Upper bound of the probability that so many values, drawn from these, add up to more than 0."""
    logs = [np.log(np.mean(np.exp(theta * values))) for theta in np.linspace(0.001, 2.0, 400)]
    return float(np.exp(count * min(logs)))
