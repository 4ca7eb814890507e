"""Chapter 4: the simulated suspension, Fig. 4.1 to 4.10."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from analogrig.plant import Plant
from analogrig.run import Segment
from analogrig_thesis.document import Chapter, Claim, Curve, Erratum, Figure, Number, Panel, Signal
from analogrig_thesis.model import (
    FRONT,
    PERIOD_S,
    PROFILE,
    PROFILE_N,
    SHOCK,
    Arx,
    square,
    time_varying,
)
from analogrig_thesis.schemes import HOLD_N, P0, PLAIN, schemes
from analogrig_thesis.tracking import Performance, Track, marks, performance, track

SHOCK_FORCE_N, FRONT_FORCE_N = 1470.0, 2940.0
"""Section 4.3: 12 cm of stroke against 12.25 kN/m; section 4.4.1: twice that."""

UNITS_PER_M = 1e7
"""In which the printed ceilings make sense: a unit is 0.1 um."""

ERROR_CEILING, MEAN_CEILING = 1500.0, 300.0
"""Sections 4.4.2 and 4.4.3."""

WARM_UP_N = 50
"""Section 5.5: "the fault detection algorithm was switched off for the first 50 samples"."""

PRINTED_4_3 = Arx(-0.8816, 0.0112, 0.8383e-5, 0.2197e-5)
PRINTED_4_5 = Arx(-0.8794, 0.0093, 0.8382e-5, 0.2222e-5)
PRINTED_4_8 = Arx(-1.7503, 0.769, -0.3650e-5, 0.3984e-5)
SHOCK_ZETA = 2.87
"""With which all eight printed figures of Equ 4.3 come out; B = 900 has 2.875."""

PRINTED_ZETA = (0.9, 1.04, 1.2, 0.69, 1.37)

CHANGE_LABELS = ("K↓", "B↑", "B↓, K↑", "M↓")

THESIS_SCHEMES = schemes(PLAIN, ERROR_CEILING, MEAN_CEILING, WARM_UP_N)


@dataclasses.dataclass(frozen=True, eq=False)
class Simulation:
    """The time-varying front suspension without noise, and what the thesis's five schemes make of it."""

    u: Signal
    y: Signal
    """metres"""
    identified: Arx
    """Equ. 4.5, as it comes out here."""
    tracks: Mapping[str, Track]
    performances: Mapping[str, Performance]


def simulate() -> Simulation:
    u = square(PROFILE_N, -FRONT_FORCE_N, FRONT_FORCE_N)
    y = time_varying(u)
    tracks = {scheme.key: track(scheme.config, u, y * UNITS_PER_M, UNITS_PER_M) for scheme in THESIS_SCHEMES}
    return Simulation(u, y, _identified(), tracks, {key: performance(each, PROFILE) for key, each in tracks.items()})


def recorded(simulation: Simulation) -> dict[str, Signal]:
    """The data, by figure: newtons and metres."""
    shock, front = square(400, -SHOCK_FORCE_N, SHOCK_FORCE_N), square(400, -FRONT_FORCE_N, FRONT_FORCE_N)
    return {
        "fig-4.1-u": shock,
        "fig-4.1-y": time_varying(shock, [Segment(0, SHOCK)]),
        "fig-4.3-u": front,
        "fig-4.3-y": time_varying(front, [Segment(0, FRONT)]),
        "fig-4.5-u": simulation.u,
        "fig-4.5-y": simulation.y,
    }


def zeta(plant: Plant) -> float:
    """The damping ratio."""
    return plant.damping_n_s_per_m / (2.0 * math.sqrt(plant.stiffness_n_per_m * plant.mass_kg))


def chapter(simulation: Simulation, claims: tuple[Claim, ...]) -> Chapter:
    """All of it."""
    return Chapter(
        4,
        "System simulation",
        "The plant is the exact zero-order-hold model at 100 Hz; a change jumps in its physical state, position and"
        " velocity go on. The square wave begins high and has 100 samples a period. Where nothing else is said y is"
        f" in units of {1e6 / UNITS_PER_M:g} µm: only in units of about 1e7 to the metre do"
        " ceilings of 1500 and 300 make sense (see the"
        f" readings below), and with it θ = 0 and P = {P0:g} I at the start.",
        figures=(*_stationary_figures(simulation.identified), *_tracking_figures(simulation)),
        numbers=_numbers(simulation.identified),
        errata=_errata(),
        claims=claims,
    )


# The stationary plants


def prior_regularised(u: Signal, y_m: Signal, y_per_m: float, p0: float = P0) -> Arx:
    """Least squares as the recursion has it after the last sample: theta = 0 with variance p0 is one more observation
    of each parameter."""
    theta = track(dataclasses.replace(PLAIN, p0=p0), u, y_m * y_per_m, y_per_m).theta[-1]
    a1, a2, b0, b1 = (float(x) for x in theta)
    return Arx(a1, a2, b0 / y_per_m, b1 / y_per_m)


