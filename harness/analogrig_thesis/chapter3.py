"""Chapter 3: the second-order example of section 3.5, Fig. 3.5 to 3.8."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from analogrig_thesis.double_precision import PlainEstimator
from analogrig_thesis.models import ERROR, MEAN, PLAIN, SignalPair, Track, schemes, settling_n, square
from analogrig_thesis.texts import Chapter, Drawing, Facts, Mark, Signal, load_chapter

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
del SCHEMES[MEAN]

STEADY = np.tile((0.5, 0.8, -0.9), (N, 1))
"""a1, a2, b0 (N, 3) without a change."""
CHANGING = STEADY.copy()
"""a1, a2, b0 (N, 3) with two changes of b0."""
CHANGING[slice(*CHANGES), 2] = -0.5


def respond(u: Signal, theta: Signal, noise: Signal | None = None) -> Signal:
    """Output y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k-1) [+ e(k)] (n,) (section 3.5), from rest."""
    y, inputs = [0.0, 0.0], [0.0, *u.tolist()]
    for k, (a1, a2, b0) in enumerate(theta.tolist()):
        y.append(-a1 * y[-1] - a2 * y[-2] + b0 * inputs[k] + (0.0 if noise is None else float(noise[k])))
    return np.array(y[2:])


def simulate_example() -> dict[str, Signal]:
    """Input and output by figure."""
    u = square(N, AMPLITUDE)
    return {"fig-3.5-u": u, "fig-3.5-y": respond(u, STEADY), "fig-3.6-u": u, "fig-3.6-y": respond(u, CHANGING)}


def reproduce_chapter() -> Chapter:
    """Figures, errata and claims of chapter 3; deterministic."""
    u, _, _, y = simulate_example().values()
    noise = np.random.default_rng(SEED).normal(0.0, NOISE, N)
    first = SignalPair(u, respond(u, STEADY)).track(PLAIN_3)
    clean, noisy = (
        {key: samples.track(config) for key, config in SCHEMES.items()}
        for samples in (SignalPair(u, y), SignalPair(u, respond(u, CHANGING, noise)))
    )
    facts = {"clean": _qualities(clean), "noisy": _qualities(noisy)}
    spread = facts["noisy"]["spread"]
    facts["random_walk_over_forgetting"] = spread["random-walk"] / spread["forgetting"]
    measured = {**_measure_convergence(facts, clean, first, u), **_measure_filters(u, noise)}
    return load_chapter(3, facts, _drawings(u, clean, first), measured)


def _qualities(tracks: Mapping[str, Track]) -> dict[str, Any]:
    """Spread and convergence by scheme, while b0 changes."""
    return {
        "spread": {key: _spread(each, CHANGING) for key, each in tracks.items()},
        "reconverged_n": {
            key: [settling_n((each.theta / CHANGING - 1.0)[start + 1 : end]) for start, end in STRETCHES]
            for key, each in tracks.items()
        },
    }


def _spread(each: Track, known: Signal) -> float:
    """Largest standard deviation of a parameter over its truth, in the last half of the first stretch."""
    return float((each.theta[100:200] / known[100:200]).std(axis=0).max())


def _drawings(u: Signal, clean: Mapping[str, Track], first: Track) -> dict[str, Drawing]:
    marks = (Mark(200.0, "change", "b0 −0.9 → −0.5"), Mark(400.0, "change", "b0 −0.5 → −0.9"))
    alarms = tuple(Mark(float(k), "alarm") for k in clean[ERROR].alarms)
    half = slice(0, N // 2)
    data = [u[half], respond(u, STEADY)[half]]
    drawings = {"3.5": Drawing([data, [*STEADY[half].T, *first.theta[half].T]])}
    for number, key in (("3.6", "forgetting"), ("3.7", "random-walk"), ("3.8", ERROR)):
        both = (*marks, *alarms) if number == "3.8" else marks
        drawings[number] = Drawing([[*CHANGING.T, *clean[key].theta.T]], both)
    return drawings


def _measure_convergence(facts: Facts, clean: Mapping[str, Track], first: Track, u: Signal) -> dict[str, Facts]:
    """Values behind the claims about convergence and scatter, by identifier."""
    reconverged_n, spread, noisy_spread = (
        facts["clean"]["reconverged_n"],
        facts["clean"]["spread"],
        facts["noisy"]["spread"],
    )
    late_error = clean["rls"].theta[399] / CHANGING[399] - 1.0
    varied, steady = (each.theta[BEGUN_N:, :2].var(axis=0) for each in (clean["forgetting"], first))
    eager = dataclasses.replace(SCHEMES[ERROR], hold_off_n=0)
    return {
        "3.5-converges": {
            "within_1_percent_after_n": settling_n(first.theta / STEADY - 1.0, 0.01),
            "spread": _spread(first, STEADY),
        },
        "3.5-slow": {
            "largest_error_200_samples_after": float(np.abs(late_error).max()),
            "reconverged_n": reconverged_n["rls"],
        },
        "3.6-sluggish": {"reconverged_n": reconverged_n["forgetting"]},
        "3.6-variance": {
            "variances_of_a1_a2": varied.tolist(),
            "variances_of_a1_a2_in_fig_3.5": steady.tolist(),
            "spread_without_noise": spread,
            "spread_with_noise": noisy_spread,
        },
        "3.7-quicker": {"reconverged_n": {key: reconverged_n[key] for key in ("random-walk", "forgetting")}},
        "3.7-variance": {
            "spread_without_noise": spread["random-walk"],
            "spread_with_noise": noisy_spread["random-walk"],
        },
        "3.8-better": {
            "reconverged_n": reconverged_n[ERROR],
            "spread_with_noise": noisy_spread[ERROR],
            "alarms": len(clean[ERROR].alarms),
            "alarms_without_hold_off": len(SignalPair(u, respond(u, CHANGING)).track(eager).alarms),
        },
    }


def _measure_filters(u: Signal, noise: Signal) -> dict[str, Facts]:
    """Values behind the claims about the wind-up of P and the Kalman filter, by identifier."""
    silent, config = u.copy(), SCHEMES["forgetting"]
    silent[SILENT] = 0.0
    errors = SignalPair(silent, respond(silent, STEADY, noise)).track(config).theta / STEADY - 1.0
    p = PlainEstimator(config).run(silent, respond(silent, STEADY))[1][:, 0]
    late = errors[300:600]
    samples = SignalPair(u, respond(u, STEADY, noise))
    plain = samples.track(PLAIN_3).theta
    walks = {f"{walk:g}": samples.track(dataclasses.replace(PLAIN_3, random_walk=walk)).theta for walk in WALKS}
    return {
        "3.6-wind-up": {
            "growth_of_p_in_100": float(p[380] / p[280]),
            "spread_before": float(errors[100:200].std(axis=0).max()),
            "spread_in_silence": float(late.std(axis=0).max()),
            "bias_in_silence": float(np.abs(late.mean(axis=0)).max()),
        },
        "3.7-equivalent": {
            "largest_difference_by_r": {key: float(np.abs(theta - plain).max()) for key, theta in walks.items()}
        },
    }
