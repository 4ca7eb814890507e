"""Certificate of a device's false-alarm rate against a limit, with a stated error probability.

A plant that does not change is played in runs of one length, with consecutive seeds. The unit of exposure is a sample
in which the trigger was armed (analogrig.judging.exposure). Every alarm is a false one. Rates that would take too long
to observe are estimated by branches with louder noise (analogrig.campaigns.rare). Each of these estimates comes from a
play of its own.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from analogrig.bench import can_be_direct
from analogrig.campaigns.plan import Case, device_of, open_table
from analogrig.campaigns.plays import Count, close_devices, count_alarms
from analogrig.campaigns.rare import LEAD_IN_N, Estimate, false_alarm_rate
from analogrig.campaigns.workers import Workers
from analogrig.datasheet import Datasheet
from analogrig.devices.catalogue_description import has_snapshots
from analogrig.errors import ConfigurationError
from analogrig.judging.statistics import (
    ConfidenceSequence,
    Decision,
    Design,
    SequentialTest,
    lower_rate,
    mean_bounds,
    poisson_mean,
    upper_rate,
)
from analogrig.scenario import Scenario
from analogrig.wording import number_of

IN_PROCESS_RUN_N, BENCH_RUN_N = 100_000, 20_000
"""Approximate samples in a run: in this process, or over a line."""

WORTH_A_WORKER_N = 500_000
"""Samples that a process plays in about the time that another takes to start."""

WORTH_A_WORKER_ESTIMATES = 16
"""Estimates of a rare rate that a process plays in about the time that another takes to start."""

APART = 10.0
"""Ratio of limit to true rate at which the sequential test certifies quickest."""

MOST_LONGER = 3.0
"""Largest length of a sequential test, as a multiple of the length of a fixed one."""

LEAST_ESTIMATES, MOST_ESTIMATES = 64, 10_000
"""Fewest and most estimates of a rare rate.

