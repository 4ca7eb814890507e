"""The shipped device under the conditions that users meet: false alarms, misfits, missed changes and delays.

python -m tests.bench.bench_reality [--rows NAME,...] [--quick] [--jobs N]

The whole table takes 900 s of processor time. ``--quick`` plays a tenth of the healthy samples and a third of the
changes, for a look at it.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import multiprocessing
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.datasheet import DEFAULT_ARL0
from analogrig.judging.courses import first_at_level

from . import silverbox
from .conditions import CONDITIONS, Condition
from .false_alarms import CLUSTER_N, FalseAlarms, count_false_alarms
from .figure import Figure
from .played import PARAMETERS, Change
from .shipped import ONSET_N, ONSET_SPAN_N, Misfit, answers_to, exposure_n, reported_misfits, shipped
from .simulated import Simulated

MISFIT_N, MISFIT_RUNS = 2000, 100
"""Samples within which a misfit must be reported, and largest number of runs in which it is awaited."""

ROWS = (*CONDITIONS, silverbox.ROW)
"""Names of the rows."""

FACTORS = (1.2, 0.8)

HEALTHY_SEED, CHANGE_SEED = 1_000, 500_000
"""First seeds."""

JOBS = 2

MOST_RATE, LEAST_SHARE, MOST_MISSED = 1.0 / DEFAULT_ARL0, 0.95, 2
"""Largest rate of false alarms, least share of runs with the right misfit, largest number of missed changes."""

NOTE = f"""\
The device is `inproc` as shipped, without its line. Each row has 200 healthy runs of 10,000 samples
and 180 changes: M, B or K, 20 % upwards or downwards. The circuit emulator and its sampler play
them. Rows marked *simulated* integrate the equation of the plant instead. Seeds: from
{HEALTHY_SEED:,} for healthy runs, from {CHANGE_SEED:,} for changes.

| column | meaning |
|---|---|
| false alarms per 1e5 | alarms per armed sample; those up to {CLUSTER_N} samples apart are one cluster |
| 99 % bound | one-sided upper bound of that rate, with the dispersion of clusters and runs |
| MISFIT | of the first {MISFIT_RUNS} runs, those with a misfit within {MISFIT_N:,} samples, by its kind |
| missed | changes without an alarm within 300 samples; 900 to 3,000 where the excitation is slower |
| delay over bound | mean delay of the detected changes over their mean information bound, and one standard error |
| required | 1 if the row is as required, else 0 and the reasons |

A row is as required with a bound of at most 1 per 1e5, and at most {MOST_MISSED} missed changes. A misfit
of the right kind in {100 * LEAST_SHARE:g} % of the runs excuses the rate. It excuses missed changes
where the model does not fit. Where the model fits, no misfit may be reported, but for those that
the condition tolerates: noise on the force, a slow plant, and parts that are not ideal.

The bound takes the alarms as a Poisson count in units of its dispersion. The dispersion is the
larger one of that of the clusters and that between the runs. It is 1 if there are no alarms.

The information of a change compares the inputs of the card with and without it, for the same
machine, excitation and disturbance. It knows hum and drift, and whitens coloured noise.

