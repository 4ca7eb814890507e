"""Certificate of a device's false-alarm rate against a limit, with a stated error probability.

A plant that does not change is played in runs of one length, with consecutive seeds. The unit of exposure is a sample
in which the trigger was armed (analogrig.judging.exposure). Every alarm is a false one. Rates that would take too long
to observe are estimated by branches with louder noise (analogrig.campaigns.rare). Each of these estimates comes from a
play of its own.

Alarms may come in bursts. Bounds of counted alarms cover bursts of ``Question.burst`` alarms on average, or of more
where the counts of the plays show them (analogrig.judging.bursts). For a rare rate, bursts are measured.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from analogrig.bench import can_be_direct
from analogrig.campaigns.plan import Case, device_of, open_table
from analogrig.campaigns.plays import Count, close_devices, count_alarms
from analogrig.campaigns.rare import FOLLOWED_N, LEAD_IN_N, Estimate, false_alarm_rate
from analogrig.campaigns.workers import Workers
from analogrig.datasheet import Datasheet
from analogrig.devices.catalogue_description import has_snapshots
from analogrig.errors import ConfigurationError
from analogrig.judging.bursts import BURST, ConfidenceSequence, Design, bound_rate, upper_count
from analogrig.judging.statistics import Decision, mean_bounds, one_sided
from analogrig.scenario import Scenario
from analogrig.wording import number_of

IN_PROCESS_RUN_N, BENCH_RUN_N = (100_000, 1_000_000), (20_000, 100_000)
"""Approximate samples in a run, in this process or over a line: usual length, and greatest.

