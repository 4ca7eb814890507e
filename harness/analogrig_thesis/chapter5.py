"""Chapter 5: the electrical analogue, Fig. 5.4 to 5.10."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from analogrig.devices.estimator_config import EstimatorConfig
from analogrig.run import Run
from analogrig_thesis.chapter4 import CHANGE_LABELS, UNITS_PER_M, WARM_UP_N, zeta
from analogrig_thesis.circuit import (
    BATCH,
    COMPARISON,
    CUTOFFS_HZ,
    IDENTIFICATION,
    INFERRED,
    LIVE,
    MEAN_CEILING,
    NOISY,
    QUANTISED,
    SEED,
    SKEWED,
    TRACKING,
    Recording,
    conditioned,
    conditioned_tracks,
    play,
    record,
    run_codes,
    track_codes,
)
from analogrig_thesis.document import Chapter, Claim, Curve, Erratum, Figure, Mark, Number, Panel, Signal
from analogrig_thesis.model import FRONT, SHOCK, Arx, time_varying
from analogrig_thesis.schemes import PLAIN, schemes
from analogrig_thesis.tracking import Track, marks, performance, track

PRINTED_5_4 = Arx(-1.5628, 0.0766, 0.1817e-5, 0.0766e-5)

RECORDED = ("fig-5.4", "fig-5.5", "fig-5.7-quantised", "fig-5.7")
"""Names of the recordings."""

FIRST_N = 1000
"""Section 5.4: "The first 1000 samples of this data were used"."""


@dataclasses.dataclass(frozen=True, eq=False)
class Circuit:
    """Everything that was played."""

    comparison: Run
    identification: Run
    quantised: Recording
    noisy: Recording

    @property
    def model(self) -> Model:
        """What batch least squares makes of the first samples."""
        return Model.of(self.identification)

    @property
    def recordings(self) -> dict[str, Run]:
        """By the names of their files."""
        runs = (self.comparison, self.identification, self.quantised.run, self.noisy.run)
        return dict(zip(RECORDED, runs, strict=True))


def play_circuit() -> Circuit:
    """Over the link, through the C estimator in a process of its own; deterministic.

    :raises DeviceError, LinkError, RigError: a run failed.
    """
    return Circuit(
        play(NOISY, COMPARISON, LIVE),
        play(SKEWED, IDENTIFICATION, BATCH),
        record(QUANTISED, TRACKING),
        record(NOISY, TRACKING),
    )


def chapter(circuit: Circuit, claims: tuple[Claim, ...]) -> Chapter:
    """All of it."""
    model = circuit.model
    return Chapter(
        5,
        "System implementation",
        "The circuit is the emulated analogue computer, 200 times as fast as the suspension: TL07x amplifiers with"
        " offsets within ±3 mV, a card of 12 bits at 20 kHz with 1 LSB of noise, which is 2.44 mV or 49 µm (rig"
        f" <code>{NOISY}</code>, seed {SEED}); <code>{QUANTISED}</code> has ideal amplifiers and no noise but that of"
        " the 12 bits. Every estimate was made by the C device in a process of its own, over a serial line, from"
        " codes. Codes have a zero of their own, so an offset d is estimated along with θ; it takes the place of the"
        " detrending of section 4.3, which nobody can do while the data still come.",
        figures=(*_circuit_figures(circuit, model), *_tracking_figures(circuit.noisy, circuit.quantised)),
        numbers=_numbers(circuit.identification, model),
        errata=_errata(model),
        claims=claims,
    )


# Identification


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """The batch estimate of a recording, in newtons and metres."""

    arx: Arx
    offset: float
    """In codes."""
    theta: Signal
    """(5,) in codes"""

    @classmethod
    def of(cls, run: Run, n: int = FIRST_N) -> Model:
        theta = run.theta[n - 1].astype(np.float64)
        return cls.of_theta(theta, run.conditions.channels["force"].lsb, run.conditions.channels["displacement"].lsb)

    @classmethod
    def of_theta(cls, theta: Signal, n_per_code: float, m_per_code: float) -> Model:
        a1, a2, b0, b1, d = (float(x) for x in theta)
        return cls(Arx(a1, a2, b0 * m_per_code / n_per_code, b1 * m_per_code / n_per_code), d, theta)

    def simulated(self, u: Signal, y: Signal, first: int) -> Signal:
        """The output from sample ``first`` on, from the two samples before it; codes."""
        a1, a2, b0, b1, d = (float(x) for x in self.theta)
        out = [float(y[first - 2]), float(y[first - 1])]
        for k in range(first, len(u)):
            out.append(-a1 * out[-1] - a2 * out[-2] + b0 * float(u[k - 1]) + b1 * float(u[k - 2]) + d)
        return np.array(out[2:])


def _numbers(run: Run, model: Model) -> tuple[Number, ...]:
    notes = ("", "printed: a copy of b1", "", "")
    names = ("a1", "a2", "b0", "b1")
    ours = zip(names, PRINTED_5_4.values, model.arx.values, notes, strict=True)
    period_s = 1.0 / run.conditions.sample_period_s
    return (
        *(Number("Equ. 5.4", name, printed, value, note=note) for name, printed, value, note in ours),
        Number("Section 5.3", "sampling at the circuit", 20000.0, period_s, "Hz"),
        Number("Section 5.3", "sampling at the suspension", 100.0, 1.0 / run.conditions.sample_period_problem_s, "Hz"),
        Number("Section 5.3", "time scale", 200.0, run.conditions.time_scale),
    )


def _errata(model: Model) -> tuple[Erratum, ...]:
    poles = ", ".join(f"{pole.real:.2f}" for pole in PRINTED_5_4.poles)
    a2 = (PRINTED_5_4.b0 + PRINTED_5_4.b1) * INFERRED.stiffness_n_per_m - 1.0 - PRINTED_5_4.a1
    return (
        Erratum(
            "Equ. 5.4",
            "a2 = 0.0766",
            f"about {a2:.2f}; {model.arx.a2:.3f} here",
            f"0.0766 is b1 once more. As printed the poles are {poles}: a simulation is a metre off after a dozen"
            f" samples. If the static gain is 1/24500, a2 = (b0 + b1) · 24500 − 1 − a1 = {a2:.3f}.",
        ),
        Erratum(
            "Section 5.3 against 5.4 and 5.5",
            "“a 1 Hz square wave (ie. 200 Hz to the analogue)”; “a 100Hz. (1 Hz. on actual suspension system) square"
            " wave”",
            "100 Hz at the circuit is 0.5 Hz at the suspension",
            "The circuit runs at 200 times the pace. Half a period has 50 samples at 200 Hz and 100 at 100 Hz;"
            " played here is what each section prints for the circuit.",
        ),
        Erratum(
            "Section 5.4",
            "the data are scaled to be “consistent with data from the system simulation of section 4.2”",
            "Equ. 5.4 is not the shock absorber of section 4.2",
            f"That has a1 = {Arx.of(SHOCK).a1:.3f}; the front suspension of section 4.4.1 has {Arx.of(FRONT).a1:.3f};"
            f" Equ. 5.4 has −1.5628. M = {INFERRED.mass_kg:g} kg, B = {INFERRED.damping_n_s_per_m:g} N s/m, K ="
            f" {INFERRED.stiffness_n_per_m:g} N/m (ζ = {zeta(INFERRED):.2f}) comes near it: an inference, see the"
            " claims.",
        ),
        Erratum(
            "Sections 5.1, 5.2",
            "two equations are Equ. 5.2",
            "numbers of their own",
            "i = C de/dt is one, M ẍ + B ẋ + K x = F the other.",
        ),
        Erratum(
            "Section 5.6",
            "“implemented in section 5.6”",
            "section 5.5",
            "5.6 is the section that says so; the algorithm is applied in 5.5.",
        ),
    )


def _circuit_figures(circuit: Circuit, model: Model) -> tuple[Figure, ...]:
    data = circuit.identification
    return (_comparison_figure(circuit.comparison), _scaling_figure(data), _prediction_figure(data, model))


def _comparison_figure(run: Run) -> Figure:
    force, analogue, simulated = run.channel("force"), run.channel("displacement") * 1e3, simulated_mm(run)
    both = (Curve("simulation", simulated, "truth"), Curve("analogue", analogue, "first", "dash"))
    difference = Curve("analogue − simulation", analogue - simulated, "second")
    return Figure(
        "5.4",
        "A comparison of the simulated system output and the electrical analogue output.",
        (
            Panel("Displacement", "x [mm]", both),
            Panel("Difference", "difference [mm]", (difference,)),
            Panel("Force", "F [N]", (Curve("force", force, "third", "step"),)),
        ),
        "The shock absorber of section 4.2, 200 Hz, 0 to 10 V; analogue: the emulated circuit through its card.",
    )


def _scaling_figure(data: Run) -> Figure:
    volts = {
        name: data.conditions.channels[name].volts(data.codes[:, i]) for i, name in enumerate(("force", "displacement"))
    }
    circuit = (Curve("input", volts["force"], "third", "step"), Curve("output", volts["displacement"], "first"))
    displacement = Curve("displacement", data.channel("displacement") * 1e3, "second")
    return Figure(
        "5.5",
        "(a) Circuit data, (b) scaled circuit/suspension data.",
        (
            Panel("(a) Circuit data", "volts", circuit),
            Panel("(b) Force", "F [N]", (Curve("force", data.channel("force"), "third", "step"),)),
            Panel("(b) Displacement", "x [mm]", (displacement,)),
        ),
        "100 Hz, 0 to 10 V, 2000 samples. Which plant was on the computer the text does not say; this is the one"
        f" inferred from Equ. 5.4, on the rig <code>{SKEWED}</code>.",
    )


def _prediction_figure(data: Run, model: Model) -> Figure:
    u, y, _, m_per_code = run_codes(data)
    zero = data.conditions.channels["displacement"].zero
    predicted = (model.simulated(u, y, FIRST_N) - zero) * m_per_code * 1e3
    actual = (y[FIRST_N:] - zero) * m_per_code * 1e3
    second = np.arange(FIRST_N, len(u), dtype=np.float64)
    both = (Curve("circuit", actual, "truth"), Curve("simulation of G(z)", predicted, "first", "dash"))
    difference = Curve("circuit − simulation", actual - predicted, "second")
    return Figure(
        "5.6",
        "Prediction properties of the estimated analogous transfer function.",
        (
            Panel("Second 1000 samples", "x [mm]", both, second),
            Panel("Difference", "difference [mm]", (difference,), second),
        ),
        "G(z) estimated from the first 1000 samples, simulated over the second 1000 from the force alone; only"
        " its first two values are the circuit's.",
    )


def simulated_mm(run: Run) -> Signal:
    """The exact plant under the same nominal force."""
    excitation = COMPARISON.excitation
    half_n = round(0.5 / (excitation.frequency_hz * run.conditions.sample_period_s))
    high = run.conditions.channels["force"].unit_per_v * excitation.high_v
    u = np.where(np.arange(run.samples) // half_n % 2 == 0, high, 0.0)
    return time_varying(u, run.conditions.segments[:1]) * 1e3


def rms(values: Signal) -> float:
    return float(np.sqrt(np.mean(values**2)))


def deviations(arx: Arx) -> dict[str, float]:
    """Of the three coefficients of Equ 5.4 that can be read, relative."""
    return {name: getattr(arx, name) / getattr(PRINTED_5_4, name) - 1.0 for name in ("a1", "b0", "b1")}


# Tracking


def _tracking_figures(recording: Recording, quantised: Recording) -> tuple[Figure, ...]:
    batch = batch_estimates(recording.run)
    m_per_code = recording.run.conditions.channels["displacement"].lsb
    ceiling = MEAN_CEILING / UNITS_PER_M / m_per_code
    return (
        _data_figure(recording),
        _estimates_figure(recording, batch, ceiling),
        _quantised_figure(quantised, ceiling),
        _default_figure(recording, batch),
        _ceilings_figure(recording),
        _conditioned_figure(recording, batch),
        _others_figure(recording, batch),
        _trigger_figure(recording, ceiling),
    )


def _changes_alone(recording: Recording) -> tuple[Mark, ...]:
    """Where the plant changed, without anybody's alarms."""
    track = recording.tracks["mean-between-faults"]
    return marks(dataclasses.replace(track, alarms=track.alarms[:0]), recording.segments, CHANGE_LABELS)


