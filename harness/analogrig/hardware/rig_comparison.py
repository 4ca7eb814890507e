"""Two rigs against each other: the same scenario on both, how far their signals differ, and whether verdicts do.

The signals are compared in codes of the first rig, play by play. Both have noise, which is not a difference: how much
there is of it shows in what differs from one sample to the next, and its square is taken off. The verdicts are compared
as those of two builds of a device are (``analogrig.campaigns.comparison``), paired by seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.bench import Bench, uninterrupted
from analogrig.campaigns.comparison import Comparison, compare
from analogrig.campaigns.rows import Row, changes, row
from analogrig.judging.statistics import mean_interval, rate_interval, upper_rate
from analogrig.judging.verdict import judge
from analogrig.run import CHANNELS, MEASURED, Run
from analogrig.scenario import Scenario

_THIRD_DIFFERENCE = (1.0, -3.0, 3.0, -1.0)
_NORMAL_MAD = 1.482602
"""Standard deviation over median absolute deviation, of normal noise."""
_KEPT_SIGMAS, _KEPT_VARIANCE = 3.0, 0.973337
"""What is further out is no noise; the variance of a standard normal number that is not."""

_SMOOTHED_N = 5
"""Over so many samples a difference is averaged before the largest is looked for."""

_EDGE_PART = 0.25
"""A step of the force from one sample to the next that is more than this part of its range is an edge."""


@dataclass(frozen=True)
class SignalDifference:
    """How far a channel of the second rig is from that of the first, in LSB of the first, without noise."""

    channel: str
    rms_lsb: float
    rms_most_lsb: float
    """Upper bound, with the confidence of the comparison, of the mean over plays like these."""
    mean_lsb: float
    """An offset between the two."""
    largest_lsb: float
    """Of all means over 5 samples, in any play."""
    largest_at: int
    """Its sample."""
    largest_noise_lsb: float
    """What the largest of so many means would be by noise alone."""
    noise_lsb: float
    """rms of both together, quantisation included; it is taken off."""
    edges_apart: int
    """Samples about an edge of the force that only one of the two has at its new level, in all plays; left out."""


@dataclass(frozen=True)
class LatencyDifference:
    """Latencies on the second rig less those on the first, in samples; the unit is the seed."""

    mean_n: float
    least_n: float
    most_n: float
    """Bounds of the mean."""
    seeds: int
    changes: int
    """Noticed on both, in all plays."""
    unequal: int
    """So many of them with another latency."""
    within_n: float
    """Bound of the mean's size: the larger of both bounds, and of what as many latencies would allow that differ by one
    sample now and then, since a few that are all equal vary by nothing."""
    quantiles_n: tuple[tuple[float, ...], tuple[float, ...]]
    """Of all latencies on the first and on the second rig: median, 95 %, largest."""


@dataclass(frozen=True)
class FalseAlarms:
    """Of one rig, per sample."""

    alarms: int
    samples: int
    least: float
    most: float


@dataclass(frozen=True)
class RigComparison:
    a: str
    b: str
    scenario: str
    confidence: float
    plays: int
    """On each rig, valid on both."""
    invalid: tuple[str, ...]
    """Why others are not."""
    signals: tuple[SignalDifference, ...]
    latency: LatencyDifference | None
    """None if no change was noticed on both."""
    false_alarms: tuple[FalseAlarms, FalseAlarms]
    verdicts: Comparison

    @property
    def sentence(self) -> str:
        """What a lab book needs."""
        displacement = next(each for each in self.signals if each.channel == "displacement")
        latency = "an unknown number of" if self.latency is None else f"{self.latency.within_n:.2g}"
        shown = [f"{each.quantity} is {each.word}" for each in self.verdicts.differences if each.shown]
        return (
            f"{self.b} follows {self.a} within {displacement.rms_most_lsb:.2g} LSB (displacement, rms, without noise)"
            f" and {latency} samples (mean latency), with {self.confidence:.0%} confidence, in {self.plays} plays of"
            f" {self.scenario}; in the verdicts {', '.join(shown) or 'no difference is shown'}."
        )


@dataclass(frozen=True, eq=False)
class _Pair:
    """One play on both rigs."""

    a: Run
    b: Run
    rows: tuple[Row, Row]

    @property
    def why_invalid(self) -> str:
        for run, each in zip((self.a, self.b), self.rows, strict=True):
            if each["outcome"] == "inconclusive":
                return f"{run.conditions.rig['name']}, seed {each['seed']}: {each.get('why', 'inconclusive')}"
        return ""


def compare_rigs(
    a: Bench,
    b: Bench,
    scenario: Scenario,
    seeds: Sequence[int],
    confidence: float = 0.95,
    progress: Callable[[int, int], None] | None = None,
) -> RigComparison | tuple[str, ...]:
    """Play a scenario with every seed on both, in turn; ``b`` against ``a``.

    Where fewer than two plays are valid on both, the answer is why they are not.

    :raises ConfigurationError: it cannot be played on one of them.
    :raises DeviceError, LinkError, RigError: before a first sample.
    """
    pairs = []
    for done, seed in enumerate(seeds):
        runs = uninterrupted(a.play(scenario, seed)), uninterrupted(b.play(scenario, seed))
        pairs.append(_Pair(*runs, rows=(row(runs[0], judge(runs[0])), row(runs[1], judge(runs[1])))))
        if progress is not None:
            progress(done + 1, len(seeds))
    valid = [pair for pair in pairs if not pair.why_invalid]
    invalid = tuple(pair.why_invalid for pair in pairs if pair.why_invalid)
    if len(valid) < 2:
        return invalid or ("two plays at least are needed",)
    return _compared(valid, invalid, scenario.name, confidence)


def _compared(pairs: Sequence[_Pair], invalid: tuple[str, ...], scenario: str, confidence: float) -> RigComparison:
    rows_a, rows_b = zip(*(pair.rows for pair in pairs), strict=True)
    keyed_a, keyed_b = ([((scenario, each["seed"]), each) for each in rows] for rows in (rows_a, rows_b))
    runs = [(pair.a, pair.b) for pair in pairs]
    first = pairs[0]
    return RigComparison(
        a=str(first.a.conditions.rig["name"]),
        b=str(first.b.conditions.rig["name"]),
        scenario=scenario,
        confidence=confidence,
        plays=len(pairs),
        invalid=invalid,
        signals=tuple(signal_difference(runs, name, confidence) for name in MEASURED),
        latency=_latency(rows_a, rows_b, confidence),
        false_alarms=(_false_alarms(rows_a, confidence), _false_alarms(rows_b, confidence)),
        verdicts=compare(keyed_a, keyed_b, alpha=round(1.0 - confidence, 12)),
    )


# --------------------------------------------------------------------------------------------------------- the signals


def signal_difference(runs: Sequence[tuple[Run, Run]], channel: str, confidence: float) -> SignalDifference:
    """Of one channel in two plays or more; clipped samples, and those at edges of the force, are left out."""
    differences, compared, apart = zip(*(_difference(a, b, channel) for a, b in runs), strict=True)
    noise = math.sqrt(float(np.mean([_noise_variance(each) for each in differences])))
    squares = np.array([np.mean(np.square(each[use])) for each, use in zip(differences, compared, strict=True)])
    mean_square, _, most_square = mean_interval(squares - noise**2, 2.0 * confidence - 1.0)
    largest, at = max((_largest(each, use) for each, use in zip(differences, compared, strict=True)), key=_size)
    count = int(sum(use.sum() for use in compared))
    return SignalDifference(
        channel=channel,
        rms_lsb=math.sqrt(max(mean_square, 0.0)),
        rms_most_lsb=math.sqrt(max(most_square, noise**2 * math.sqrt(2.0 / count))),
        mean_lsb=float(np.mean([each[use].mean() for each, use in zip(differences, compared, strict=True)])),
        largest_lsb=largest,
        largest_at=at,
        largest_noise_lsb=noise * math.sqrt(2.0 * math.log(count / _SMOOTHED_N + 2.0) / _SMOOTHED_N),
        noise_lsb=noise,
        edges_apart=int(sum(apart)),
    )


def _difference(a: Run, b: Run, channel: str) -> tuple[NDArray[np.float64], NDArray[np.bool_], int]:
    """(n,) LSB of a; which samples count; how many do not since edges lie apart there."""
    column, samples = CHANNELS.index(channel), min(a.samples, b.samples)
    of_a, of_b = a.conditions.channels[channel], b.conditions.channels[channel]
    volts = of_b.volts(b.codes[:samples, column]) - of_a.volts(a.codes[:samples, column])
    counted = ~(a.clipped[:samples, column] | b.clipped[:samples, column])
    apart = 0
    if channel == "force":
        edge_a, edge_b = _at_edges(a, samples), _at_edges(b, samples)
        apart = int((np.abs(volts[edge_a | edge_b]) > _EDGE_PART * _swing(a)).sum())
        counted &= ~(edge_a | edge_b)
    return volts / of_a.lsb_v, counted, apart


def _swing(run: Run) -> float:
    volts = run.conditions.channels["force"].volts(run.codes[:, CHANNELS.index("force")])
    return float(np.ptp(volts))


def _at_edges(run: Run, samples: int) -> NDArray[np.bool_]:
    """(samples,): next to a jump of the force, where a small part of a sample decides on which side one is."""
    volts = run.conditions.channels["force"].volts(run.codes[:samples, CHANNELS.index("force")])
    jump = np.flatnonzero(np.abs(np.diff(volts)) > _EDGE_PART * _swing(run))
    near = np.zeros(samples, np.bool_)
    for beside in (-1, 0, 1, 2):
        near[np.clip(jump + beside, 0, samples - 1)] = True
    return near


def _noise_variance(difference: NDArray[np.float64]) -> float:
    """Of white noise on something smooth: third differences have 20 times its variance, but for those, left out, where
    it is not smooth."""
    third = np.convolve(difference, _THIRD_DIFFERENCE, mode="valid")
    sigma = _NORMAL_MAD * float(np.median(np.abs(third)))
    kept = third[np.abs(third) <= _KEPT_SIGMAS * sigma]
    return float(np.mean(np.square(kept))) / _KEPT_VARIANCE / float(np.square(_THIRD_DIFFERENCE).sum())


def _largest(difference: NDArray[np.float64], counted: NDArray[np.bool_]) -> tuple[float, int]:
    """The largest mean over consecutive samples that all count, and the sample in the middle of them."""
    window = np.ones(_SMOOTHED_N)
    whole = np.convolve(counted, window, mode="valid") == _SMOOTHED_N
    means = np.where(whole, np.convolve(difference, window / _SMOOTHED_N, mode="valid"), 0.0)
    at = int(np.argmax(np.abs(means)))
    return float(means[at]), at + _SMOOTHED_N // 2


def _size(largest: tuple[float, int]) -> float:
    return abs(largest[0])


# -------------------------------------------------------------------------------------------------------- the verdicts


def _latency(a: Sequence[Row], b: Sequence[Row], confidence: float) -> LatencyDifference | None:
    """Of changes that were noticed on both."""
    both = [
        [(before.latency_n, after.latency_n) for before, after in zip(changes(mine), changes(other), strict=True)
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


def _false_alarms(rows: Sequence[Row], confidence: float) -> FalseAlarms:
    alarms, samples = (sum(each[what] for each in rows) for what in ("false_alarms", "samples"))
    return FalseAlarms(alarms, samples, *rate_interval(alarms, samples, confidence))
