"""Comparison of two rigs: the same scenario on both, the difference of their signals, and that of their verdicts.

Signals are compared in codes of the first rig, play by play. Noise is no difference: its variance is estimated from the
differences between neighbouring samples, and subtracted. Verdicts are compared as those of two builds of a device are
(``analogrig.campaigns.compare``), paired by seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig import Bench, Run, Scenario, judge
from analogrig.bench import raise_if_interrupted
from analogrig.campaigns import Comparison, Trial, compare
from analogrig.judging import bound_rate, mean_interval, upper_rate
from analogrig.run import INPUT
from analogrig_instruments.calibration.averages import noise_variance

_SMOOTHED_N = 5
"""Samples over which a difference is averaged before its largest value is found."""

_EDGE_PART = 0.25
"""Smallest step of the input between neighbouring samples that is an edge, in parts of its range."""


@dataclass(frozen=True)
class SignalDifference:
    """Difference of one channel between two rigs, in LSB of the first, without noise."""

    channel: str
    rms_lsb: float
    rms_most_lsb: float
    """Upper confidence bound of the mean over such plays."""
    mean_lsb: float
    """Offset between the rigs."""
    mean_least_lsb: float
    mean_most_lsb: float
    """Confidence bounds of the mean over such plays."""
    largest_lsb: float
    """Largest mean over 5 samples in any play."""
    largest_at: int
    """Sample of the largest mean."""
    largest_noise_lsb: float
    """Expected largest of so many means from noise alone."""
    noise_lsb: float
    """rms noise of both rigs together, quantisation included, which is subtracted."""
    edges_apart: int
    """Samples of all plays, next to an edge of the input, at which only one rig has the new level; left out."""


@dataclass(frozen=True)
class LatencyDifference:
    """Latencies on the second rig less those on the first, in samples; seeds are the statistical unit."""

    mean_n: float
    least_n: float
    most_n: float
    """Confidence bounds of the mean."""
    seeds: int
    changes: int
    """Changes detected on both rigs, in all plays."""
    unequal: int
    """Number of these whose latencies differ."""
    within_n: float
    """Bound of the mean's magnitude: the larger of both bounds, and at least the upper bound of the rate of unequal
    latencies. The latter keeps a few equal latencies from giving a bound of 0."""
    quantiles_n: tuple[tuple[float, ...], tuple[float, ...]]
    """Median, 95 % quantile and maximum of all latencies, on the first and on the second rig."""


@dataclass(frozen=True)
class FalseAlarms:
    """False alarms of one rig, with a two-sided confidence interval of their rate per sample."""

    alarms: int
    armed: int
    """Samples in which the trigger was armed."""
    least: float
    most: float
    basis: str
    """Assumption and data behind the interval."""

    @classmethod
    def of(cls, trials: Sequence[Trial], confidence: float) -> Self:
        """Sum over plays."""
        alarms, armed = ([getattr(each, name) for each in trials] for name in ("false_alarms", "armed"))
        bounds = bound_rate(alarms, armed, 0.5 * (1.0 + confidence))
        return cls(sum(alarms), sum(armed), bounds.low, bounds.high, bounds.basis)


@dataclass(frozen=True)
class RigComparison:
    """Difference between two rigs in signals and verdicts."""

    a: str
    b: str
    scenario: str
    confidence: float
    plays: int
    """Plays on each rig that are valid on both."""
    invalid: tuple[str, ...]
    """Reason of each invalid play."""
    signals: tuple[SignalDifference, ...]
    latency: LatencyDifference | None
    """None if fewer than two seeds have a change detected on both rigs."""
    false_alarms: tuple[FalseAlarms, FalseAlarms]
    verdicts: Comparison

    @property
    def sentence(self) -> str:
        """Summary in one sentence."""
        output = self.signals[-1]
        latency = "an unknown number of" if self.latency is None else f"{self.latency.within_n:.2g}"
        shown = [f"{each.quantity} is {each.word}" for each in self.verdicts.differences if each.shown]
        return (
            f"{self.b} follows {self.a} within {output.rms_most_lsb:.2g} LSB ({output.channel}, rms, without noise)"
            f" and {latency} samples (mean latency), each with {self.confidence:.0%} confidence, in"
            f" {self.plays} plays of {self.scenario}; in the verdicts {', '.join(shown) or 'no difference is shown'}."
        )


def compare_rigs(
    a: Bench,
    b: Bench,
    scenario: Scenario,
    seeds: Sequence[int],
    confidence: float = 0.95,
    progress: Callable[[int, int], None] | None = None,
) -> RigComparison | tuple[str, ...]:
    """Play a scenario with every seed on both rigs in turn, and compare ``b`` with ``a``.

    Return the reasons why plays are invalid if fewer than two are valid on both.

    :raises ConfigurationError: one of the rigs cannot play it.
    :raises DeviceError, LinkError, RigError: before a first sample.
    """
    runs: list[tuple[Run, Run]] = []
    trials: list[tuple[Trial, Trial]] = []
    invalid = []
    for done, seed in enumerate(seeds, start=1):
        pair = raise_if_interrupted(a.play(scenario, seed)), raise_if_interrupted(b.play(scenario, seed))
        judged = Trial.of(pair[0], judge(pair[0])), Trial.of(pair[1], judge(pair[1]))
        why = [_why_invalid(*each) for each in zip(pair, judged, strict=True) if not each[1].is_valid]
        if why:
            invalid.append(why[0])
        else:
            runs.append(pair)
            trials.append(judged)
        if progress is not None:
            progress(done, len(seeds))
    if len(runs) < 2:
        return tuple(invalid) or ("two plays at least are needed",)
    trials_a, trials_b = zip(*trials, strict=True)
    keyed_a, keyed_b = ([((scenario.name, each.seed), each) for each in side] for side in (trials_a, trials_b))
    return RigComparison(
        a=runs[0][0].conditions.source.name,
        b=runs[0][1].conditions.source.name,
        scenario=scenario.name,
        confidence=confidence,
        plays=len(runs),
        invalid=tuple(invalid),
        signals=tuple(signal_difference(runs, name, confidence) for name in scenario.program.measured),
        latency=_latency(trials_a, trials_b, confidence),
        false_alarms=(FalseAlarms.of(trials_a, confidence), FalseAlarms.of(trials_b, confidence)),
        verdicts=compare(keyed_a, keyed_b, round(1.0 - confidence, 12), scenario.program.estimates),
    )


def _why_invalid(run: Run, trial: Trial) -> str:
    return f"{run.conditions.source.name}, seed {trial.seed}: {trial.why or 'inconclusive'}"


# --------------------------------------------------------------------------------------------------------- the signals


def signal_difference(runs: Sequence[tuple[Run, Run]], channel: str, confidence: float) -> SignalDifference:
    """Difference of one channel in two plays or more, without clipped samples and those at edges of the input."""
    differences, compared, apart = zip(*(_difference(a, b, channel) for a, b in runs), strict=True)
    pairs = list(zip(differences, compared, strict=True))
    noise = math.sqrt(float(np.mean([noise_variance(each) for each in differences])))
    squares = np.array([np.mean(np.square(each[use])) for each, use in pairs])
    mean_square, _, most_square = mean_interval(squares - noise**2, 2.0 * confidence - 1.0)
    largest, at = max((_largest(each, use) for each, use in pairs), key=lambda found: abs(found[0]))
    mean, mean_least, mean_most = mean_interval([each[use].mean() for each, use in pairs], confidence)
    count = int(sum(use.sum() for use in compared))
    return SignalDifference(
        channel=channel,
        rms_lsb=math.sqrt(max(mean_square, 0.0)),
        rms_most_lsb=math.sqrt(max(most_square, noise**2 * math.sqrt(2.0 / count))),
        mean_lsb=mean,
        mean_least_lsb=mean_least,
        mean_most_lsb=mean_most,
        largest_lsb=largest,
        largest_at=at,
        largest_noise_lsb=noise * math.sqrt(2.0 * math.log(count / _SMOOTHED_N + 2.0) / _SMOOTHED_N),
        noise_lsb=noise,
        edges_apart=int(sum(apart)),
    )


def _difference(a: Run, b: Run, channel: str) -> tuple[NDArray[np.float64], NDArray[np.bool_], int]:
    """Difference (n,) in LSB of a; mask (n,) of the samples compared; number of samples at edges that lie apart."""
    names = a.conditions.program.channels
    column, samples = names.index(channel), min(a.samples, b.samples)
    of_a, of_b = a.conditions.channels[channel], b.conditions.channels[channel]
    volts = of_b.volts(b.codes[:samples, column]) - of_a.volts(a.codes[:samples, column])
    counted = ~(a.clipped[:samples, column] | b.clipped[:samples, column])
    apart = 0
    if channel == names[INPUT]:
        edges = _at_edges(a, samples) | _at_edges(b, samples)
        apart = int((np.abs(volts[edges]) > _EDGE_PART * np.ptp(_input_v(a))).sum())
        counted &= ~edges
    return volts / of_a.lsb_v, counted, apart


def _input_v(run: Run) -> NDArray[np.float64]:
    return run.conditions.input.volts(run.codes[:, INPUT])


def _at_edges(run: Run, samples: int) -> NDArray[np.bool_]:
    """(samples,): True next to an edge, where a small part of a sample period decides the level."""
    volts = _input_v(run)
    jump = np.flatnonzero(np.abs(np.diff(volts[:samples])) > _EDGE_PART * np.ptp(volts))
    near = np.zeros(samples, np.bool_)
    for away in (-1, 0, 1, 2):
        near[np.clip(jump + away, 0, samples - 1)] = True
    return near


def _largest(difference: NDArray[np.float64], counted: NDArray[np.bool_]) -> tuple[float, int]:
    """Largest mean over consecutive samples that are all compared, and the middle one of them."""
    window = np.ones(_SMOOTHED_N)
    whole = np.convolve(counted, window, mode="valid") == _SMOOTHED_N
    means = np.where(whole, np.convolve(difference, window / _SMOOTHED_N, mode="valid"), 0.0)
    at = int(np.argmax(np.abs(means)))
    return float(means[at]), at + _SMOOTHED_N // 2


# -------------------------------------------------------------------------------------------------------- the verdicts


def _latency(a: Sequence[Trial], b: Sequence[Trial], confidence: float) -> LatencyDifference | None:
    """Difference of the latencies of changes detected on both rigs."""
    both = [
        [(before.latency_n, after.latency_n) for before, after in zip(mine.changes, other.changes, strict=True)
         if before.latency_n is not None and after.latency_n is not None]
        for mine, other in zip(a, b, strict=True)
    ]  # fmt: skip
    by_seed = [float(np.mean([after - before for before, after in pairs])) for pairs in both if pairs]
    if len(by_seed) < 2:
        return None
    latencies = np.array([pair for pairs in both for pair in pairs], dtype=np.float64)
    quantiles = np.quantile(latencies, (0.5, 0.95, 1.0), axis=0).T
    unequal = int((latencies[:, 0] != latencies[:, 1]).sum())
    mean, least, most = mean_interval(by_seed, confidence)
    return LatencyDifference(
        mean_n=mean,
        least_n=least,
        most_n=most,
        seeds=len(by_seed),
        changes=len(latencies),
        unequal=unequal,
        within_n=max(abs(least), abs(most), upper_rate(unequal, len(latencies), confidence)),
        quantiles_n=(tuple(map(float, quantiles[0])), tuple(map(float, quantiles[1]))),
    )
