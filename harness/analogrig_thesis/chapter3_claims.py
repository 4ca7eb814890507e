"""What chapter 3 says of its example, measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

import numpy as np

from analogrig.devices.estimator_config import EstimatorConfig
from analogrig.devices.reference import ReferenceEstimator
from analogrig_thesis.chapter3 import (
    PLAIN_3,
    SCHEMES,
    Example,
    N,
    follow,
)
from analogrig_thesis.document import Claim, Signal
from analogrig_thesis.schemes import FORGETTING, HOLD_N
from analogrig_thesis.tracking import CONVERGED, Track, settled, track

STRETCHES = ((0, 199), (199, 399), (399, N))
"""From the last sample of the old b0 to that of the next: b0(k) acts on y(k)."""

BEGUN_N = 10
"""By then the first estimates have settled."""


def claims(example: Example) -> tuple[Claim, ...]:
    """In the order of the text."""
    return tuple(
        each(example)
        for each in (
            _converges,
            _slow,
            _sluggish,
            _variance,
            _wind_up,
            _quicker,
            _degraded,
            _equivalent,
            _better,
        )
    )


def _converges(example: Example) -> Claim:
    quick = settled(example.first.theta / example.steady - 1.0, 0.01)
    return Claim(
        "3.5-converges",
        "3.5, Fig. 3.5",
        "Since the above system is deterministic these estimates are quick to converge and have excellent variance"
        " properties.",
        "holds",
        f"All three are within 1 % after {quick} samples and stay there.",
        {"within_1_percent_after_n": quick, "spread": _spread(example.first, example.steady)},
        ("3.5",),
    )


def _slow(example: Example) -> Claim:
    back = _reconverged(example.clean["rls"], example.changing)
    off = float(np.abs(example.clean["rls"].theta[399] / example.changing[399] - 1.0).max())
    return Claim(
        "3.5-slow",
        "3.5",
        "Although the ordinary R.L.S. algorithm does possess a certain innate tracking capability its rate of"
        " convergence is too slow.",
        "holds",
        f"200 samples after b0 rose to −0.5 one of the three is still wrong by {off:.0%}; all come within 5 %"
        " after neither change.",
        {"largest_error_200_samples_after": off, "reconverged_n": back},
    )


def _sluggish(example: Example) -> Claim:
    back = _reconverged(example.clean["forgetting"], example.changing)
    return Claim(
        "3.6-sluggish",
        "3.6, Fig. 3.6",
        "the forgetting factor algorithm works insofar as it is capable of tracking system parameters … the"
        " tracking of the parameters is rather sluggish.",
        "holds",
        f"Within 5 % again after {_join(back)} samples: {1 / (1 - FORGETTING):.0f} samples of"
        " memory, and hardly any excitation between two edges.",
        {"reconverged_n": back},
        ("3.6",),
    )


def _variance(example: Example) -> Claim:
    spread, spread_noisy = _spreads(example, "clean"), _spreads(example, "noisy")
    varied, steady_varied = (
        each.theta[BEGUN_N:, :2].var(axis=0).tolist() for each in (example.clean["forgetting"], example.first)
    )
    return Claim(
        "3.6-variance",
        "3.6, Fig. 3.6",
        "the overall variance of the parameters has increased",
        "holds",
        f"Over the whole of Fig. 3.6, from sample {BEGUN_N} on, a1 and a2, which do not change, have variances of"
        f" {varied[0]:.4f} and {varied[1]:.4f}; in the experiment of Fig. 3.5 they have {steady_varied[0]:.1e} and"
        f" {steady_varied[1]:.1e}. Before the first change, without noise, λ = 0.97 scatters"
        f" {spread['forgetting']:.1e} against {spread['rls']:.1e} of plain RLS, less and not more; with noise of"
        f" 1 % of the amplitude {spread_noisy['forgetting']:.1e} against {spread_noisy['rls']:.1e}.",
        {
            "variances_of_a1_a2": varied,
            "variances_of_a1_a2_in_fig_3.5": steady_varied,
            "spread_without_noise": spread,
            "spread_with_noise": spread_noisy,
        },
        ("3.6",),
    )


SILENT = slice(200, 600)
"""The input is off, for the wind-up."""


def _diagonals(config: EstimatorConfig, u: Signal, y: Signal) -> Signal:
    """Of P (N, 3), which only the estimator in Python shows."""
    twin, out = ReferenceEstimator(config), []
    for pair in zip(u.tolist(), y.tolist(), strict=True):
        twin.step(*pair)
        upper = np.array(twin.covariance.u)
        out.append((upper**2 * twin.covariance.d).sum(axis=1) / twin.covariance.weight)
    return np.array(out)


def _wind_up(example: Example) -> Claim:
    u, config = example.u.copy(), SCHEMES["forgetting"]
    u[SILENT] = 0.0
    errors = track(config, u, follow(u, example.steady, example.noise)).theta / example.steady - 1.0
    p = _diagonals(config, u, follow(u, example.steady))
    before, silent = (float(errors[part].std(axis=0).max()) for part in (slice(100, 200), slice(300, 600)))
    bias = float(np.abs(errors[300:600].mean(axis=0)).max())
    grown = float(p[380, 0] / p[280, 0])
    return Claim(
        "3.6-wind-up",
        "3.6",
        "when the input signal decreases significantly in amplitude … P(k+1) ≅ λ⁻¹P(k) … the covariance matrix P(k+1)"
        " increases in size beyond control … This has the effect of rendering the parameters unreliable and biased.",
        "holds with a reading",
        f"Reading: unreliable, not biased, and beyond control only in the recursion as printed. With the input off from"
        f" sample 200 to 600 and without noise P grows {grown:.1f} times in 100 samples, and λ⁻¹⁰⁰ is"
        f" {FORGETTING**-100:.1f}; our C lets it grow to the P of the start and no further. With noise of 1 % of the"
        f" amplitude the estimates scatter {silent:.1%} in the silence instead of {before:.1%} before, and their mean"
        f" is {bias:.1%} off.",
        {"growth_of_p_in_100": grown, "spread_before": before, "spread_in_silence": silent, "bias_in_silence": bias},
    )


def _quicker(example: Example) -> Claim:
    walk, forgetting = (_reconverged(example.clean[key], example.changing) for key in ("random-walk", "forgetting"))
    return Claim(
        "3.7-quicker",
        "3.7.2, Fig. 3.7",
        "the Kalman filter responds quicker than the forgetting factor algorithm (see Fig. 3.6) to changes in"
        " system parameters.",
        "holds",
        f"{_join(walk)} samples against {_join(forgetting)}.",
        {"reconverged_n": {"random-walk": walk, "forgetting": forgetting}},
        ("3.6", "3.7"),
    )


def _degraded(example: Example) -> Claim:
    spread, spread_noisy = _spreads(example, "clean"), _spreads(example, "noisy")
    return Claim(
        "3.7-variance",
        "3.7.2, Fig. 3.7",
        "there is a severe degradation in the variance properties of the resulting estimates",
        "holds with a reading",
        f"Reading: of noisy data. Without noise R = I scatters {spread['random-walk']:.1e}, which is rounding."
        f" With noise of 1 % of the amplitude it scatters {spread_noisy['random-walk']:.1e},"
        f" {spread_noisy['random-walk'] / spread_noisy['forgetting']:.0f} times as much as λ = 0.97.",
        {"spread_without_noise": spread["random-walk"], "spread_with_noise": spread_noisy["random-walk"]},
        ("3.7",),
    )


WALKS = (1.0, 1e-2, 1e-4, 1e-6, 1e-8, 0.0)


def _equivalent(example: Example) -> Claim:
    y = follow(example.u, example.steady, example.noise)
    plain = track(PLAIN_3, example.u, y).theta
    apart = {
        f"{walk:g}": float(
            np.abs(track(dataclasses.replace(PLAIN_3, random_walk=walk), example.u, y).theta - plain).max()
        )
        for walk in WALKS
    }
    listed = ", ".join(f"{each:.1e} with R = {walk} I" for walk, each in apart.items() if each)
    return Claim(
        "3.7-equivalent",
        "3.7.2",
        "since process noise has been ignored in this system (and hence R = 0) it can be shown that the Kalman filter"
        " reduces to Equ. 3.19/20, the R.L.S. algorithm.",
        "holds",
        "The largest difference of any estimate from that of plain RLS, on data with noise of 1 % of the amplitude, is"
        f" {listed}, and none at all with R = 0.",
        {"largest_difference_by_r": apart},
    )


def _better(example: Example) -> Claim:
    simple = example.clean["prediction-error"]
    back, forgetting = (_reconverged(each, example.changing) for each in (simple, example.clean["forgetting"]))
    spread_noisy = _spreads(example, "noisy")
    eager_config = dataclasses.replace(SCHEMES["prediction-error"], hold_off_n=0)
    eager = track(eager_config, example.u, follow(example.u, example.changing))
    return Claim(
        "3.8-better",
        "3.8, Fig. 3.8",
        "It tracks the system parameters with better variance properties than those produced by the Kalman"
        " filter and reconverges to the correct parameter estimates faster than the forgetting factor algorithm.",
        "holds with a reading",
        f"Reading: {HOLD_N} samples of hold-off after a reset. It is back after {_join(back)}"
        f" samples (forgetting: {_join(forgetting)}) and scatters {spread_noisy['prediction-error']:.1e}"
        f" with 1 % of noise (Kalman: {spread_noisy['random-walk']:.1e}). Without a hold-off the error that the"
        f" reset itself causes raises the next alarm: {len(eager.alarms)} alarms instead of"
        f" {len(simple.alarms)}.",
        {
            "reconverged_n": back,
            "spread_with_noise": spread_noisy["prediction-error"],
            "alarms": len(simple.alarms),
            "alarms_without_hold_off": len(eager.alarms),
        },
        ("3.8",),
    )


def _reconverged(each: Track, known: Signal) -> list[int | None]:
    error = each.theta / known - 1.0
    return [settled(error[start + 1 : end], CONVERGED) for start, end in STRETCHES[1:]]


def _spread(each: Track, known: Signal) -> float:
    """The largest standard deviation of a parameter over its truth in the last half of the first stretch."""
    return float((each.theta[100:200] / known[100:200]).std(axis=0).max())


def _spreads(example: Example, data: Literal["clean", "noisy"]) -> dict[str, float]:
    """Of each scheme on those data."""
    tracks: Mapping[str, Track] = getattr(example, data)
    return {key: _spread(each, example.changing) for key, each in tracks.items()}


def _join(counts: list[int | None]) -> str:
    return " and ".join("never" if each is None else str(each) for each in counts)
