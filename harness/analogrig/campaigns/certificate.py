"""Certificate of a device's false-alarm rate against a limit, with a stated error probability.

A plant that does not change is played in runs of one length, with consecutive seeds. The unit of exposure is a sample
in which the trigger was armed (analogrig.judging.exposure). Every alarm is a false one.

Alarms may come in bursts. The default bounds hold whatever the dependence within a play (analogrig.judging.betting),
and stop as soon as the plays decide. With ``Question.burst``, a test of fixed length assumes bursts of so many alarms
on average, or of more where the counts of the plays show them (analogrig.judging.bursts).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from analogrig.campaigns.plan import Case, device_of, open_table
from analogrig.campaigns.plays import BATCH_SAMPLES, Count, close_devices, count_alarms
from analogrig.campaigns.together import can_be_direct
from analogrig.campaigns.workers import Workers
from analogrig.datasheet import Datasheet
from analogrig.errors import ConfigurationError
from analogrig.judging.betting import BettingSequence, quiet_plays
from analogrig.judging.bursts import Design, bound_rate
from analogrig.judging.statistics import Decision, one_sided
from analogrig.plant import MAX_SAMPLES
from analogrig.scenario import Scenario
from analogrig.wording import number_of

IN_PROCESS_RUN_N, BENCH_RUN_N = (100_000, 1_000_000), (20_000, 100_000)
"""Approximate samples in a run for named bounds, in this process or over a line: usual length, and greatest.