Rows of the Silverbox need its record: `{silverbox.FOLDER_SETTING}` names the folder of
`{silverbox.FILE}`. A 12-bit card of +-0.2 V and +-0.35 V samples it. A change of the stiffness is the
record plus the exact difference of the linear part. The splices are 20 % upwards and downwards.
"""
"""Paragraphs below the table."""


@dataclass(frozen=True)
class Effort:
    """Numbers of runs of a row."""

    runs: int = 200
    """Healthy runs."""
    run_n: int = 10_000
    """Samples of each."""
    trials: int = 30
    """Runs of each parameter and direction."""


QUICK = Effort(runs=20, trials=10)


# ------------------------------------------------------------------------------------------------------- false alarms


@dataclass(frozen=True)
class Healthy:
    """Result of the runs without a change."""

    alarms: FalseAlarms
    misfits: Sequence[Sequence[Misfit]] | None
    """Misfits in the first MISFIT_N samples of the first runs; None: the device reports none at all."""

    def kinds(self, right: Sequence[str]) -> list[str]:
        """Kind of each run with a misfit: the right one if it is among several, else the first."""
        by_run = [[each.kind for each in run] for run in self.misfits or () if run]
        return [next((kind for kind in run if kind in right), run[0]) for run in by_run]

    def right_share(self, right: Sequence[str]) -> float:
        """Share of the runs with a misfit of one of these kinds."""
        return sum(kind in right for kind in self.kinds(right)) / len(self.misfits or self.alarms.by_run)

    def figures(self, condition: Condition) -> Iterator[Figure]:
        """False alarms, their bound, and misfits."""
        found, per_1e5 = self.alarms, 1e5 / self.alarms.exposure_n
        counts = f"{found.alarms} in {len(found.clusters)} clusters"
        yield Figure("false alarms per 1e5", found.alarms * per_1e5, "", counts)
        yield Figure("99 % bound", 1e5 * found.upper_rate(), "per 1e5")
        if self.misfits is None:
            yield Figure("MISFIT", 0.0, "% of the runs", "not reported")
            return
        right_kinds = condition.right_kinds
        kinds = self.kinds(right_kinds)
        counts = ", ".join(f"{kind} {kinds.count(kind)}" for kind in sorted(set(kinds)))
        right = f"right kind {100.0 * self.right_share(right_kinds):.3g} %" if right_kinds else ""
        remark = "; ".join(each for each in (counts, right) if each)
        yield Figure("MISFIT", 100.0 * len(kinds) / len(self.misfits), "% of the runs", remark)


def play_healthy(condition: Condition, effort: Effort) -> Healthy:
    """Play the runs without a change."""
    device = shipped()
    alarms, exposures_n = [], []
    misfits: list[Sequence[Misfit]] | None = []
    seeds = range(HEALTHY_SEED, HEALTHY_SEED + effort.runs)
    for played in condition.play(seeds, effort.run_n, [None] * effort.runs):
        answers = answers_to(device, played)
        alarms.append([alarm.index for alarm in answers.alarms])
        exposures_n.append(exposure_n(device, played, answers))
        try:
            if misfits is not None and len(misfits) < MISFIT_RUNS:
                misfits = [*misfits, reported_misfits(played.until(MISFIT_N))]
        except LookupError:
            misfits = None
    return Healthy(count_false_alarms(alarms, exposures_n), misfits)


# ------------------------------------------------------------------------------------------------------------- changes


@dataclass(frozen=True)
class Delays:
    """Delays and bounds of detected changes, (n,) samples each, and the number of others."""

    delay_n: NDArray[np.float64]
    bound_n: NDArray[np.float64]
    missed: int
    hidden: int
    """Changes without an alarm whose information does not reach the bound's level within the horizon."""

    @property
    def trials(self) -> int:
        """Number of changes but those seen although not detectable."""
        return len(self.delay_n) + self.missed + self.hidden

    def figures(self) -> Iterator[Figure]:
        """Missed changes, and the ratio of delay to bound."""
        hidden = f"{self.hidden} not detectable" if self.hidden else ""
        yield Figure("missed", self.missed, f"of {self.trials}", hidden)
        ratio, error = self.ratio()
        yield Figure("delay over bound", ratio, "", f"+- {error:.2g}")

    def ratio(self) -> tuple[float, float]:
        """Mean delay over mean bound, and its standard error by the delta method; NaN for fewer than two."""
        if len(self.delay_n) < 2:
            return math.nan, math.nan
        ratio = self.delay_n.mean() / self.bound_n.mean()
        spread = (self.delay_n - ratio * self.bound_n).std(ddof=1)
        return float(ratio), float(spread / math.sqrt(len(self.delay_n)) / self.bound_n.mean())


def delays_of(alarms: Sequence[Sequence[int]], onsets: Sequence[int], bounds_n: Sequence[int | None]) -> Delays:
    """Delays of the first alarms after each onset; the runs end at the horizon."""
    pairs, missed, hidden = [], 0, 0
    for run, onset, bound_n in zip(alarms, onsets, bounds_n, strict=True):
        delay_n = next((index - onset for index in run if index > onset), None)
        if delay_n is not None and bound_n is not None:
            pairs.append((delay_n, bound_n))
        elif delay_n is None and bound_n is not None:
            missed += 1
        elif delay_n is None:
            hidden += 1
    delay, bound = np.array(pairs, dtype=float).reshape(-1, 2).T
    return Delays(delay, bound, missed, hidden)