def _identified() -> Arx:
    """Equ 4.5 as far as the text tells: one period, y in millimetres, data of the printed Equ 4.3."""
    u = square(100, -SHOCK_FORCE_N, SHOCK_FORCE_N)
    return prior_regularised(u, PRINTED_4_3.response(u), 1e3)


def _numbers(identified: Arx) -> tuple[Number, ...]:
    shock, front = Arx.of(SHOCK), Arx.of(FRONT)
    names = ("a1", "a2", "b0", "b1")
    zetas = zip(PRINTED_ZETA, PROFILE, strict=True)
    return (
        *(
            Number("Equ. 4.3", *each, note="B = 900")
            for each in zip(names, PRINTED_4_3.values, shock.values, strict=True)
        ),
        *(
            Number("Equ. 4.5", *each, note="P = 10 I, y in mm, 100 samples of the printed Equ. 4.3")
            for each in zip(names, PRINTED_4_5.values, identified.values, strict=True)
        ),
        *(Number("Equ. 4.8", *each) for each in zip(names, PRINTED_4_8.values, front.values, strict=True)),
        *(
            Number("Section 4.4.1", f"ζ from sample {segment.start}", printed, zeta(segment.plant))
            for printed, segment in zetas
        ),
        Number("Section 4.3", "force for a stroke of 12 cm", 1470.0, SHOCK.stiffness_n_per_m * 0.12, "N"),
        Number("Section 4.4.1", "stiffness of two shock absorbers", 24500.0, 2 * SHOCK.stiffness_n_per_m, "N/m"),
        Number("Section 4.4.1", "damping of two shock absorbers", 3021.0, 2 * SHOCK.damping_n_s_per_m, "N s/m"),
        Number("Section 4.4.3", "hold-off of four samples", 0.04, HOLD_N * PERIOD_S, "s"),
    )


def _errata() -> tuple[Erratum, ...]:
    shock, front = Arx.of(SHOCK), Arx.of(FRONT)
    damping = 2 * SHOCK_ZETA * math.sqrt(SHOCK.stiffness_n_per_m * SHOCK.mass_kg)
    simulated = Arx.of(dataclasses.replace(SHOCK, damping_n_s_per_m=damping))
    critical = 2 * 0.9 * math.sqrt(FRONT.stiffness_n_per_m * FRONT.mass_kg)
    return (
        Erratum(
            "Equ. 4.3, 4.4",
            "−0.8816, 0.0112, 0.8383e-5, 0.2197e-5",
            f"{shock.a1:.5f}, {shock.a2:.5f}, {shock.b0 * 1e5:.5f}e-5, {shock.b1 * 1e5:.5f}e-5, or B = {damping:.1f}",
            f"a2 is the product of the poles, exp(−BT/M): for B = 900 it is exp(−4.5) = {math.exp(-4.5):.5f},"
            f" whatever K, and not 0.0112. But ζ = {SHOCK_ZETA:g}, that is B = 2 ζ √(K M) = {damping:.1f}, gives"
            f" {_arx(simulated)}: every printed digit. A footnote says that the damping ratio was what had been asked"
            " for; so B = 900 is the rounded figure, and the difference equation is right.",
        ),
        Erratum(
            "Equ. 4.5",
            "the result of a batch least-squares estimator on noise-free data",
            "the result of a recursion with P = 10 I, y in millimetres",
            "Least squares has no error on exact data of the right model, whatever the input. With θ = 0, P = 10 I"
            f" and y in mm the recursion gives {_arx(_identified())} after one period of the printed Equ. 4.3: within"
            " 0.0005 of the printed figures, and within 0.0003 after 56 samples. From the exact model b0 would be"
            " 0.837.",
        ),
        Erratum(
            "Equ. 4.8",
            "(−0.3650e-5 z + 0.3984e-5) / (z² − 1.7503 z + 0.769)",
            f"({front.b0 * 1e6:.4f}e-6 z + {front.b1 * 1e6:.4f}e-6) / (z² − {-front.a1:.4f} z + {front.a2:.4f})",
            f"The static gain must be 1/24500. As printed it is 1/{1 / PRINTED_4_8.gain:.0f}; with both signs"
            f" positive, the order exchanged and 1e-6 it is 1/{1 / front.gain:.0f}.",
        ),
        Erratum(
            "Section 4.3, Fig. 4.1",
            "±1470 N, the force that fully compresses the shock absorber of 12 cm of stroke",
            "a swing of 1470 N",
            f"1470 / 12250 = {SHOCK_FORCE_N / SHOCK.stiffness_n_per_m * 1e3:.0f} mm to either side, 240 mm in all:"
            " twice the stroke. The linear model does not mind.",
        ),
        Erratum(
            "Section 4.4.1, table",
            "ζ = 1.04 and 0.69",
            "1.05 and 0.70",
            f"ζ = B / (2 √(K M)): 3021 / (2 √(18000 · 115)) = {zeta(PROFILE[1].plant):.4f},"
            f" 2123 / (2 √(20000 · 115)) = {zeta(PROFILE[3].plant):.4f}. The other three are right.",
        ),
        Erratum(
            "Section 4.4.1",
            "B and K “are calculated by simply summing the stiffness and damping contributions of each shock absorber”",
            "K is that sum, B is not",
            f"2 · 12250 = 24500, but 2 · 900 = 1800. 3021 is 2 · 0.9 · √(K M) = {critical:.0f}: chosen for ζ = 0.9.",
        ),
        Erratum(
            "Captions and references",
            "Fig. 4.4 “Tracking” using the ordinary R.L.S. estimator; “in Equ. 4.2 u is the system input”; “the"
            " simulated data given in Fig. 4.1 was utilised”; Fig. 4.7 “time-varying shock absorber”",
            "Fig. 4.5; Equ. 4.3; Fig. 4.3; the front suspension",
            "The text calls the figure 4.5 itself; Equ. 4.2 is the differential equation; the full front suspension"
            " is in Fig. 4.3; the profile of section 4.4.1 is that of the front suspension.",
        ),
    )