def _data_figure(recording: Recording) -> Figure:
    run = recording.run
    return Figure(
        "5.7",
        "Input/Output data from the time-varying electrical analogy.",
        (
            Panel("Input", "F [N]", (Curve("force", run.channel("force"), "third", "step"),)),
            Panel("Output", "x [mm]", (Curve("displacement", run.channel("displacement") * 1e3, "first"),)),
        ),
        "100 Hz, 0 to 10 V. Which pots were turned when, the text does not say: assumed are the four changes of"
        " section 4.4.1 at samples 200, 400, 600 and 800, each in the middle of a half period with the force on,"
        " and an input whose level stays (see claim 4.9-level).",
        _changes_alone(recording),
    )


def _estimates_figure(recording: Recording, batch: Signal, ceiling: float) -> Figure:
    mean = recording.tracks["mean-between-faults"]
    return Figure(
        "5.8",
        "Parameter estimates for the time-varying analogous system.",
        _estimate_panels(mean, batch, recording.run),
        f"Mean between faults with the printed ceiling of 500 units, {ceiling:.2f} LSB, off for the first 50"
        " samples. Orange: the batch estimates of the stretches between the changes, as in the thesis. b1 is"
        f" drawn 1e-6 lower, to make them distinguishable. At 1 LSB of noise the scheme raises {len(mean.alarms)}"
        " alarms and never settles; Fig. 5.8 B shows our default on the same samples.",
        marks(mean, recording.segments, CHANGE_LABELS),
    )