A run lasts at least 1 / far samples up to the greatest length. A shorter one would never show an alarm that comes this
long after every start.
"""

WORTH_A_WORKER_N = 500_000
"""Samples that a process plays in about the time that another takes to start."""

WORTH_A_WORKER_ESTIMATES = 16
"""Estimates of a rare rate that a process plays in about the time that another takes to start."""

MOST_FAR = 0.1
"""Rate per sample from which on no certificate is given."""

MOST_ALARMS = 1000
"""Largest number of alarms allowed, and largest mean number of alarms of a burst."""

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
    allowed: int = 50
    """Most alarms with which a test of fixed length certifies."""
    burst: float = BURST
    """Mean number of alarms of a burst that the bounds cover; 1: alarms are taken as independent."""
    sequential: bool = False
    rare: int | None = None
    """Number of estimates of a rare rate; None: count alarms as they occur."""

    def __post_init__(self) -> None:
        problem = self._problem() or (self._length_problem() if self.rare is None else self._rare_problem(self.rare))
        if problem:
            raise ConfigurationError(f"certify: {problem}")

    def _problem(self) -> str:
        """Reason that the question cannot be answered; empty if it can."""
        if not 0.0 < self.far < MOST_FAR:
            return f"far must be more than 0 and less than {MOST_FAR:g} per sample, not {self.far:g}"
        if not 0.5 < self.confidence < 1.0:
            return f"confidence must be more than 0.5 and less than 1, not {self.confidence:g}"
        for name, least in (("allowed", 0), ("burst", 1)):
            if not least <= getattr(self, name) <= MOST_ALARMS:
                return f"{name} must be {least} to {MOST_ALARMS}, not {getattr(self, name):g}"
        if not self.datasheet.alarms:
            return "the device has no trigger: it raises no alarm, whatever comes"
        if self.scenario.tweaks:
            return "the scenario changes the plant, and this is about alarms while nothing changes"
        return ""

    def _length_problem(self) -> str:
        """Reason that the test would take more than a year of playing; empty if it is short enough."""
        needed = upper_count(self.allowed, self.confidence, self.burst) / self.far
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
        return Design(self.far, self.confidence, self.allowed, self.burst).trials


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
    """Two one-sided bounds, each at the confidence of the question; as one interval they would be wrong twice as often.

    A sequential test yields none.
    """
    basis: str = ""
    """Assumption and data behind the bounds; empty if nothing was bounded."""


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
    scenario = dataclasses.replace(question.scenario, samples=_run_n(question, most))
    work = functools.partial(count_run, Case(question.rig, question.device, scenario, question.first_seed))
    counts: list[Count] = []
    alarms = samples = 0
    try:
        for count in _in_order(workers, work, question.first_seed):
            counts.append(count)
            alarms, samples = alarms + count.alarms, samples + count.armed
            if progress is not None:
                progress(samples, most, alarms)
            if count.fault:
                return Certificate("inconclusive", count.fault, alarms, samples)
            answer = _sequential(question, counts) if question.sequential else None
            if samples >= most:
                answer = answer or _at_the_end(question, counts)
            if answer is not None:
                return answer
    finally:
        close_devices()
    raise AssertionError("seeds do not end")


def count_run(case: Case, seed: int) -> Count:
    """Alarms and exposure of the run of a case with another seed. Runs of one scenario share its table."""
    return count_alarms(dataclasses.replace(case, seed=seed))


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
        f"the rate is {math.fsum(rates) / count:.3g}, {one_sided(low, high, question.confidence)},"
        f" from {number_of(count, 'estimate')}, {number_of(samples, 'sample')}"
    )
    burst = math.fsum(rates) / math.fsum(each.bursts for each in estimates)
    basis = f"a mean burst size of {burst:.3g}, measured over {FOLLOWED_N} samples after the first alarm"
    return Certificate(_answer(question.far, low, high), reason, alarms, samples, (low, high), basis)


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
    usual, greatest = IN_PROCESS_RUN_N if question.is_in_process else BENCH_RUN_N
    runs = max(1, most // max(usual, min(math.ceil(1.0 / question.far), greatest)))
    return math.ceil(most / runs) + question.datasheet.warm_up_n + LEAD_IN_N


def _at_the_end(question: Question, counts: Sequence[Count]) -> Certificate:
    """Outcome of the test of fixed length, or of a sequential one that has not decided."""
    alarms, armed = _columns(counts)
    bounds = bound_rate(alarms, armed, question.confidence, question.burst)
    counted = f"{number_of(sum(alarms), 'alarm')} in {number_of(sum(armed), 'sample')}"
    if question.sequential:
        return Certificate(
            "inconclusive", f"{counted}, and still undecided", sum(alarms), sum(armed), basis=bounds.basis
        )
    reason = f"{counted}: the rate is {one_sided(bounds.low, bounds.high, question.confidence)}"
    answer = _answer(question.far, bounds.low, bounds.high)
    return Certificate(answer, reason, sum(alarms), sum(armed), (bounds.low, bounds.high), bounds.basis)


def _sequential(question: Question, counts: Sequence[Count]) -> Certificate | None:
    """Outcome of the sequential test; None while undecided.

    A confidence sequence decides, with the error probability 1 - confidence on either side.
    """
    alarms, armed = _columns(counts)
    both_sides = 2.0 * question.confidence - 1.0
    known = ConfidenceSequence(both_sides, question.burst, trials=sum(armed), events=sum(alarms))
    if known.decision(question.far) is Decision.OPEN:
        return None
    bounds = bound_rate(alarms, armed, question.confidence, question.burst)
    decided = dataclasses.replace(known, burst=bounds.burst).decision(question.far)
    if decided is Decision.OPEN:
        return None
    counted = f"{number_of(sum(alarms), 'alarm')} in {number_of(sum(armed), 'sample')}"
    answer: Answer = "certified" if decided is Decision.BELOW else "refuted"
    return Certificate(answer, f"{counted}, and no more were needed", sum(alarms), sum(armed), basis=bounds.basis)


def _columns(counts: Sequence[Count]) -> tuple[list[int], list[int]]:
    """Alarms and armed samples of each run."""
    return [count.alarms for count in counts], [count.armed for count in counts]