def _arx(model: Arx) -> str:
    return f"{model.a1:.4f}, {model.a2:.4f}, {model.b0 * 1e5:.4f}e-5, {model.b1 * 1e5:.4f}e-5"


def _stationary_figures(identified: Arx) -> tuple[Figure, ...]:
    u1, u2 = square(400, -SHOCK_FORCE_N, SHOCK_FORCE_N), square(400, -FRONT_FORCE_N, FRONT_FORCE_N)
    y2 = time_varying(u2, [Segment(0, FRONT)])
    scale = 5.0e3
    each = track(PLAIN, u2, y2 * scale, scale)
    return (
        Figure(
            "4.1",
            "Simulated suspension data.",
            _data(u1, time_varying(u1, [Segment(0, SHOCK)])),
            "One shock absorber, M = 2 kg, B = 900 N s/m, K = 12250 N/m; ±1470 N at 1 Hz, so that there is no DC"
            " level to remove.",
        ),
        Figure(
            "4.2",
            "Transfer Function (a) Actual System, (b) Estimated System.",
            _bode(Arx.of(SHOCK), identified),
            "Both systems in each plot. The estimated one is Equ. 4.5 as it comes out here: see the errata.",
        ),
        Figure(
            "4.3",
            "Simulated full front suspension data.",
            _data(u2, y2),
            "M = 115 kg, B = 3021 N s/m, K = 24500 N/m; ±2940 N at 1 Hz.",
        ),
        Figure(
            "4.4",
            "Parameter estimates using ordinary R.L.S.",
            _theta_panels(each.theta[:100], np.tile(Arx.of(FRONT).values, (100, 1)), scale),
            "The first 100 samples. y is in millimetres times the printed factor of 5; b is shown per metre.",
        ),
    )


def _data(u: Signal, y_m: Signal) -> tuple[Panel, ...]:
    return (
        Panel("Applied force", "F [N]", (Curve("force", u, "first", "step"),)),
        Panel("Displacement", "x [mm]", (Curve("displacement", y_m * 1e3, "second"),)),
    )


FREQUENCY_HZ = np.geomspace(0.05, 50.0, 241)


def _bode(actual: Arx, estimated: Arx) -> tuple[Panel, ...]:
    responses = [model.frequency_response(FREQUENCY_HZ) for model in (actual, estimated)]
    gains = [20.0 * np.log10(np.abs(each)) for each in responses]
    phases = [np.degrees(np.unwrap(np.angle(each))) for each in responses]

    def panel(title: str, label: str, values: Sequence[Signal]) -> Panel:
        curves = (Curve("actual", values[0], "truth"), Curve("estimated", values[1], "first", "dash"))
        return Panel(title, label, curves, FREQUENCY_HZ, "frequency [Hz]", log_x=True)

    return (
        panel("Magnitude", "|G| [dB re 1 m/N]", gains),
        panel("Phase", "phase [degrees]", phases),
    )


# The time-varying plant


def theta_truth(segments: Sequence[Segment], n: int) -> Signal:
    """(n, 4) a1, a2, b0, b1 of the plant, per metre and newton."""
    out = np.empty((n, 4))
    for segment in segments:
        out[segment.start :] = Arx.of(segment.plant).values
    return out


