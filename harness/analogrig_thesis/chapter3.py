"""Chapter 3: the second-order example of section 3.5, Fig. 3.5 to 3.8."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from analogrig_thesis.document import Drawing, Facts, Mark, ReproducedChapter, Signal
from analogrig_thesis.double_precision import PlainEstimator
from analogrig_thesis.plants import square
from analogrig_thesis.schemes import PLAIN, schemes
from analogrig_thesis.tracking import Track, settling_n, track

N = 800
AMPLITUDE = 10.0
NOISE = 0.01 * AMPLITUDE
SEED = 1995
CHANGES = (200, 400)
STRETCHES = ((199, 399), (399, N))
"""Last sample of the old b0 to the last sample of the new one: b0(k) acts on y(k)."""

BEGUN_N = 10
"""Samples until the first estimates have settled."""

SILENT = slice(200, 600)
"""Samples without input, for the wind-up of P."""

WALKS = (1.0, 1e-2, 1e-4, 1e-6, 1e-8, 0.0)

PLAIN_3 = dataclasses.replace(PLAIN, nb=1)
SCHEMES = schemes(PLAIN_3, 0.3 * AMPLITUDE, 0.3 * AMPLITUDE, BEGUN_N)
del SCHEMES["mean-between-faults"]


@dataclasses.dataclass(frozen=True, eq=False)
class Example:
    """System of section 3.5 and the estimates of each scheme."""

    u: Signal
    noise: Signal
    steady: Signal
    """(N, 3) a1, a2, b0 without a change."""
    changing: Signal
    """(N, 3) a1, a2, b0 with two changes of b0."""
    first: Track
    """Plain RLS without a change and without noise."""
    clean: Mapping[str, Track]
    """Tracks by scheme, while b0 changes, without noise."""
    noisy: Mapping[str, Track]
    """Tracks by scheme, while b0 changes, with noise of 1 % of the amplitude."""


def respond(u: Signal, theta: Signal, noise: Signal | None = None) -> Signal:
    """Output y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k-1) [+ e(k)] (n,) (section 3.5), from rest."""
    y, inputs = [0.0, 0.0], [0.0, *u.tolist()]
    for k, (a1, a2, b0) in enumerate(theta.tolist()):
        y.append(-a1 * y[-1] - a2 * y[-2] + b0 * inputs[k] + (0.0 if noise is None else float(noise[k])))
    return np.array(y[2:])


def play_example() -> Example:
    """Simulate the system and run all schemes; deterministic."""
    u = square(N, AMPLITUDE)
    steady = np.tile((0.5, 0.8, -0.9), (N, 1))
    changing = steady.copy()
    changing[slice(*CHANGES), 2] = -0.5
    noise = np.random.default_rng(SEED).normal(0.0, NOISE, N)
    return Example(
        u,
        noise,
        steady,
        changing,
        first=track(PLAIN_3, u, respond(u, steady)),
        clean={key: track(config, u, respond(u, changing)) for key, config in SCHEMES.items()},
        noisy={key: track(config, u, respond(u, changing, noise)) for key, config in SCHEMES.items()},
    )


def simulated_data(example: Example) -> dict[str, Signal]:
    """Input and output by figure."""
    steady, changing = respond(example.u, example.steady), respond(example.u, example.changing)
    return {"fig-3.5-u": example.u, "fig-3.5-y": steady, "fig-3.6-u": example.u, "fig-3.6-y": changing}


def reproduce_chapter(example: Example) -> ReproducedChapter:
    """Figures, errata and claims of chapter 3."""
    clean, noisy = _qualities(example.clean, example.changing), _qualities(example.noisy, example.changing)
    times = noisy["spread"]["random-walk"] / noisy["spread"]["forgetting"]
    facts = {"clean": clean, "noisy": noisy, "random_walk_over_forgetting": times}
    return ReproducedChapter.load(3, facts, _drawings(example), _measure(example, clean, noisy))


def _qualities(tracks: Mapping[str, Track], known: Signal) -> dict[str, dict[str, Any]]:
    """Spread and convergence by scheme."""
    return {
        "spread": {key: _spread(each, known) for key, each in tracks.items()},
        "reconverged_n": {key: _reconverged(each, known) for key, each in tracks.items()},
    }


def _reconverged(each: Track, known: Signal) -> list[int | None]:
    error = each.theta / known - 1.0
    return [settling_n(error[start + 1 : end]) for start, end in STRETCHES]


def _spread(each: Track, known: Signal) -> float:
    """Largest standard deviation of a parameter over its truth, in the last half of the first stretch."""
    return float((each.theta[100:200] / known[100:200]).std(axis=0).max())


# Figures


def _drawings(example: Example) -> dict[str, Drawing]:
    marks = (Mark(200.0, "change", "b0 −0.9 → −0.5"), Mark(400.0, "change", "b0 −0.5 → −0.9"))
    alarms = tuple(Mark(float(k), "alarm") for k in example.clean["prediction-error"].alarms)
    half = slice(0, N // 2)
    data = [example.u[half], respond(example.u, example.steady)[half]]
    drawings = {"3.5": Drawing([data, [*example.steady[half].T, *example.first.theta[half].T]])}
    for number, key in (("3.6", "forgetting"), ("3.7", "random-walk"), ("3.8", "prediction-error")):
        both = (*marks, *alarms) if number == "3.8" else marks
        drawings[number] = Drawing([[*example.changing.T, *example.clean[key].theta.T]], both)
    return drawings


# Claims


def _measure(example: Example, clean: Facts, noisy: Facts) -> dict[str, Facts]:
    """Values behind each claim, by identifier."""
    late_error = example.clean["rls"].theta[399] / example.changing[399] - 1.0
    varied, steady = (each.theta[BEGUN_N:, :2].var(axis=0) for each in (example.clean["forgetting"], example.first))
    eager_config = dataclasses.replace(SCHEMES["prediction-error"], hold_off_n=0)
    return {
        "3.5-converges": {
            "within_1_percent_after_n": settling_n(example.first.theta / example.steady - 1.0, 0.01),
            "spread": _spread(example.first, example.steady),
        },
        "3.5-slow": {
            "largest_error_200_samples_after": float(np.abs(late_error).max()),
            "reconverged_n": clean["reconverged_n"]["rls"],
        },
        "3.6-sluggish": {"reconverged_n": clean["reconverged_n"]["forgetting"]},
        "3.6-variance": {
            "variances_of_a1_a2": varied.tolist(),
            "variances_of_a1_a2_in_fig_3.5": steady.tolist(),
            "spread_without_noise": clean["spread"],
            "spread_with_noise": noisy["spread"],
        },
        "3.6-wind-up": _wind_up(example),
        "3.7-quicker": {"reconverged_n": {key: clean["reconverged_n"][key] for key in ("random-walk", "forgetting")}},
        "3.7-variance": {
            "spread_without_noise": clean["spread"]["random-walk"],
            "spread_with_noise": noisy["spread"]["random-walk"],
        },
        "3.7-equivalent": {"largest_difference_by_r": _differences_from_plain(example)},
        "3.8-better": {
            "reconverged_n": clean["reconverged_n"]["prediction-error"],
            "spread_with_noise": noisy["spread"]["prediction-error"],
            "alarms": len(example.clean["prediction-error"].alarms),
            "alarms_without_hold_off": len(track(eager_config, example.u, respond(example.u, example.changing)).alarms),
        },
    }


def _wind_up(example: Example) -> Facts:
    u, config = example.u.copy(), SCHEMES["forgetting"]
    u[SILENT] = 0.0
    errors = track(config, u, respond(u, example.steady, example.noise)).theta / example.steady - 1.0
    _, p = PlainEstimator(config).run(u, respond(u, example.steady))
    late = errors[300:600]
    return {
        "growth_of_p_in_100": float(p[380, 0] / p[280, 0]),
        "spread_before": float(errors[100:200].std(axis=0).max()),
        "spread_in_silence": float(late.std(axis=0).max()),
        "bias_in_silence": float(np.abs(late.mean(axis=0)).max()),
    }


def _differences_from_plain(example: Example) -> dict[str, float]:
    """Largest difference of an estimate from plain RLS, by r in R = r I."""
    y = respond(example.u, example.steady, example.noise)
    plain = track(PLAIN_3, example.u, y).theta
    walks = {f"{walk:g}": track(dataclasses.replace(PLAIN_3, random_walk=walk), example.u, y).theta for walk in WALKS}
    return {key: float(np.abs(theta - plain).max()) for key, theta in walks.items()}