def _quantised_figure(quantised: Recording, ceiling: float) -> Figure:
    calm = quantised.tracks["mean-between-faults"]
    return Figure(
        "5.8 A",
        "The same without noise.",
        (
            *_estimate_panels(calm, batch_estimates(quantised.run), quantised.run),
            _statistic("Triggering sequence [LSB]", calm.statistic, ceiling),
        ),
        "Ideal amplifiers and no noise but that of the 12 bits, the same scheme and ceiling.",
        marks(calm, quantised.segments, CHANGE_LABELS),
    )


def _default_figure(recording: Recording, batch: Signal) -> Figure:
    ours = recording.tracks["cusum"]
    return Figure(
        "5.8 B",
        "The data of Fig. 5.8, our default trigger.",
        (
            *_estimate_panels(ours, batch, recording.run),
            _statistic("Trigger: cumulative sum", ours.statistic, float(np.log(1e5))),
        ),
        "The device as it is shipped: three b's and an offset, of which those of u(k−1) and u(k−2) are drawn;"
        " whitened equations; the ceiling is ln 100,000. After an alarm the b's, and with them M, B and K, are not"
        " told apart before the next edge of the force, 50 samples after each change.",
        marks(ours, recording.segments, CHANGE_LABELS),
    )


def _others_figure(recording: Recording, batch: Signal) -> Figure:
    tracks, run = recording.tracks, recording.run
    return Figure(
        "5.9",
        "Parameter estimates obtained using (a) forgetting factor, (b) Kalman filter.",
        (
            _b_panel("(a) λ = 0.97", tracks["forgetting"], batch, run),
            _b_panel("(b) R = identity matrix", tracks["random-walk"], batch, run),
        ),
        "Only the b parameters, as in the thesis; b1 is drawn 1e-6 lower. What R = I means depends on the units of"
        " u and y; here they are codes, as the device has them.",
        _changes_alone(recording),
    )