def _theta_panels(theta: Signal, known: Signal, y_per_m: float) -> tuple[Panel, ...]:
    """Estimates in the units of the data against the truth, per metre."""
    a = (
        Curve("a1 true", known[:, 0], "truth", "step"),
        Curve("a2 true", known[:, 1], "truth", "step"),
        Curve("a1", theta[:, 0], "first"),
        Curve("a2", theta[:, 1], "second"),
    )
    b = (
        Curve("b0 true", known[:, 2] * 1e6, "truth", "step"),
        Curve("b1 true", known[:, 3] * 1e6, "truth", "step"),
        Curve("b0", theta[:, 2] / y_per_m * 1e6, "first"),
        Curve("b1", theta[:, 3] / y_per_m * 1e6, "second"),
    )
    return (
        Panel("a parameters", "a", a, shown=(-2.2, 1.4)),
        Panel("b parameters", "b [1e-6 m/N]", b, shown=(-0.6, 2.0)),
    )


def _tracking_figures(simulation: Simulation) -> tuple[Figure, ...]:
    known = theta_truth(PROFILE, PROFILE_N)

    def estimates(number: str, title: str, key: str, text: str) -> Figure:
        each = simulation.tracks[key]
        panels = _theta_panels(each.theta, known, UNITS_PER_M)
        return Figure(number, title, panels, text, marks(each, PROFILE, CHANGE_LABELS))

    return (
        estimates(
            "4.5",
            "“Tracking” using the ordinary R.L.S. estimator.",
            "rls",
            "Printed as a second Fig. 4.4. The profile of section 4.4.1: K 24500 → 18000 at sample 200, B 3021 →"
            " 3453 at 400, B → 2123 and K → 20000 at 500, M 115 → 30 at 600.",
        ),
        estimates(
            "4.6",
            "Estimates using the prediction error tracking mechanism.",
            "prediction-error",
            f"Reset to θ = 0 and P = 10 I. Assumed: no alarm in the first 50 samples and in the {HOLD_N} after a"
            " reset. The alarms at 651, 701 and 751 are no misprint: after a reset at an edge of the force the two"
            " last inputs are the same until the next edge, so that only b0 + b1 can be learned, and the next edge"
            " is a surprise again.",
        ),
        *_trigger_figures(simulation),
        estimates(
            "4.10",
            "Parameter estimates using the mean between faults triggering function.",
            "mean-between-faults",
            "At an alarm P returns to 10 I and θ stays.",
        ),
    )


def _trigger_figures(simulation: Simulation) -> tuple[Figure, ...]:
    error = simulation.tracks["prediction-error"]
    mean = simulation.tracks["mean-between-faults"]
    since_start = mean_since_start(simulation)
    mean_label = "Mean prediction error since sample 50"
    return (
        Figure(
            "4.7",
            "The prediction error sequence for the time-varying shock absorber.",
            (_with_ceiling("Prediction error", "e [0.1 µm]", error.innovation, ERROR_CEILING, both=True),),
            "The printed ceiling is 1500 units. With resets as in Fig. 4.6, whose first errors go up to"
            f" {largest(error.innovation[60:]):,.0f} units.",
            marks(error, PROFILE, CHANGE_LABELS),
        ),
        Figure(
            "4.8",
            "The mean prediction error as an alternative triggering function ?",
            (_with_ceiling(mean_label, "|mean| [0.1 µm]", since_start.statistic, MEAN_CEILING),),
            "The running mean of the prediction errors of plain RLS since the start, the first 50 samples left out.",
            marks(since_start, PROFILE, CHANGE_LABELS),
        ),
        Figure(
            "4.9",
            "The mean between faults as a triggering function !",
            (_with_ceiling("Mean between faults", "|mean| [0.1 µm]", mean.statistic, MEAN_CEILING),),
            "The magnitude of the mean prediction error since the last alarm, held at zero for 4 samples after one"
            " and for the first 50 samples; the ceiling is the printed 300 units.",
            marks(mean, PROFILE, CHANGE_LABELS),
        ),
    )


def largest(values: Signal) -> float:
    return float(np.abs(values).max())


def mean_since_start(simulation: Simulation) -> Track:
    never = dataclasses.replace(
        PLAIN, trigger="mean-between-faults", ceiling=1e8, warm_up_n=WARM_UP_N, hold_off_n=HOLD_N
    )
    return track(never, simulation.u, simulation.y * UNITS_PER_M, UNITS_PER_M)


def _with_ceiling(title: str, label: str, values: Signal, ceiling: float, *, both: bool = False) -> Panel:
    flat = np.full(len(values), ceiling)
    curves = [Curve("trigger", values, "first"), Curve("ceiling", flat, "truth", "dash")]
    if both:
        curves.append(Curve("−ceiling", -flat, "truth", "dash"))
    return Panel(title, label, tuple(curves), shown=(-4.0 * ceiling if both else 0.0, 4.0 * ceiling))