At a nominal error of 0.1 %, bounds of a mean of 8 estimates are wrong 0.55 % of the time; of 64, 0.18 %.
"""

IN_PROCESS_YEAR_N, BENCH_YEAR_N = 1e14, 3e11
"""Approximate samples played in a year: in this process by one processor, or over a line."""

Answer = Literal["certified", "refuted", "inconclusive"]


@dataclass(frozen=True)
class Question:
    """Test of the hypothesis that the false-alarm rate is below ``far`` per sample.

    ConfigurationError: a setting is out of range, or the question cannot be answered.
    """

    rig: Any
    """Rig as plain values, as ``open_table`` takes it."""
    device: Any
    """Device as plain values, as ``device_of`` takes it."""
    scenario: Scenario
    far: float
    confidence: float
    first_seed: int = 0
    allowed: int = 5
    """Most alarms with which a test of fixed length certifies."""
    sequential: bool = False
    rare: int | None = None
    """Number of estimates of a rare rate; None: count alarms as they occur."""

    def __post_init__(self) -> None:
        problem = self._problem() or (self._length_problem() if self.rare is None else self._rare_problem(self.rare))
        if problem:
            raise ConfigurationError(f"certify: {problem}")

    def _problem(self) -> str:
        """Reason that the question cannot be answered; empty if it can."""
        if not 0.0 < self.far * APART < 1.0:
            return f"far must be more than 0 and less than {1.0 / APART:g} per sample, not {self.far:g}"
        if not 0.5 < self.confidence < 1.0:
            return f"confidence must be more than 0.5 and less than 1, not {self.confidence:g}"
        if not 0 <= self.allowed <= 1000:
            return f"allowed must be 0 to 1000, not {self.allowed}"
        if not self.datasheet.alarms:
            return "the device has no trigger: it raises no alarm, whatever comes"
        if self.scenario.tweaks:
            return "the scenario changes the plant, and this is about alarms while nothing changes"
        return ""

    def _length_problem(self) -> str:
        """Reason that the test would take more than a year of playing; empty if it is short enough."""
        needed = poisson_mean(self.allowed, self.confidence) / self.far
        if needed <= BENCH_YEAR_N or (self.is_in_process and needed <= IN_PROCESS_YEAR_N):
            return ""
        year_n = IN_PROCESS_YEAR_N if self.is_in_process else BENCH_YEAR_N
        return (
            f"far = {self.far:g} takes {needed:.2g} samples, and in a year this device is played some {year_n:.0e}:"
            " a rare rate is estimated instead (--rare)"
        )

    def _rare_problem(self, estimates: int) -> str:
        """Reason that the rare rate cannot be estimated; empty if it can."""
        if not LEAST_ESTIMATES <= estimates <= MOST_ESTIMATES:
            return f"rare must be {LEAST_ESTIMATES} to {MOST_ESTIMATES} estimates, not {estimates}"
        if self.sequential:
            return "a rare rate is estimated, or alarms are waited for by a sequential test"
        edges = self.device.get("estimator", {}).get("edge_instants")
        if self.scenario.excitation.clock == "free" and edges != "anywhere":
            return (
                "of a generator on a clock of its own some instants of its edges are rare, and they are not drawn: wait"
                ' for alarms, or set the device to edge_instants = "anywhere"'
            )
        return ""

    @property
    def useful_workers(self) -> int:
        """Largest useful number of workers; more would take longer to start than to play."""
        if self.rare is not None:
            return max(1, self.rare // WORTH_A_WORKER_ESTIMATES)
        return max(1, self.design_n // WORTH_A_WORKER_N) if self.is_in_process else self.design_n

    @functools.cached_property
    def datasheet(self) -> Datasheet:
        """Data sheet of the device."""
        return device_of(self.device).known_datasheet()

    @functools.cached_property
    def is_in_process(self) -> bool:
        """True if the trials are played within this process, without a line."""
        with open_table(self.rig) as rig:
            return can_be_direct(rig, device_of(self.device))

    @functools.cached_property
    def design_n(self) -> int:
        """Samples of the test of fixed length."""
        return Design(self.far, self.confidence, self.allowed).trials


@dataclass(frozen=True)
class Certificate:
    """Answer to a ``Question``."""

    outcome: Answer
    reason: str
    alarms: int
    """Number of alarms; for a rare rate, of branches that ended in one."""
    samples: int
    """Number of samples in which the trigger was armed; for a rare rate, of samples played."""
    rate: tuple[float, float] = (0.0, 1.0)
    """One-sided bounds: exact for a fixed length, of a mean for a rare rate. A sequential test yields none."""


def certify(
    question: Question, workers: Workers, progress: Callable[[int, int, int], None] | None = None
) -> Certificate:
    """Play until the question is answered. The answer does not depend on the number of workers.

    ``progress`` is called with the samples counted, the samples that may be needed, and the alarms counted.

    :raises ConfigurationError: the scenario cannot be played, or the device refuses its configuration.
    :raises WorkerError, LinkError, DeviceError, RigError: the workers, the link, the device or the rig failed.
    """
    if question.rare is not None:
        return _certify_rare(question, question.rare, workers)
    most = math.ceil(question.design_n * (MOST_LONGER if question.sequential else 1.0))
    run_n = _run_n(question, most)
    work = functools.partial(count_run, question, run_n)
    alarms = samples = 0
    try:
        for count in _in_order(workers, work, question.first_seed):
            alarms, samples = alarms + count.alarms, samples + count.armed
            if progress is not None:
                progress(samples, most, alarms)
            if count.fault:
                return Certificate("inconclusive", count.fault, alarms, samples)
            answer = _sequential(question, alarms, samples) if question.sequential else None
            if samples >= most:
                answer = answer or _at_the_end(question, alarms, samples)
            if answer is not None:
                return answer
    finally:
        close_devices()
    raise AssertionError("seeds do not end")


def count_run(question: Question, run_n: int, seed: int) -> Count:
    """Alarms and exposure of one run."""
    scenario = dataclasses.replace(question.scenario, samples=run_n)
    return count_alarms(Case(question.rig, question.device, scenario, seed))


def _certify_rare(question: Question, count: int, workers: Workers) -> Certificate:
    seeds = range(question.first_seed, question.first_seed + count)
    found = dict(workers.play(functools.partial(estimate_once, question), iter(seeds)))
    estimates = [found[seed] for seed in seeds]
    alarms, samples = sum(each.alarms for each in estimates), sum(each.samples for each in estimates)
    if fruitless := sum(not each.alarms for each in estimates):
        reason = f"in {fruitless} of {number_of(count, 'estimate')} no branch came to an alarm"
        return Certificate("inconclusive", reason, alarms, samples)
    rates = [each.rate for each in estimates]
    low, high = mean_bounds(rates, question.confidence)
    reason = (
        f"the rate is {math.fsum(rates) / count:.3g}, {low:.3g} to {high:.3g}, from {number_of(count, 'estimate')},"
        f" {number_of(samples, 'sample')}"
    )
    return Certificate(_answer(question.far, low, high), reason, alarms, samples, (low, high))


def estimate_once(question: Question, seed: int) -> Estimate:
    """One estimate of a rare rate.

    :raises ConfigurationError: the estimator does not run in this process; other errors as ``false_alarm_rate``.
    """
    device = device_of(question.device)
    with open_table(question.rig) as rig:
        if not (can_be_direct(rig, device) and has_snapshots(device)):
            raise ConfigurationError(
                f"certify: a rare rate is estimated within this process (inproc), not in {device.name}"
            )
        return false_alarm_rate(rig, device, question.scenario, seed)


def _answer(far: float, low: float, high: float) -> Answer:
    return "certified" if high <= far else "refuted" if low > far else "inconclusive"


def _in_order(workers: Workers, work: Any, first_seed: int) -> Iterator[Count]:
    """Yield the counts in order of their seeds, whatever the order of arrival."""
    early: dict[int, Count] = {}
    expected = first_seed
    for seed, count in workers.play(work, itertools.count(first_seed)):
        early[seed] = count
        while expected in early:
            yield early.pop(expected)
            expected += 1


def _run_n(question: Question, most: int) -> int:
    """Run length of which a whole number makes up a test of fixed length."""
    about = IN_PROCESS_RUN_N if question.is_in_process else BENCH_RUN_N
    runs = math.ceil(most / about)
    return math.ceil(most / runs) + question.datasheet.warm_up_n + LEAD_IN_N


def _at_the_end(question: Question, alarms: int, samples: int) -> Certificate:
    """Outcome of the test of fixed length, or of a sequential one that has not decided."""
    counted = f"{number_of(alarms, 'alarm')} in {number_of(samples, 'sample')}"
    if question.sequential:
        return Certificate("inconclusive", f"{counted}, and still undecided", alarms, samples)
    low = lower_rate(alarms, samples, question.confidence)
    high = upper_rate(alarms, samples, question.confidence)
    reason = f"{counted}: the rate is {low:.3g} to {high:.3g}"
    return Certificate(_answer(question.far, low, high), reason, alarms, samples, (low, high))


def _sequential(question: Question, alarms: int, samples: int) -> Certificate | None:
    """Outcome of the sequential tests; None while undecided.

    Wald's test certifies. A confidence sequence refutes; it eventually does so for any rate above the limit.
    """
    error, far = 1.0 - question.confidence, question.far
    reason = f"{number_of(alarms, 'alarm')} in {number_of(samples, 'sample')}, and no more were needed"
    if SequentialTest(far / APART, far, error, error, trials=samples, events=alarms).decision is Decision.BELOW:
        return Certificate("certified", reason, alarms, samples)
    known = ConfidenceSequence(question.confidence, far, trials=samples, events=alarms)
    return Certificate("refuted", reason, alarms, samples) if known.decision(far) is Decision.ABOVE else None