def _trigger_figure(recording: Recording, ceiling: float) -> Figure:
    run, mean = recording.run, recording.tracks["mean-between-faults"]
    displacement = run.channel("displacement") * 1e3
    predicted = displacement - mean.innovation * (run.conditions.channels["displacement"].lsb * 1e3)
    return Figure(
        "5.10",
        "(a) The triggering sequence (b) Actual and predicted analogous system output.",
        (
            _statistic("(a) Triggering sequence [LSB]", mean.statistic, ceiling),
            Panel(
                "(b) Actual and predicted output",
                "x [mm]",
                (Curve("actual", displacement, "truth"), Curve("predicted", predicted, "first", "dash")),
                shown=(-20.0, 190.0),
            ),
        ),
        "Of the run of Fig. 5.8; predicted one sample ahead.",
        marks(mean, recording.segments, CHANGE_LABELS),
    )


def _conditioned_figure(recording: Recording, batch: Signal) -> Figure:
    run = recording.run
    each = conditioned_tracks(run)["mean-of-magnitudes"]
    channels = run.conditions.channels
    to_codes = channels["force"].lsb / (channels["displacement"].lsb * UNITS_PER_M)
    in_codes = dataclasses.replace(each, theta=each.theta * [1.0, 1.0, to_codes, to_codes])
    return Figure(
        "5.8 D",
        "The data of Fig. 5.8, filtered and detrended off line.",
        (
            *_estimate_panels(in_codes, batch, run),
            _statistic("Triggering sequence: mean of magnitudes [0.1 µm]", each.statistic, MEAN_CEILING),
        ),
        "Conditioned as section 4.3 asks, which a live estimator cannot be: a Butterworth filter of order 2, assumed"
        f" at {CUTOFFS_HZ[0]:g} Hz, on force and displacement, their means removed, no offset estimated, 0.1 µm. Of"
        " the mean between faults the kinder reading, the mean of magnitudes, with the printed ceiling of 500 units.",
        marks(each, recording.segments, CHANGE_LABELS),
    )