def play_changes(condition: Condition, effort: Effort) -> Delays:
    """Play the runs with a change."""
    device = shipped()
    what = [(name, factor) for name in PARAMETERS for factor in FACTORS] * effort.trials
    onsets = (ONSET_N + np.random.default_rng(CHANGE_SEED).integers(0, ONSET_SPAN_N, len(what))).tolist()
    changes = [Change(name, factor, onset) for (name, factor), onset in zip(what, onsets, strict=True)]
    seeds = range(CHANGE_SEED, CHANGE_SEED + len(changes))
    samples = ONSET_N + ONSET_SPAN_N + condition.horizon_n
    alarms, bounds_n = [], []
    for onset, played in zip(onsets, condition.play(seeds, samples, changes), strict=True):
        end = onset + 1 + condition.horizon_n
        alarms.append([alarm.index for alarm in answers_to(device, played).alarms if alarm.index < end])
        bounds_n.append(first_at_level(played.information[onset + 1 : end], math.log(DEFAULT_ARL0)))
    return delays_of(alarms, onsets, bounds_n)


# --------------------------------------------------------------------------------------------------------------- table


def measure(name: str, effort: Effort) -> list[Figure]:
    """Figures of one row; those of the Silverbox, of all its rows."""
    if name == silverbox.ROW:
        return list(silverbox.figures())
    condition = CONDITIONS[name]
    healthy, changes = play_healthy(condition, effort), play_changes(condition, effort)
    reasons = ", ".join(faults(condition, healthy, changes))
    found = [*healthy.figures(condition), *changes.figures(), Figure("required", not reasons, "", reasons)]
    row = condition.text + (" (simulated)" if isinstance(condition.source, Simulated) else "")
    return [dataclasses.replace(each, name=f"{name}, {row}: {each.name}") for each in found]


def faults(condition: Condition, healthy: Healthy, changes: Delays) -> Iterator[str]:
    """Reasons that a row is not as required."""
    is_told = healthy.right_share(condition.right_kinds) >= LEAST_SHARE
    if healthy.alarms.alarms and healthy.alarms.upper_rate() > MOST_RATE and not is_told:
        yield "rate"
    if changes.missed > MOST_MISSED and (condition.fits or not is_told):
        yield "missed"
    if condition.fits and set(healthy.kinds(())) - set(condition.tolerated):
        yield "MISFIT of a model that fits"


def figures(effort: Effort = Effort(), names: Sequence[str] = (), jobs: int = JOBS) -> Iterator[Figure]:
    """Figures of the named rows, or of all, in the order of the table."""
    names = names or ROWS
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        for row in [pool.submit(measure, name, effort) for name in names]:
            yield from row.result()


def arguments(words: Sequence[str]) -> tuple[Effort, Sequence[str], int]:
    """Effort, names of rows and number of processes of a command line; ends the program if it is wrong."""
    parser = argparse.ArgumentParser(prog="make bench ARGS=reality")
    parser.add_argument("--rows", default="", help="comma-separated names of rows, or their beginnings")
    parser.add_argument("--quick", action="store_true", help="few runs; nothing is written")
    parser.add_argument("--jobs", type=int, default=JOBS, help="number of processes (default %(default)s)")
    given = parser.parse_args(words)
    wanted = [each for each in given.rows.split(",") if each]
    for each in wanted:
        if not any(name.startswith(each) for name in ROWS):
            parser.error(f"no row is called {each}; there are {', '.join(ROWS)}")
    names = [name for name in ROWS if any(name.startswith(each) for each in wanted)]
    return QUICK if given.quick else Effort(), names, given.jobs


def figures_of(*words: str) -> Iterator[Figure]:
    """Figures that a command line asks for."""
    return figures(*arguments(words))


def lines(found: Iterator[Figure]) -> Iterator[str]:
    """One line of text for each row of the table."""
    row, cells = "", list[str]()
    for figure in found:
        name, _, column = figure.name.partition(": ")
        if name != row:
            if cells:
                yield f"{row:<70} {' | '.join(cells)}"
            row, cells = name, []
        value = " ".join(each for each in (f"{figure.value:.4g}", figure.unit, figure.compared_with) if each)
        cells.append(f"{column} {value}")
    if cells:
        yield f"{row:<70} {' | '.join(cells)}"


def main(words: Sequence[str]) -> None:
    """Print the rows; bench.json and the page keep those of ``make bench ARGS=reality``."""
    for line in lines(figures_of(*words)):
        print(line, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
