"""Chapter 5: the electrical analogue, Fig. 5.4 to 5.10."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from analogrig.estimator_config import EstimatorConfig
from analogrig.plant import AT_REST, Plant, SampledPlant, Segment
from analogrig.run import Run
from analogrig_thesis.circuit_runs import (
    BATCH,
    COMPARISON,
    CUTOFFS_HZ,
    IDENTIFICATION,
    INFERRED,
    LIVE,
    MEAN_CEILING,
    NOISY,
    SEED,
    SKEWED,
    CircuitRuns,
    ScaledSamples,
    TrackedRun,
    filter_off_line,
    filtered_schemes,
)
from analogrig_thesis.document import Drawing, Facts, ReproducedChapter, Signal
from analogrig_thesis.plants import FRONT, PERIOD_S, PROFILE, SHOCK, Arx, damping_ratio, square, time_varying
from analogrig_thesis.schemes import PLAIN, UNITS_PER_M, WARM_UP_N, schemes
from analogrig_thesis.tracking import Track, assess, marks, reconverged, track

PRINTED_5_4 = Arx(-1.5628, 0.0766, 0.1817e-5, 0.0766e-5)

FIRST_N = 1000
"""Section 5.4: "The first 1000 samples of this data were used"."""

WARM_N = 100
"""Samples left out of the prediction error."""

SEEDS = range(20)

EARLY = 0.2
"""Lead of the force, in samples: 10 us at 20 kHz."""

CEILINGS_LSB = np.geomspace(0.1, 100.0, 61)

TRIGGERS = {
    "prediction error": ("prediction-error", False),
    "signed mean": ("mean-between-faults", False),
    "mean of magnitudes": ("mean-between-faults", True),
}
"""Key of the scheme, and True for magnitudes, by name of the trigger."""

Sweep = list[tuple[int, int]]
"""Missed changes and extra alarms at each of CEILINGS_LSB."""
Sweeps = Mapping[str, Mapping[str, Sweep]]
"""Sweeps by data and name of the trigger."""


def batch_theta(run: Run) -> Signal:
    """Batch estimate a1, a2, b0, b1, d (5,) of the device after the first 1000 samples, in codes."""
    return np.asarray(run.theta[FIRST_N - 1], np.float64)


def identify(run: Run) -> Arx:
    """Batch estimate of the first 1000 samples in newtons and metres."""
    return Arx.scaled(batch_theta(run), ScaledSamples.of_run(run).b_scale)


def simulate_from(first: int, theta: Signal, codes: ScaledSamples) -> Signal:
    """Output in codes from sample ``first`` on, begun with the two samples before it."""
    (a1, a2, b0, b1, d), u = theta.tolist(), codes.u.tolist()
    out = codes.y[first - 2 : first].tolist()
    for k in range(first, len(u)):
        out.append(-a1 * out[-1] - a2 * out[-2] + b0 * u[k - 1] + b1 * u[k - 2] + d)
    return np.array(out[2:])


def reproduce_chapter(circuit: CircuitRuns) -> ReproducedChapter:
    """Figures, printed numbers, errata and claims of chapter 5."""
    noisy, quantised = circuit.noisy, circuit.quantised
    sweeps = {
        "quantised": _sweep(quantised.codes, quantised.segments, LIVE, 1.0),
        "noisy": _sweep(noisy.codes, noisy.segments, LIVE, 1.0),
        "conditioned": _sweep(filter_off_line(noisy.run), noisy.segments, PLAIN, noisy.codes.m_per_unit * UNITS_PER_M),
    }
    measured = {**_measure_identification(circuit), **_measure_tracking(circuit, sweeps)}
    return ReproducedChapter.load(5, _facts(circuit, sweeps, measured), _drawings(circuit, sweeps), measured)


def _facts(circuit: CircuitRuns, sweeps: Sweeps, measured: Mapping[str, Facts]) -> dict[str, Any]:
    """Values for the texts beside those behind the claims."""
    conditions, estimate = circuit.identification.conditions, identify(circuit.identification)
    unskewed, variances = Arx.of(INFERRED), measured["5.4-variance"]["variances"]
    spread = measured["5.9-forgetting"]["spread_of_b_1e-6_m_per_N"]["noisy"]
    return {
        "estimate": estimate,
        "shock": Arx.of(SHOCK),
        "front": Arx.of(FRONT),
        "rate_hz": 1.0 / conditions.sample_period_s,
        "problem_rate_hz": 1.0 / conditions.sample_period_problem_s,
        "time_scale": conditions.time_scale,
        "printed_poles": PRINTED_5_4.poles,
        "a2_from_gain": (PRINTED_5_4.b0 + PRINTED_5_4.b1) * INFERRED.stiffness_n_per_m - 1.0 - PRINTED_5_4.a1,
        "inferred": INFERRED,
        "inferred_zeta": damping_ratio(INFERRED),
        "moved_by_skew": [estimate.b0 / unskewed.b0 - 1.0, estimate.b1 / unskewed.b1 - 1.0],
        "moved_by_deviations": abs(estimate.b0 - unskewed.b0) * 1e5 / np.sqrt(variances[2]),
        "ceiling_lsb": MEAN_CEILING / UNITS_PER_M / circuit.noisy.codes.m_per_unit,
        "mean_alarms": len(circuit.noisy.tracks["mean-between-faults"].alarms),
        "best": {data: {name: _best(each) for name, each in by_name.items()} for data, by_name in sweeps.items()},
        "walk_over_forgetting": spread["random-walk"] / spread["forgetting"],
    }


def _rms(values: Signal) -> float:
    return float(np.sqrt(np.mean(values**2)))


# Figures


def _drawings(circuit: CircuitRuns, sweeps: Sweeps) -> dict[str, Drawing]:
    noisy, quantised, run = circuit.noisy, circuit.quantised, circuit.noisy.run
    ceiling, batch = MEAN_CEILING / UNITS_PER_M / noisy.codes.m_per_unit, batch_estimates(run)
    estimates = {key: _estimate_panels(_in_si(each, noisy.codes.b_scale), batch) for key, each in noisy.tracks.items()}
    mean, ours = noisy.tracks["mean-between-faults"], noisy.tracks["cusum"]
    calm = quantised.tracks["mean-between-faults"]
    calm_estimates = _estimate_panels(_in_si(calm, quantised.codes.b_scale), batch_estimates(quantised.run))
    changes, alarms = (marks(mean, noisy.segments, with_alarms=each) for each in (False, True))
    output_mm = run.channel("displacement") * 1e3
    predicted_mm = output_mm - mean.innovation * noisy.codes.m_per_unit * 1e3
    counts = [np.array(each, float).T for data in ("noisy", "conditioned") for each in sweeps[data].values()]
    return {
        "5.4": _comparison(circuit.comparison),
        "5.5": _scaling(circuit.identification),
        "5.6": _simulation_over_second_half(circuit.identification),
        "5.7": Drawing([[run.channel("force")], [output_mm]], changes),
        "5.8": Drawing(estimates["mean-between-faults"], alarms),
        "5.8 A": Drawing([*calm_estimates, _statistic(calm, ceiling)], marks(calm, quantised.segments)),
        "5.8 B": Drawing([*estimates["cusum"], _statistic(ours, float(np.log(1e5)))], marks(ours, noisy.segments)),
        "5.8 C": Drawing(
            [[each[row] for each in counts[first : first + 3]] for first in (0, 3) for row in (0, 1)], x=CEILINGS_LSB
        ),
        "5.8 D": _off_line(noisy, batch),
        "5.9": Drawing([estimates[key][1] for key in ("forgetting", "random-walk")], changes),
        "5.10": Drawing([_statistic(mean, ceiling), [output_mm, predicted_mm]], alarms),
    }


def _comparison(run: Run) -> Drawing:
    analogue, simulated = run.channel("displacement") * 1e3, _simulated_mm(run)
    return Drawing([[simulated, analogue], [analogue - simulated], [run.channel("force")]])


def _simulated_mm(run: Run) -> Signal:
    """Displacement of the exact plant under the same nominal force."""
    excitation = COMPARISON.excitation
    half_n = round(0.5 / (excitation.frequency_hz * run.conditions.sample_period_s))
    high = run.conditions.channels["force"].unit_per_v * excitation.high_v
    u = np.where(np.arange(run.samples) // half_n % 2 == 0, high, 0.0)
    return time_varying(u, run.conditions.segments[:1]) * 1e3


def _scaling(run: Run) -> Drawing:
    channels = run.conditions.channels
    volts = [channels[name].volts(run.codes[:, i]) for i, name in enumerate(("force", "displacement"))]
    return Drawing([volts, [run.channel("force")], [run.channel("displacement") * 1e3]])


def _simulation_over_second_half(run: Run) -> Drawing:
    codes, zero = ScaledSamples.of_run(run), run.conditions.channels["displacement"].zero
    predicted, actual = (
        (each - zero) * codes.m_per_unit * 1e3
        for each in (simulate_from(FIRST_N, batch_theta(run), codes), codes.y[FIRST_N:])
    )
    samples = np.arange(FIRST_N, len(codes.u), dtype=np.float64)
    return Drawing([[actual, predicted], [actual - predicted]], x=samples)


def _off_line(tracked: TrackedRun, batch: Signal) -> Drawing:
    each = filtered_schemes(tracked.run)["mean-of-magnitudes"]
    panels = [*_estimate_panels(_in_si(each, 1.0 / UNITS_PER_M), batch), _statistic(each, MEAN_CEILING)]
    return Drawing(panels, marks(each, tracked.segments))


def _in_si(each: Track, b_scale: float) -> Signal:
    """Estimates a1, a2, b0, b1 (n, 4), the b's times ``b_scale``, without a direct term."""
    columns = [0, 1, 3, 4] if each.theta.shape[1] == 6 else [0, 1, 2, 3]
    return np.asarray(each.theta[:, columns] * [1.0, 1.0, b_scale, b_scale])