def batch_estimates(run: Run) -> Signal:
    """(n, 4) a1, a2, b0, b1 [m/N]: the batch estimate of each stretch at all its samples."""
    u, y, n_per_code, m_per_code = run_codes(run)
    out = np.empty((run.samples, 4))
    for start, end, _ in run.segments:
        # The two samples before the first equation that has nothing but the new plant in it.
        theta = track(BATCH, u[start + 1 : end], y[start + 1 : end]).theta[-1]
        out[start:end] = Model.of_theta(theta, n_per_code, m_per_code).arx.values
    return out


def b_of(each: Track, run: Run) -> Signal:
    """(n, 2) b0, b1 in 1e-6 m/N: of the direct term, if there is one, nothing."""
    channels = run.conditions.channels
    columns = slice(3, 5) if each.theta.shape[1] == 6 else slice(2, 4)
    return np.asarray(each.theta[:, columns] * channels["displacement"].lsb / channels["force"].lsb * 1e6)


def _b_panel(title: str, each: Track, batch: Signal, run: Run) -> Panel:
    b = b_of(each, run)
    curves = (
        Curve("b0 batch", batch[:, 2] * 1e6, "truth", "step"),
        Curve("b1 batch − 1", batch[:, 3] * 1e6 - 1.0, "truth", "step"),
        Curve("b0", b[:, 0], "first"),
        Curve("b1 − 1", b[:, 1] - 1.0, "second"),
    )
    return Panel(title, "b [1e-6 m/N]", curves, shown=(-1.6, 2.2))


