"""Chapter 3: the second-order example, Fig. 3.5 to 3.8."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from analogrig.devices.estimator_config import EstimatorConfig
from analogrig_thesis.document import Chapter, Claim, Curve, Erratum, Figure, Mark, Panel, Signal
from analogrig_thesis.model import square
from analogrig_thesis.schemes import FORGETTING, HOLD_N, PLAIN
from analogrig_thesis.tracking import Track, track

N = 800
AMPLITUDE = 10.0
CEILING = 0.3 * AMPLITUDE
A1, A2 = 0.5, 0.8
NOISE = 0.01 * AMPLITUDE
SEED = 1995

NAMES = ("a1", "a2", "b0")
INKS = ("first", "second", "third")

PLAIN_3 = dataclasses.replace(PLAIN, nb=1)
SCHEMES: Mapping[str, EstimatorConfig] = {
    "rls": PLAIN_3,
    "forgetting": dataclasses.replace(PLAIN_3, forgetting=FORGETTING),
    "random-walk": dataclasses.replace(PLAIN_3, random_walk=1.0),
    "prediction-error": dataclasses.replace(
        PLAIN_3, trigger="prediction-error", ceiling=CEILING, reset="all", hold_off_n=HOLD_N, warm_up_n=10
    ),
}


def truth(*, changing: bool) -> Signal:
    """(N, 3) a1, a2, b0."""
    out = np.tile((A1, A2, -0.9), (N, 1))
    if changing:
        out[200:400, 2] = -0.5
    return out


def follow(u: Signal, theta: Signal, noise: Signal | None = None) -> Signal:
    """y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k-1) [+ e(k)] (section 3.5), from rest."""
    y, inputs = [0.0, 0.0], [0.0, *u.tolist()]
    for k, (a1, a2, b0) in enumerate(theta.tolist()):
        y.append(-a1 * y[-1] - a2 * y[-2] + b0 * inputs[k] + (0.0 if noise is None else float(noise[k])))
    return np.array(y[2:])


@dataclasses.dataclass(frozen=True, eq=False)
class Example:
    """The system of section 3.5, and what each scheme makes of it."""

    u: Signal
    noise: Signal
    steady: Signal
    """(N, 3) the parameters if they do not change."""
    changing: Signal
    first: Track
    """Plain RLS while nothing changes, without noise."""
    clean: Mapping[str, Track]
    """By scheme, while b0 changes; so ``noisy``."""
    noisy: Mapping[str, Track]

    @classmethod
    def play(cls) -> Example:
        """Deterministic."""
        u = square(N, -AMPLITUDE, AMPLITUDE)
        steady, changing = truth(changing=False), truth(changing=True)
        noise = np.random.default_rng(SEED).normal(0.0, NOISE, N)
        return cls(
            u,
            noise,
            steady,
            changing,
            first=track(PLAIN_3, u, follow(u, steady)),
            clean={key: track(config, u, follow(u, changing)) for key, config in SCHEMES.items()},
            noisy={key: track(config, u, follow(u, changing, noise)) for key, config in SCHEMES.items()},
        )


def chapter(example: Example, claims: tuple[Claim, ...]) -> Chapter:
    """All of it."""
    return Chapter(
        3,
        "System identification and parameter estimation",
        "The example of section 3.5, y(k) = −0.5 y(k−1) − 0.8 y(k−2) − 0.9 u(k−1), from rest and without noise. The"
        f" text gives no amplitude and no rate: assumed are ±{AMPLITUDE:g}, 100 samples a second as in chapter 4, θ ="
        " 0 and P = 10 I at the start. With ±1 that P is no longer vague, and the first convergence takes 62 samples"
        " instead of 5.",
        figures=_figures(example),
        numbers=(),
        errata=_ERRATA,
        claims=claims,
    )


def recorded() -> dict[str, Signal]:
    """The data, by figure."""
    u = square(N, -AMPLITUDE, AMPLITUDE)
    steady, changing = follow(u, truth(changing=False)), follow(u, truth(changing=True))
    return {"fig-3.5-u": u, "fig-3.5-y": steady, "fig-3.6-u": u, "fig-3.6-y": changing}


_ERRATA = (
    Erratum(
        "Equ. 3.23b, d",
        "ε(k+1) = y(k) − …, and φ(k) in the denominator of P(k+1)",
        "y(k+1) and φ(k+1)",
        "With R = 0 the filter must reduce to Equ. 3.19 and 3.20, as section 3.7.2 says. Those have y(k+1) in the"
        " prediction error and φ(k+1) on both sides of the quadratic form 1 + φᵀ(k+1) P(k) φ(k+1).",
    ),
    Erratum(
        "Equ. 3.23c",
        "K(k+1) = P(k+1) φ(k+1) = P(k) φ(k+1) / (1 + φᵀ P(k) φ)",
        "the first equality holds for R = 0 only",
        "Equ. 3.23d gives P(k+1) φ = P(k) φ (1 − φᵀPφ / (1 + φᵀPφ)) + R φ = P(k) φ / (1 + φᵀPφ) + R φ: the two"
        " sides differ by R φ(k+1).",
    ),
    Erratum(
        "Equ. 3.26, 3.28",
        "E(w(k)) = R",
        "E(w(k) wᵀ(k)) = R, with E(w(k)) = 0",
        "The mean of a vector is a vector, and R is added to the matrix P in Equ. 3.23d: it is the covariance.",
    ),
    Erratum(
        "Section 3.6, the changing b0",
        "b0 = −0.9 for k < 200, −0.5 for 200 < k < 400",
        "−0.5 for 200 ≤ k < 400",
        "At k = 200 and k = 400 b0 is undefined as printed; assumed here is that the new value begins there.",
    ),
    Erratum(
        "Numbers of equations",
        "the measurement y(k) = H x(k) + v(k) is Equ. 3.24b; two equations are 3.23a, two 3.24b",
        "3.23b, or numbers of their own",
        "The state equation before it is 3.23a, and so is the first line of the filter. Equ. 3.24b is, further down,"
        " y(k) = φᵀ(k) x(k) + e(k) as well.",
    ),
    Erratum(
        "Equ. A.2.3",
        "φᵀ(t+1)φ(t+1) = [φᵀ(t) φ(t+1)][φ(t) φᵀ(t+1)], a product",
        "φᵀ(t)φ(t) + φ(t+1)φᵀ(t+1), a sum",
        "One more measurement adds a row φᵀ(t+1) to the matrix φ(t): stacked, the product of the two block matrices"
        " is the sum. Equ. A.2.9, the inverse of P, has it right.",
    ),
    Erratum(
        "Sections 3.7 and 4.4.3",
        "the text between “…random walk modifications to the” and “It is visible from Fig. 3.8”, and between"
        " “…when the system changes the mean” and “between detectable faults to 0.04s”",
        "a page is lacking in each place of the text that was handed down",
        "They would have named the ceiling and the reset of Fig. 3.8, and the exact mean of Fig. 4.9. What is"
        " assumed in their place stands with those figures.",
    ),
)


def _figures(example: Example) -> tuple[Figure, ...]:
    u, steady, changing, clean = example.u, example.steady, example.changing, example.clean
    marks = (Mark(200.0, "change", "b0 −0.9 → −0.5"), Mark(400.0, "change", "b0 −0.5 → −0.9"))
    shown = slice(0, 400)
    data = Panel(
        "(a) Identification data",
        "u, y",
        (Curve("input u", u[shown], "third", "step"), Curve("output y", follow(u, steady)[shown], "first")),
    )
    alarms = tuple(Mark(float(k), "alarm") for k in clean["prediction-error"].alarms)
    return (
        Figure(
            "3.5",
            "(a) Identification data, (b) Parameter estimates using R.L.S.",
            (data, _estimates(example.first.theta[shown], steady[shown], "(b) Parameter estimates")),
            "The first 400 samples. The system is deterministic, and four equations determine three parameters.",
        ),
        Figure(
            "3.6",
            "Tracking of the system parameters using the forgetting factor algorithm.",
            (_estimates(clean["forgetting"].theta, changing, f"λ = {FORGETTING:g}"),),
            "Between two edges of the input nothing new is learned: the estimate comes nearer in steps, an edge at a"
            " time.",
            marks,
        ),
        Figure(
            "3.7",
            "Tracking the system parameters using the Kalman filter.",
            (_estimates(clean["random-walk"].theta, changing, "R = identity matrix"),),
            "Without noise the filter follows at once and does not scatter; the scatter of which the thesis speaks"
            " comes with noise: see the claims below.",
            marks,
        ),
        Figure(
            "3.8",
            "Estimation using simple fault detection.",
            (_estimates(clean["prediction-error"].theta, changing, "reset by the prediction error"),),
            "The page that describes the scheme is lost. Assumed: an alarm when the prediction error exceeds 0.3"
            f" amplitudes, then θ = 0 and P = 10 I as in section 4.4.2, and {HOLD_N} samples without a second alarm,"
            " while the new estimate is worked out.",
            (*marks, *alarms),
        ),
    )


def _estimates(theta: Signal, known: Signal, title: str) -> Panel:
    curves = [Curve(f"{name} true", known[:, i], "truth", "step") for i, name in enumerate(NAMES)]
    inks = dict(zip(NAMES, INKS, strict=True))
    for i, name in enumerate(NAMES):
        curves.append(Curve(name, theta[:, i], inks[name]))  # type: ignore[arg-type]  # mypy widens the literals
    return Panel(title, "parameters", tuple(curves), shown=(-1.5, 1.5))