def _estimate_panels(estimates: Signal, batch: Signal) -> list[list[Signal]]:
    """Batch estimates and estimates of the a's, and of the b's in 1e-6 m/N with b1 lowered by 1."""
    known, found = (each * [1.0, 1.0, 1e6, 1e6] - [0.0, 0.0, 0.0, 1.0] for each in (batch, estimates))
    return [[*known[:, columns].T, *found[:, columns].T] for columns in (slice(0, 2), slice(2, 4))]


def _statistic(each: Track, ceiling: float) -> list[Signal]:
    return [each.statistic, np.full(len(each.statistic), ceiling)]


def batch_estimates(run: Run) -> Signal:
    """Batch estimate a1, a2, b0, b1 (n, 4) [m/N] of the stretch that each sample belongs to."""
    codes, out = ScaledSamples.of_run(run), np.empty((run.samples, 4))
    for start, end, _ in run.segments:
        # The first equation with nothing but the new plant in it begins two samples later.
        theta = track(BATCH, codes.u[start + 1 : end], codes.y[start + 1 : end]).theta[-1]
        out[start:end] = Arx.scaled(theta, codes.b_scale).values
    return out


# Ceilings


def _sweep(
    samples: ScaledSamples, segments: Sequence[Segment], plain: EstimatorConfig, unit: float
) -> dict[str, Sweep]:
    """Sweep of each trigger, by its name; ``unit`` is the least significant bit in units of the samples."""
    out: dict[str, Sweep] = {}
    for name, (key, absolute) in TRIGGERS.items():
        configs = (schemes(plain, each * unit, each * unit, WARM_UP_N)[key] for each in CEILINGS_LSB.tolist())
        tracks = (samples.track(dataclasses.replace(config, absolute=absolute)) for config in configs)
        out[name] = [(each.missed, each.extra_alarms) for each in (assess(track, segments) for track in tracks)]
    return out