def _estimate_panels(each: Track, batch: Signal, run: Run) -> tuple[Panel, ...]:
    a = (
        Curve("a1 batch", batch[:, 0], "truth", "step"),
        Curve("a2 batch", batch[:, 1], "truth", "step"),
        Curve("a1", each.theta[:, 0], "first"),
        Curve("a2", each.theta[:, 1], "second"),
    )
    return (
        Panel("a parameters", "a", a, shown=(-2.2, 1.4)),
        _b_panel("b parameters", each, batch, run),
    )


def _statistic(title: str, values: Signal, ceiling: float) -> Panel:
    curves = (Curve("statistic", values, "first"), Curve("ceiling", np.full(len(values), ceiling), "truth", "dash"))
    return Panel(title, "statistic", curves, shown=(0.0, 4.0 * ceiling))


CEILINGS_LSB = np.geomspace(0.1, 100.0, 61)


def ceiling_sweep(recording: Recording, key: str, *, absolute: bool = False) -> list[tuple[int, int]]:
    """(missed, extra alarms) at each of CEILINGS_LSB, as the samples come."""
    samples = run_codes(recording.run)
    return [
        _alarms(track_codes(_swept(LIVE, key, ceiling, absolute=absolute), samples), recording)
        for ceiling in CEILINGS_LSB.tolist()
    ]


def conditioned_sweep(recording: Recording, key: str, *, absolute: bool = False) -> list[tuple[int, int]]:
    """As ``ceiling_sweep``, the data filtered and detrended off line as section 4.3 asks."""
    u, y = conditioned(recording.run)
    units = recording.run.conditions.channels["displacement"].lsb * UNITS_PER_M
    return [
        _alarms(track(_swept(PLAIN, key, ceiling * units, absolute=absolute), u, y, UNITS_PER_M), recording)
        for ceiling in CEILINGS_LSB.tolist()
    ]


def _swept(plain: EstimatorConfig, key: str, ceiling: float, *, absolute: bool) -> EstimatorConfig:
    config = {each.key: each for each in schemes(plain, ceiling, ceiling, WARM_UP_N)}[key].config
    return dataclasses.replace(config, absolute=absolute)


def _alarms(each: Track, recording: Recording) -> tuple[int, int]:
    judged = performance(each, recording.segments)
    return judged.missed, judged.extra_alarms


def _ceilings_figure(recording: Recording) -> Figure:
    kinds = (
        ("prediction error", "prediction-error", False),
        ("mean between faults", "mean-between-faults", False),
        ("mean of magnitudes", "mean-between-faults", True),
    )
    inks = ("first", "second", "third")

    def panels(title: str, sweep: Callable[..., list[tuple[int, int]]]) -> Iterator[Panel]:
        swept = {name: np.array(sweep(recording, key, absolute=absolute), float) for name, key, absolute in kinds}
        for column, (what, of) in enumerate((("Changes missed", "of 4"), ("Extra alarms", "in 1000 samples"))):
            curves = tuple(
                Curve(name, each[:, column], ink)  # type: ignore[arg-type]
                for (name, each), ink in zip(swept.items(), inks, strict=True)
            )
            yield Panel(f"{what}, {title}", of, curves, CEILINGS_LSB, "ceiling [LSB]", log_x=True)

    filtered = f"filtered at {CUTOFFS_HZ[0]:g} Hz and detrended"
    return Figure(
        "5.8 C",
        "Every ceiling on the same data.",
        (*panels("as they come", ceiling_sweep), *panels(filtered, conditioned_sweep)),
        "61 ceilings from 0.1 to 100 LSB on the samples of Fig. 5.7: low ones limit-cycle, since every reset of P"
        " makes the next errors larger; high ones miss. A ceiling that serves would have both curves at zero. Below,"
        " the same of data conditioned as section 4.3 asks, with the Butterworth filter of Fig. 5.8 D.",
    )
