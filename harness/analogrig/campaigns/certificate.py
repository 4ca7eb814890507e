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
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from analogrig import config
from analogrig.campaigns.plan import Case, device_of, open_table
from analogrig.campaigns.rare import LEAD_IN_N, Estimate, false_alarm_rate
from analogrig.campaigns.trial import Count, close_devices, count_alarms
from analogrig.campaigns.trials import are_possible
from analogrig.campaigns.workers import Workers
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
from analogrig.rigs.emulator import is_emulated
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
    """Test of the hypothesis that the false-alarm rate is below ``far`` per sample."""

    far: float
    confidence: float
    rig: Any
    """Rig as plain values, as ``campaign.plan.open_table`` takes it."""
    device: Any
    scenario: Any
    first_seed: int = 0
    allowed: int = 5
    """Most alarms with which a test of fixed length certifies."""
    sequential: bool = False
    rare: int | None = None
    """Number of estimates of a rare rate; None: count alarms as they occur."""

    def __post_init__(self) -> None:
        if not 0.0 < self.far * APART < 1.0:
            raise ValueError(f"far must be more than 0 and less than {1.0 / APART:g} per sample, not {self.far:g}")
        if not 0.5 < self.confidence < 1.0:
            raise ValueError(f"confidence must be more than 0.5 and less than 1, not {self.confidence:g}")
        if not 0 <= self.allowed <= 1000:
            raise ValueError(f"allowed must be 0 to 1000, not {self.allowed}")
        if self.device["estimator"]["trigger"] == "none":
            raise ValueError("the device has no trigger: it raises no alarm, whatever comes")
        if self.scenario.get("tweaks"):
            raise ValueError("the scenario changes the plant, and this is about alarms while nothing changes")
        if self.rare is None:
            self._check_length()
        else:
            self._check_rare(self.rare)

    def _check_length(self) -> None:
        """:raises ValueError: nobody would live to see the end."""
        needed = poisson_mean(self.allowed, self.confidence) / self.far
        if needed <= BENCH_YEAR_N:
            return
        year_n = IN_PROCESS_YEAR_N if self.is_in_process else BENCH_YEAR_N
        if needed > year_n:
            raise ValueError(
                f"far = {self.far:g} takes {needed:.2g} samples, and in a year this device is played some {year_n:.0e}:"
                " a rare rate is estimated instead (--rare)"
            )

    def _check_rare(self, estimates: int) -> None:
        """:raises ValueError: it cannot be estimated."""
        if not LEAST_ESTIMATES <= estimates <= MOST_ESTIMATES:
            raise ValueError(f"rare must be {LEAST_ESTIMATES} to {MOST_ESTIMATES} estimates, not {estimates}")
        if self.sequential:
            raise ValueError("a rare rate is estimated, or alarms are waited for by a sequential test")
        drifts = self.scenario["excitation"].get("clock") == "free"
        if drifts and self.device["estimator"]["edge_instants"] != "anywhere":
            raise ValueError(
                "of a generator on a clock of its own some instants of its edges are rare, and they are not drawn: wait"
                ' for alarms, or set the device to edge_instants = "anywhere"'
            )

    def as_json(self) -> str:
        """Question as JSON text; equal questions give equal text."""
        table = {key: value for key, value in dataclasses.asdict(self).items() if value is not None}
        return json.dumps(table, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Question:
        return config.build(cls, json.loads(text), "the question")

    @property
    def useful_workers(self) -> int:
        """Largest useful number of workers; more would take longer to start than to play."""
        if self.rare is not None:
            return max(1, self.rare // WORTH_A_WORKER_ESTIMATES)
        return max(1, self.design_n // WORTH_A_WORKER_N) if self.is_in_process else self.design_n

    @functools.cached_property
    def is_in_process(self) -> bool:
        """True if the trials are played within this process, without a line."""
        with open_table(self.rig) as rig:
            return are_possible(rig, device_of(self.device))

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
    rate: tuple[float, float]
    """One-sided bounds: exact for a fixed length, of a mean for a rare rate. (0, 1) for a sequential test, which
    yields only its outcome."""


def certify(
    question: Question, workers: Workers, progress: Callable[[int, int, int], None] | None = None
) -> Certificate:
    """Play until the question is answered. The answer does not depend on the number of workers.

    ``progress`` is called with the samples counted, the samples that may be needed, and the alarms counted.

    :raises ConfigurationError: the scenario cannot be played, or the device refuses its configuration.
    :raises WorkerError, LinkError, DeviceError, RigError: they cannot be had or kept.
    """
    if question.rare is not None:
        return _of_rare_alarms(question, question.rare, workers)
    most = math.ceil(question.design_n * (MOST_LONGER if question.sequential else 1.0))
    run_n = _run_n(question, most)
    work = functools.partial(count_run, question.as_json(), run_n)
    alarms = samples = 0
    try:
        for count in _in_order(workers, work, question.first_seed):
            alarms, samples = alarms + count.alarms, samples + count.armed
            if progress is not None:
                progress(samples, most, alarms)
            if count.fault:
                return Certificate("inconclusive", count.fault, alarms, samples, (0.0, 1.0))
            answer = _sequential(question, alarms, samples) if question.sequential else None
            if samples >= most:
                answer = answer or _at_the_end(question, alarms, samples)
            if answer is not None:
                return answer
    finally:
        close_devices()
    raise AssertionError("seeds do not end")


def count_run(question: str, run_n: int, seed: int) -> Count:
    """Alarms and exposure of one run."""
    asked = Question.from_json(question)
    scenario = dataclasses.replace(Scenario.from_table(asked.scenario, "the scenario"), samples=run_n)
    return count_alarms(Case(asked.rig, asked.device, scenario, seed))


def _of_rare_alarms(question: Question, count: int, workers: Workers) -> Certificate:
    if not question.is_in_process:
        name = question.device["name"]
        raise ConfigurationError(f"certify: a rare rate is estimated within this process (inproc), not in {name}")
    seeds = range(question.first_seed, question.first_seed + count)
    found = dict(workers.play(functools.partial(estimate_once, question.as_json()), iter(seeds)))
    estimates = [Estimate(*found[seed]) for seed in seeds]
    alarms, samples = sum(each.alarms for each in estimates), sum(each.samples for each in estimates)
    fruitless = sum(not each.alarms for each in estimates)
    if fruitless:
        said = f"in {fruitless} of {number_of(len(estimates), 'estimate')} no branch came to an alarm"
        return Certificate("inconclusive", said, alarms, samples, (0.0, 1.0))
    rates = [each.rate for each in estimates]
    low, high = mean_bounds(rates, question.confidence)
    said = f"the rate is {math.fsum(rates) / len(rates):.3g}, {low:.3g} to {high:.3g}"
    said += f", from {number_of(len(rates), 'estimate')}, {number_of(samples, 'sample')}"
    return Certificate(_answer(question.far, low, high), said, alarms, samples, (low, high))


def estimate_once(question: str, seed: int) -> tuple[float, int, int]:
    """One estimate of a rare rate, as plain numbers."""
    asked = Question.from_json(question)
    with open_table(asked.rig) as rig:
        if not is_emulated(rig):
            raise ConfigurationError("certify: a rare rate is estimated on an emulated rig")
        scenario = Scenario.from_table(asked.scenario, "the scenario")
        rate, alarms, samples = false_alarm_rate(rig, device_of(asked.device), scenario, seed)
        return rate, alarms, samples


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
    return math.ceil(most / runs) + device_of(question.device).estimator.warm_up_n + LEAD_IN_N


def _at_the_end(question: Question, alarms: int, samples: int) -> Certificate:
    if question.sequential:
        said = f"{number_of(alarms, 'alarm')} in {number_of(samples, 'sample')}, and still undecided"
        return Certificate("inconclusive", said, alarms, samples, (0.0, 1.0))
    low = lower_rate(alarms, samples, question.confidence)
    high = upper_rate(alarms, samples, question.confidence)
    said = f"{number_of(alarms, 'alarm')} in {number_of(samples, 'sample')}: the rate is {low:.3g} to {high:.3g}"
    return Certificate(_answer(question.far, low, high), said, alarms, samples, (low, high))


def _sequential(question: Question, alarms: int, samples: int) -> Certificate | None:
    """Outcome of the sequential tests; None while undecided.

    Wald's test certifies. A confidence sequence refutes; it eventually does so for any rate above the limit.
    """
    error, far = 1.0 - question.confidence, question.far
    said = f"{number_of(alarms, 'alarm')} in {number_of(samples, 'sample')}, and no more were needed"
    better = SequentialTest(far / APART, far, error, error, trials=samples, events=alarms)
    if better.decision is Decision.BELOW:
        return Certificate("certified", said, alarms, samples, (0.0, 1.0))
    known = ConfidenceSequence(question.confidence, far, trials=samples, events=alarms)
    is_worse = known.decision(far) is Decision.ABOVE
    return Certificate("refuted", said, alarms, samples, (0.0, 1.0)) if is_worse else None


def question_of(rig: Any, device: Any, scenario: Scenario, **settings: Any) -> Question:
    """:raises ConfigurationError: a setting is out of range."""
    try:
        return Question(rig=rig, device=device, scenario=scenario.as_table(), **settings)
    except ValueError as error:
        raise ConfigurationError(f"certify: {error}") from error