def _best(sweep: Sweep) -> dict[str, float]:
    """Ceiling with the fewest missed changes, and among those with the fewest extra alarms."""
    i = min(range(len(sweep)), key=lambda j: sweep[j])
    return {"ceiling_lsb": float(CEILINGS_LSB[i]), "missed": sweep[i][0], "extra_alarms": sweep[i][1]}


# Claims about the identification


def _measure_identification(circuit: CircuitRuns) -> dict[str, Facts]:
    """Values behind the claims of sections 5.3 and 5.4, by identifier."""
    run, codes = circuit.comparison, ScaledSamples.of_run(circuit.identification)
    rms_mm = _rms(run.channel("displacement") * 1e3 - _simulated_mm(run))
    simulated = simulate_from(FIRST_N, batch_theta(circuit.identification), codes)
    residual, span = _rms(codes.y[FIRST_N:] - simulated), float(np.ptp(codes.y))
    force = (codes.u[:100] - codes.u.min()) * 2940.0 / float(np.ptp(codes.u))
    return {
        "5.3-parity": {
            "difference_rms_mm": rms_mm,
            "difference_rms_lsb": rms_mm / (run.conditions.channels["displacement"].lsb * 1e3),
        },
        "5.4-skew": _deviations_by_reading(circuit),
        "5.4-variance": {"variances": _variances_of_batch(circuit), "printed_limit": 0.1},
        "5.6-agreement": {
            "rms_mm": residual * codes.m_per_unit * 1e3,
            "of_span": residual / span,
            "as_printed_1_m_after_n": int(np.flatnonzero(np.abs(PRINTED_5_4.response(force)) > 1.0)[0]),
        },
    }