A run lasts at least 1 / far samples up to the greatest length. A shorter one would never show an alarm that comes this
long after every start.
"""

LEAD_IN_N = 16
"""Samples that fill the regressors before the first equation, for any model that a device can have."""

LEAST_PLAY_N = 1000
"""Fewest samples of a play for betting, unless set. The number of plays hardly depends on their length."""

ALLOWED = 50
"""Most alarms with which a test of fixed length certifies, unless set."""

WORTH_A_WORKER_N = 500_000
"""Samples that a process plays in about the time that another takes to start."""

MOST_FAR = 0.1
"""Rate per sample from which on no certificate is given."""

MOST_ALARMS = 1000
"""Largest number of alarms allowed, and largest mean number of alarms of a burst."""

MOST_LONGER = 3.0
"""Largest length of a test by betting, as a multiple of its length without alarms."""

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
    allowed: int | None = None
    """Most alarms with which a test of fixed length certifies; None: ALLOWED. Only with ``burst``."""
    burst: float | None = None
    """Mean number of alarms of a burst that is assumed; 1: independent alarms. None: bounds by betting."""
    samples: int | None = None
    """Samples of each play; None: chosen."""

    def __post_init__(self) -> None:
        if problem := self._problem() or self._length_problem():
            raise ConfigurationError(f"certify: {problem}")

    def _problem(self) -> str:
        """Reason that the question cannot be answered; empty if it can."""
        if not 0.0 < self.far < MOST_FAR:
            return f"far must be more than 0 and less than {MOST_FAR:g} per sample, not {self.far:g}"
        if not 0.5 < self.confidence < 1.0:
            return f"confidence must be more than 0.5 and less than 1, not {self.confidence:g}"
        for name, least, most in (("allowed", 0, MOST_ALARMS), ("burst", 1, MOST_ALARMS), ("samples", 1, MAX_SAMPLES)):
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                return f"{name} must be {least} to {most}, not {value:g}"
        if not self.datasheet.alarms:
            return "the device has no trigger: it raises no alarm, whatever comes"
        if self.scenario.changes:
            return "the scenario changes the plant, and this is about alarms while nothing changes"
        return ""

    def _length_problem(self) -> str:
        """Reason that the test cannot be played, or not within a year; empty if it can."""
        if self.allowed is not None and self.is_betting:
            return "alarms are allowed by a test of fixed length: add --bounds bursts, or leave out --allowed"
        if self.is_betting and self.play_n <= self.datasheet.warm_up_n:
            return f"samples must be more than the warm-up of {self.datasheet.warm_up_n}, not {self.play_n}"
        needed = self.design_n / self._armed_n * self.play_n if self.is_betting else self.design_n
        year_n = IN_PROCESS_YEAR_N if self.is_in_process else BENCH_YEAR_N
        if needed <= year_n:
            return ""
        return f"far = {self.far:g} takes {needed:.2g} samples, and in a year this device is played some {year_n:.0e}"

    @property
    def useful_workers(self) -> int:
        """Largest useful number of workers; more would take longer to start than to play."""
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

    @property
    def is_betting(self) -> bool:
        """True if nothing is assumed about alarms within a play."""
        return self.burst is None

    @functools.cached_property
    def design_n(self) -> int:
        """Armed samples of the test of fixed length; by betting, without an alarm."""
        if self.is_betting:
            return self._armed_n * quiet_plays(self.far, self.confidence, self.bets.most, self._armed_n)
        return Design(self.far, self.confidence, self.allowed_alarms, self.burst or 1.0).trials

    @property
    def allowed_alarms(self) -> int:
        """Most alarms with which a test of fixed length certifies."""
        return ALLOWED if self.allowed is None else self.allowed

    @property
    def most_n(self) -> int:
        """Armed samples after which the question stays open."""
        return math.ceil(self.design_n * (MOST_LONGER if self.is_betting else 1.0))

    @functools.cached_property
    def play_n(self) -> int:
        """Samples of a play. For named bounds, a whole number of plays makes up a test of fixed length."""
        lead_n = self.datasheet.warm_up_n + LEAD_IN_N
        if self.samples is not None:
            return self.samples
        if self.is_betting:
            return max(LEAST_PLAY_N, 2 * lead_n)
        usual, greatest = IN_PROCESS_RUN_N if self.is_in_process else BENCH_RUN_N
        runs = max(1, self.most_n // max(usual, min(math.ceil(1.0 / self.far), greatest)))
        return math.ceil(self.most_n / runs) + lead_n

    @property
    def batch(self) -> int:
        """Plays between two looks of a test by betting."""
        return max(1, BATCH_SAMPLES // self.play_n) if self.is_betting and self.is_in_process else 1

    @property
    def _armed_n(self) -> int:
        return max(1, self.play_n - self.datasheet.warm_up_n)

    @property
    def bets(self) -> BettingSequence:
        """Test by betting before the first play."""
        return BettingSequence(self.confidence, self.datasheet.most_alarms(self.play_n), self.play_n)


@dataclass(frozen=True)
class Certificate:
    """Answer to a ``Question``."""

    outcome: Answer
    reason: str
    alarms: int
    samples: int
    """Number of samples in which the trigger was armed."""
    rate: tuple[float, float] = (0.0, 1.0)
    """Two one-sided bounds, each at the confidence of the question. As one interval they are wrong twice as often."""
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
    case = Case(
        question.rig,
        question.device,
        dataclasses.replace(question.scenario, samples=question.play_n),
        question.first_seed,
    )
    evidence = _Evidence(question)
    try:
        for batch in _in_order(workers, functools.partial(count_runs, case, question.batch), question):
            for count in batch:
                evidence.add(count)
            if progress is not None:
                progress(evidence.samples, question.most_n, evidence.alarms)
            if fault := evidence.fault:
                return Certificate("inconclusive", fault, evidence.alarms, evidence.samples)
            if (answer := evidence.answer()) is not None:
                return answer
    finally:
        close_devices()
    raise AssertionError("seeds do not end")


def count_runs(case: Case, number: int, seed: int) -> list[Count]:
    """Alarms and exposure of ``number`` runs of a case with seeds from ``seed`` on. They share its table."""
    return count_alarms(case, range(seed, seed + number))


def _in_order(workers: Workers, work: Any, question: Question) -> Iterator[list[Count]]:
    """Yield batches of counts in order of their seeds, whatever the order of arrival."""
    early: dict[int, list[Count]] = {}
    expected = question.first_seed
    for seed, counts in workers.play(work, itertools.count(question.first_seed, question.batch)):
        early[seed] = counts
        while expected in early:
            yield early.pop(expected)
            expected += question.batch


class _Evidence:
    """Counts of the plays so far, and the answer that they give."""

    def __init__(self, question: Question) -> None:
        self.question = question
        self.alarms = self.samples = 0
        self._fault = ""
        self._bets = question.bets if question.is_betting else None
        self._counts: list[Count] = []
        """Counts of a test of fixed length."""

    def add(self, count: Count) -> None:
        self.alarms += count.alarms
        self.samples += count.armed
        self._fault = self._fault or count.fault
        if self._bets is None:
            self._counts.append(count)
        else:
            self._bets.add(count.alarms, count.armed)

    @property
    def fault(self) -> str:
        """Reason that the counts are no evidence; empty if they are."""
        broken = "" if self._bets is None else self._bets.broken
        hold_off_n = self.question.datasheet.hold_off_n
        return self._fault or (f"{broken}, says the data sheet with hold_off_n = {hold_off_n}" if broken else "")

    def answer(self) -> Certificate | None:
        """Answer of the test; None while it is open. Either side of the bets decides as soon as its wealth suffices."""
        question, is_last = self.question, self.samples >= self.question.most_n
        outcome: Answer
        if self._bets is not None:
            decision = self._bets.decision(question.far)
            if decision is Decision.OPEN and not is_last:
                return None
            outcome, rate, basis = _ANSWERS[decision], self._bets.bounds, self._bets.basis
            of = f" of {number_of(self._bets.plays.total(), 'play')}"
        elif is_last:
            alarms, armed = ([getattr(count, name) for count in self._counts] for name in ("alarms", "armed"))
            bounds = bound_rate(alarms, armed, question.confidence, question.burst or 1.0)
            low, high = rate = bounds.low, bounds.high
            outcome = "certified" if high <= question.far else "refuted" if low > question.far else "inconclusive"
            basis, of = bounds.basis, ""
        else:
            return None
        counted = f"{number_of(self.alarms, 'alarm')} in {number_of(self.samples, 'sample')}"
        reason = f"{counted}{of}: the rate is {one_sided(*rate, question.confidence)}, for {basis}"
        return Certificate(outcome, reason, self.alarms, self.samples, rate, basis)


_ANSWERS: Mapping[Decision, Answer] = {
    Decision.BELOW: "certified",
    Decision.ABOVE: "refuted",
    Decision.OPEN: "inconclusive",
}