def _deviations_by_reading(circuit: CircuitRuns) -> Facts:
    many = np.array([list(_deviations(_identify_on_card(SKEWED, INFERRED, seed)).values()) for seed in SEEDS])
    return {
        "deviations": _deviations(identify(circuit.identification)),
        "seeds_within_3_percent": int((np.abs(many) <= 0.03).all(axis=1).sum()),
        "seeds": len(SEEDS),
        "mean_deviations": many.mean(axis=0).tolist(),
        "deviations_with_an_early_edge": _deviations(_identify_with_early_edge()),
        "deviations_of_other_readings": {
            "the inferred plant without the skew": _deviations(_identify_on_card(NOISY, INFERRED, SEED)),
            "shock absorber of section 4.2": _deviations(Arx.of(SHOCK)),
            "front suspension of section 4.4.1": _deviations(Arx.of(FRONT)),
            "the last plant of section 4.4.1 (M = 30)": _deviations(Arx.of(PROFILE[-1].plant)),
        },
    }


def _deviations(arx: Arx) -> dict[str, float]:
    """Relative deviations from the three legible coefficients of Equ 5.4."""
    return {name: getattr(arx, name) / getattr(PRINTED_5_4, name) - 1.0 for name in ("a1", "b0", "b1")}


def _identify_on_card(rig: str, plant: Plant, seed: int) -> Arx:
    """Batch estimate of the first 1000 samples, in this process."""
    choice = dataclasses.replace(IDENTIFICATION.plant, **vars(plant))
    scenario = dataclasses.replace(IDENTIFICATION, samples=FIRST_N, plant=choice)
    codes = ScaledSamples.play(rig, scenario, seed)
    return Arx.scaled(codes.track(BATCH).theta[-1], codes.b_scale)


def _identify_with_early_edge() -> Arx:
    """Batch estimate if both channels are sampled at once and each edge of the force comes 10 us before."""
    u, y, state = (square(FIRST_N, 1470.0, 200) + 1470.0), np.empty(FIRST_N), AT_REST
    before, after = (SampledPlant.from_plant(INFERRED, part * PERIOD_S) for part in (1.0 - EARLY, EARLY))
    for k in range(FIRST_N):
        state = after.next(before.next(state, float(u[k - 1]) if k else 0.0), float(u[k]))
        y[k] = state[0]
    y_per_m = 1e5
    theta = np.linalg.lstsq(_equations(u, y * y_per_m), y[2:] * y_per_m, rcond=None)[0]
    return Arx.scaled(theta, 1.0 / y_per_m)


def _equations(u: Signal, y: Signal) -> Signal:
    """Regressors (n - 2, 5) of a1, a2, b0, b1, d."""
    return np.stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2], np.ones(len(u) - 2)], axis=1)


def _variances_of_batch(circuit: CircuitRuns) -> list[float]:
    """Variances s^2 (Phi' Phi)^-1 of a1, a2, b0, b1, the last two in 1e-5 m/N."""
    codes, theta = ScaledSamples.of_run(circuit.identification), batch_theta(circuit.identification)
    phi = _equations(codes.u[:FIRST_N], codes.y[:FIRST_N])
    residual = codes.y[2:FIRST_N] - phi @ theta
    covariance = float(residual @ residual) / (len(residual) - phi.shape[1]) * np.linalg.inv(phi.T @ phi)
    to_si = codes.b_scale * 1e5
    variances: list[float] = (np.diag(covariance)[:4] * [1.0, 1.0, to_si**2, to_si**2]).tolist()
    return variances


# Claims about the tracking


def _measure_tracking(circuit: CircuitRuns, sweeps: Sweeps) -> dict[str, Facts]:
    """Values behind the claims of sections 5.5 and 5.6, by identifier."""
    noisy, quantised = circuit.noisy, circuit.quantised
    spread = {
        name: {key: _b_spread(tracked, key) for key in tracked.tracks}
        for name, tracked in (("noisy", noisy), ("quantised", quantised))
    }
    return {
        "5.5-tracking": _alarms_and_convergence(circuit, sweeps),
        "5.9-forgetting": {"spread_of_b_1e-6_m_per_N": spread},
        "5.9-kalman": {
            "reconverged_n": noisy.qualities["random-walk"].reconverged_n,
            "spread_of_b_1e-6_m_per_N": spread["noisy"]["random-walk"],
        },
        "5.10-prediction": {"rms_lsb": {key: _rms(each.innovation[WARM_N:]) for key, each in noisy.tracks.items()}},
        "5.10-spiking": {
            "spikes": {key: each.spikes for key, each in noisy.qualities.items()},
            "spikes_quantised": {key: each.spikes for key, each in quantised.qualities.items()},
            "undefined": {key: each.undefined for key, each in noisy.qualities.items()},
        },
    }


def _alarms_and_convergence(circuit: CircuitRuns, sweeps: Sweeps) -> Facts:
    noisy, quantised = circuit.noisy, circuit.quantised
    off_line = {
        f"{hz:g} Hz": {
            key: dataclasses.asdict(assess(each, noisy.segments))
            for key, each in filtered_schemes(noisy.run, hz).items()
        }
        for hz in CUTOFFS_HZ
    }
    return {
        "mean_between_faults": dataclasses.asdict(noisy.qualities["mean-between-faults"]),
        "mean_between_faults_12_bits_without_noise": dataclasses.asdict(quantised.qualities["mean-between-faults"]),
        "forgetting": dataclasses.asdict(noisy.qualities["forgetting"]),
        "default": dataclasses.asdict(noisy.qualities["cusum"]),
        "filtered_live_order_2_quantised_mean_0.2_lsb": _filtered(quantised, 2, "mean-between-faults", 0.2),
        "filtered_live_order_4_noisy_prediction_error_2_lsb": _filtered(noisy, 4, "prediction-error", 2.0),
        "filtered_and_detrended_off_line": off_line,
        "theta_reconverged_n": {key: _theta_reconverged(noisy, key) for key in ("forgetting", "mean-between-faults")},
        "best_ceilings": {
            f"{data} {key} {'|e|' if absolute else 'e'}": _best(by_trigger[name])
            for data, by_trigger in sweeps.items()
            for name, (key, absolute) in TRIGGERS.items()
        },
    }


def _filtered(tracked: TrackedRun, order: int, key: str, ceiling_lsb: float) -> dict[str, Any]:
    """Quality of a scheme on data from a causal filter, as in a live estimator."""
    config = schemes(LIVE, ceiling_lsb, ceiling_lsb, WARM_UP_N)[key]
    return dataclasses.asdict(assess(tracked.codes.filtered(order).track(config), tracked.segments))


def _theta_reconverged(tracked: TrackedRun, key: str) -> list[int | None]:
    """Samples from each change until a1, a2, b0, b1 stay within 5 % of the batch estimates of the stretches."""
    estimates = _in_si(tracked.tracks[key], tracked.codes.b_scale)
    return reconverged(estimates / batch_estimates(tracked.run) - 1.0, tracked.segments)


def _b_spread(tracked: TrackedRun, key: str) -> float:
    """Pooled standard deviation of b0 and b1 in the second halves of the stretches, 1e-6 m/N."""
    b = _in_si(tracked.tracks[key], tracked.codes.b_scale)[:, 2:] * 1e6
    late = [b[(start + end) // 2 : end] for start, end, _ in tracked.run.segments]
    return float(np.sqrt(np.mean([each.var(axis=0) for each in late])))
