"""Chapter 4: the simulated suspension, Fig. 4.1 to 4.10."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from analogrig.devices.reference import ReferenceEstimator
from analogrig.estimator_config import EstimatorConfig
from analogrig.plant import Plant, Segment
from analogrig_thesis.document import Drawing, Facts, ReproducedChapter, Signal
from analogrig_thesis.plants import (
    FRONT,
    PERIOD_S,
    PROFILE,
    PROFILE_N,
    SHOCK,
    Arx,
    coefficients,
    damping_ratio,
    jumps_in_the_coefficients,
    square,
    stretches,
    time_varying,
)
from analogrig_thesis.schemes import ERROR_CEILING, HOLD_N, P0, PLAIN, UNITS_PER_M, WARM_UP_N, schemes
from analogrig_thesis.tracking import (
    Track,
    TrackQuality,
    assess,
    marks,
    reconverged,
    relative_errors,
    settling_n,
    track,
)

SHOCK_FORCE_N, FRONT_FORCE_N = 1470.0, 2940.0
"""Section 4.3: 12 cm of stroke against 12.25 kN/m; section 4.4.1: twice that."""

SCALES = {"m": 1.0, "m × 5": 5.0, "mm": 1e3, "mm × 5": 5e3, "m × 10⁵": 1e5, "µm": 1e6, "µm × 5": 5e6, "0.1 µm": 1e7}
"""Candidate units of y, to the metre, by name."""
SCALES_OF_FRONT = ("m", "m × 5", "mm", "mm × 5", "m × 10⁵", "0.1 µm")
SCALES_OF_CEILING = ("m × 5", "mm × 5", "m × 10⁵", "µm", "µm × 5", "0.1 µm")

MEAN_CEILING = 300.0
"""Section 4.4.3, in units of 0.1 um."""
CEILINGS = {"prediction-error": ERROR_CEILING, "mean-between-faults": MEAN_CEILING}

PRINTED_4_3 = Arx(-0.8816, 0.0112, 0.8383e-5, 0.2197e-5)
PRINTED_4_8 = Arx(-1.7503, 0.769, -0.3650e-5, 0.3984e-5)
SHOCK_ZETA = 2.87
"""Damping ratio that gives all eight printed figures of Equ 4.3; B = 900 has 2.875."""

FREQUENCY_HZ = np.geomspace(0.05, 50.0, 241)

OUTLIER_AT = (60, 100, 150)
"""Sample indices of single outliers. After 50 samples of warm-up the mean covers 10, 50 and 100 errors."""
NOISE_UNITS = (0.0, 100.0, 300.0)
NOISE_SEEDS = range(5)

SCHEMES = schemes(PLAIN, ERROR_CEILING, MEAN_CEILING, WARM_UP_N)

ENDS = [end - 1 for _, end in stretches(PROFILE, PROFILE_N)]
"""Last samples of the stretches."""


@dataclasses.dataclass(frozen=True, eq=False)
class Simulation:
    """Time-varying front suspension without noise, and the estimates of the thesis's five schemes."""

    u: Signal
    y: Signal
    """metres"""
    identified: Arx
    """Equ. 4.5, reproduced."""
    tracks: Mapping[str, Track]
    qualities: Mapping[str, TrackQuality]

    @cached_property
    def since_start(self) -> Track:
        """Mean prediction error of plain RLS since sample 50, without a trigger."""
        return self.track(_scheme("mean-between-faults", 1e8))

    def track(self, config: EstimatorConfig, scale: float = UNITS_PER_M) -> Track:
        """Run another estimator on the same data, ``scale`` units of y to the metre."""
        return _track(config, self.u, self.y, scale)


def simulate() -> Simulation:
    """Simulate the profile and run the five schemes; deterministic."""
    u = square(PROFILE_N, FRONT_FORCE_N)
    y = time_varying(u)
    tracks = {key: _track(config, u, y) for key, config in SCHEMES.items()}
    # Equ. 4.5: one period, y in millimetres, data of the printed Equ. 4.3.
    one_period = square(100, SHOCK_FORCE_N)
    identified = least_squares_with_prior(one_period, PRINTED_4_3.response(one_period))
    return Simulation(u, y, identified, tracks, {key: assess(each, PROFILE) for key, each in tracks.items()})


def simulated_data(simulation: Simulation) -> dict[str, Signal]:
    """Force [N] and displacement [m] by figure."""
    shock, front = square(400, SHOCK_FORCE_N), square(400, FRONT_FORCE_N)
    return {
        "fig-4.1-u": shock,
        "fig-4.1-y": time_varying(shock, [Segment(0, SHOCK)]),
        "fig-4.3-u": front,
        "fig-4.3-y": time_varying(front, [Segment(0, FRONT)]),
        "fig-4.5-u": simulation.u,
        "fig-4.5-y": simulation.y,
    }


def reproduce_chapter(simulation: Simulation) -> ReproducedChapter:
    """Figures, printed numbers, errata and claims of chapter 4."""
    measured = {**_measure_stationary(simulation), **_measure_tracking(simulation), **_measure_mean(simulation)}
    return ReproducedChapter.load(4, _facts(simulation, measured), _drawings(simulation), measured)


def _facts(simulation: Simulation, measured: Mapping[str, Facts]) -> dict[str, Any]:
    """Values for the texts beside those behind the claims."""
    bias, second = measured["4.5-biased"], measured["4.9-sample-rate"]
    shock, front = Arx.of(SHOCK), Arx.of(FRONT)
    damping = 2 * SHOCK_ZETA * math.sqrt(SHOCK.stiffness_n_per_m * SHOCK.mass_kg)
    return {
        "identified": simulation.identified,
        "quality": simulation.qualities,
        "shock": shock,
        "front": front,
        "shock_damping": damping,
        "shock_by_zeta": Arx.of(dataclasses.replace(SHOCK, damping_n_s_per_m=damping)),
        "compliances": [1.0 / PRINTED_4_8.gain, 1.0 / front.gain],
        "zeta": [damping_ratio(segment.plant) for segment in PROFILE],
        "critical": 2 * 0.9 * math.sqrt(FRONT.stiffness_n_per_m * FRONT.mass_kg),
        "stroke_force": SHOCK.stiffness_n_per_m * 0.12,
        "two_stiffnesses": 2 * SHOCK.stiffness_n_per_m,
        "two_dampings": 2 * SHOCK.damping_n_s_per_m,
        "hold_s": HOLD_N * PERIOD_S,
        "largest_bias": _largest(np.array(bias["relative_errors_of_M_B_K_at_the_ends"][1:])),
        "second_alarm_list": list(second["second_alarm_after_n"].values()),
        "least_distance_n": _least(second["second_alarm_after_n"]),
        "least_distance_at_200_hz_n": _least(second["at_200_hz_with_a_quarter_of_the_ceiling"]),
        "plain_outliers": measured["4.4-outliers"],
        "largest_error_in_fig_4_7": _largest(simulation.tracks["prediction-error"].innovation[60:]),
    }


def least_squares_with_prior(u: Signal, y_m: Signal, p0: float = P0) -> Arx:
    """Least-squares estimate with the prior theta = 0 of variance p0, y in millimetres."""
    return Arx.scaled(_track(dataclasses.replace(PLAIN, p0=p0), u, y_m, 1e3).theta[-1], 1e-3)


def _track(config: EstimatorConfig, u: Signal, y_m: Signal, scale: float = UNITS_PER_M) -> Track:
    """Run an estimator over displacements in metres times ``scale``."""
    return track(config, u, y_m * scale, 1.0 / scale)


def _scheme(key: str, ceiling: float, **changes: Any) -> EstimatorConfig:
    return dataclasses.replace(schemes(PLAIN, ceiling, ceiling, WARM_UP_N)[key], **changes)


def _largest(values: Signal) -> float:
    return float(np.abs(values).max())


# Figures


def _drawings(simulation: Simulation) -> dict[str, Drawing]:
    data = simulated_data(simulation)
    tracks, since_start = simulation.tracks, simulation.since_start
    still = _track(PLAIN, data["fig-4.3-u"], data["fig-4.3-y"], SCALES["mm × 5"])
    known = coefficients(PROFILE, PROFILE_N)
    error, mean = tracks["prediction-error"], tracks["mean-between-faults"]

    def watched(each: Track, *panel: Signal) -> Drawing:
        return Drawing([panel], marks(each, PROFILE))

    drawings = {
        "4.1": Drawing([[data["fig-4.1-u"]], [data["fig-4.1-y"] * 1e3]]),
        "4.2": _bode(Arx.of(SHOCK), simulation.identified),
        "4.3": Drawing([[data["fig-4.3-u"]], [data["fig-4.3-y"] * 1e3]]),
        "4.4": Drawing(_theta_panels(still.theta[:100], coefficients([Segment(0, FRONT)], 100), SCALES["mm × 5"])),
        "4.7": watched(error, error.innovation, _flat(ERROR_CEILING), _flat(-ERROR_CEILING)),
        "4.8": watched(since_start, since_start.statistic, _flat(MEAN_CEILING)),
        "4.9": watched(mean, mean.statistic, _flat(MEAN_CEILING)),
    }
    for number, key in (("4.5", "rls"), ("4.6", "prediction-error"), ("4.10", "mean-between-faults")):
        panels = _theta_panels(tracks[key].theta, known, UNITS_PER_M)
        drawings[number] = Drawing(panels, marks(tracks[key], PROFILE))
    return drawings


def _flat(ceiling: float) -> Signal:
    return np.full(PROFILE_N, ceiling)


def _bode(*models: Arx) -> Drawing:
    responses = [model.frequency_response(FREQUENCY_HZ) for model in models]
    gains = [20.0 * np.log10(np.abs(each)) for each in responses]
    phases = [np.degrees(np.unwrap(np.angle(each))) for each in responses]
    return Drawing([gains, phases], x=FREQUENCY_HZ)


def _theta_panels(theta: Signal, known: Signal, scale: float) -> list[list[Signal]]:
    """Truth and estimates of the a's, and of the b's in 1e-6 m/N."""
    a, b = slice(0, 2), slice(2, 4)
    return [[*known[:, a].T, *theta[:, a].T], [*known[:, b].T * 1e6, *theta[:, b].T / scale * 1e6]]


# Claims about the stationary plants


def _measure_stationary(simulation: Simulation) -> dict[str, Facts]:
    """Values behind the claims of sections 4.3 and 4.4.1, by identifier."""
    force = square(400, SHOCK_FORCE_N)
    vague = least_squares_with_prior(force, time_varying(force, [Segment(0, SHOCK)]), 1e6)
    bandwidth_hz, error = _bandwidth_hz(SHOCK), _largest(np.array(vague.values) / Arx.of(SHOCK).values - 1.0)
    models = (Arx.of(SHOCK), simulation.identified)
    gains = [20 * np.log10(np.abs(each.frequency_response(FREQUENCY_HZ))) for each in models]
    u, steady = square(400, FRONT_FORCE_N), [Segment(0, FRONT)]
    tracks = {name: _track(PLAIN, u, time_varying(u, steady), SCALES[name]) for name in SCALES_OF_FRONT}
    errors = {name: relative_errors(each, FRONT) for name, each in tracks.items()}
    theta = {name: _errors_of_theta(each, SCALES[name], steady) for name, each in tracks.items()}
    return {
        "4.3-excitation": {"bandwidth_hz": bandwidth_hz, "criterion_hz": 0.16 * bandwidth_hz, "largest_error": error},
        "4.3-batch": {
            "largest_difference_db": _largest(gains[0] - gains[1]),
            "error_of_least_squares": error,
            "estimated": simulation.identified.values,
        },
        "4.4-30-samples": {
            "within_5_percent_after_n": {name: settling_n(each) for name, each in errors.items()},
            "theta_within_5_percent_after_n": {name: settling_n(each) for name, each in theta.items()},
            "largest_error": _largest(errors["mm × 5"][-1]),
        },
    }


def _bandwidth_hz(plant: Plant) -> float:
    """Frequency at which the gain of the continuous plant has fallen by 3 dB."""
    frequency_hz = np.geomspace(1e-2, 1e3, 200001)
    s = 2j * math.pi * frequency_hz
    gain = np.abs(1.0 / (plant.mass_kg * s * s + plant.damping_n_s_per_m * s + plant.stiffness_n_per_m))
    return float(frequency_hz[np.argmax(gain < gain[0] / math.sqrt(2.0))])


# Claims about the time-varying plant


def _measure_tracking(simulation: Simulation) -> dict[str, Facts]:
    """Values behind the claims about plain RLS and the prediction error, by identifier."""
    key, error = "prediction-error", simulation.qualities["prediction-error"]
    truth = np.array([list(segment.plant.parameters().values()) for segment in PROFILE])
    pairs = zip(error.reconverged_n, error.latency_n, strict=True)
    first = relative_errors(simulation.tracks[key], FRONT, 0, PROFILE[1].start)
    return {
        "4.5-biased": {
            "relative_errors_of_M_B_K_at_the_ends": (simulation.tracks["rls"].parameters[ENDS] / truth - 1.0).tolist(),
            "reconverged_n": simulation.qualities["rls"].reconverged_n,
        },
        "4.6-immediately": {
            "latency_n": error.latency_n,
            "extra_alarms": error.extra_alarms,
            "reconverged_n": error.reconverged_n,
            "theta_reconverged_n": _theta_reconverged(simulation, key),
            "alarms_without_hold_off": len(simulation.track(_scheme(key, ERROR_CEILING, hold_off_n=0)).alarms),
            "by_unit_of_y": {
                name: _detection(simulation.track(SCHEMES[key], SCALES[name])) for name in SCALES_OF_CEILING
            },
            "ceilings_without_a_miss": _suitable_ceilings(simulation, key, 8),
            "alarms_if_the_coefficients_jump": _alarms_if_the_coefficients_jump(simulation, key),
        },
        "4.6-theory": {
            "samples_from_the_alarm": [None if n is None or found is None else n - found for n, found in pairs],
            "samples_from_the_start": settling_n(first),
        },
        "4.4-outliers": _robustness(simulation, key),
    }


def _measure_mean(simulation: Simulation) -> dict[str, Facts]:
    """Values behind the claims about the mean since the start and between faults, by identifier."""
    key, statistic, begun = "mean-between-faults", simulation.since_start.statistic, PROFILE[1].start
    quality, others = simulation.qualities, ("mean-between-faults", "forgetting", "prediction-error")
    halved = np.where(np.arange(PROFILE_N) < 300, simulation.u, 0.5 * simulation.u)
    return {
        "4.8-never-zero": {
            "mean_at_the_ends": statistic[ENDS[1:]].tolist(),
            "samples_below_15": (np.flatnonzero(statistic[begun:] < 0.05 * MEAN_CEILING) + begun).tolist(),
        },
        "4.8-difficulty": {"samples_above_300": int((statistic > MEAN_CEILING).sum())},
        "4.9-sample-rate": {
            "second_alarm_after_n": _second_alarms(1, MEAN_CEILING),
            "at_200_hz": _second_alarms(2, MEAN_CEILING),
            "at_200_hz_with_a_quarter_of_the_ceiling": _second_alarms(2, MEAN_CEILING / 4.0),
        },
        "4.9-false-alarms": {
            "latency_n": quality[key].latency_n,
            "extra_alarms": quality[key].extra_alarms,
            "hold_off_from_the_alarm": _detection(simulation.track(_scheme(key, MEAN_CEILING, hold_off_n=HOLD_N - 2))),
            "with_magnitudes": _detection(simulation.track(_scheme(key, MEAN_CEILING, absolute=True))),
            "alarms_if_the_coefficients_jump": _alarms_if_the_coefficients_jump(simulation, key),
        },
        "4.9-ceiling": _ceilings(simulation, key),
        "4.10-spikes": {"spikes": {each: quality[each].spikes for each in (key, "prediction-error")}},
        "4.10-variance": {
            "reconverged_n": {each: quality[each].reconverged_n for each in others},
            "theta_reconverged_n": {each: _theta_reconverged(simulation, each) for each in others},
            "spread_of_M_B_K": {each: quality[each].spread for each in others[:2]},
        },
        "4.5-robust": _robustness(simulation, key),
        "4.9-level": {"alarms": len(_track(SCHEMES[key], halved, time_varying(halved, [Segment(0, FRONT)])).alarms)},
    }


def _errors_of_theta(each: Track, scale: float, segments: Sequence[Segment]) -> Signal:
    """Errors (n, 4) of a1, a2, b0, b1, relative to the truth."""
    return np.asarray(each.theta / [1.0, 1.0, scale, scale] / coefficients(segments, len(each.theta)) - 1.0)


def _theta_reconverged(simulation: Simulation, key: str) -> list[int | None]:
    """Samples from each change until a1, a2, b0, b1, instead of M, B, K, stay within 5 %."""
    return reconverged(_errors_of_theta(simulation.tracks[key], UNITS_PER_M, PROFILE), PROFILE)


def _suitable_ceilings(simulation: Simulation, key: str, most_extra: int, **changes: Any) -> list[float]:
    """Lowest and highest ceiling that misses no change and has at most so many extra alarms; empty if there is none.

    41 ceilings from 1 % to 100 times the printed one are tried.
    """
    found = []
    for ceiling in (CEILINGS[key] * np.geomspace(0.01, 100.0, 41)).tolist():
        quality = assess(simulation.track(_scheme(key, ceiling, **changes)), PROFILE)
        if not quality.missed and quality.extra_alarms <= most_extra:
            found.append(float(ceiling))
    return [min(found), max(found)] if found else []


def _detection(each: Track) -> dict[str, Any]:
    """Latencies, missed changes and extra alarms of a track over the profile."""
    quality = assess(each, PROFILE)
    return {"latency_n": quality.latency_n, "missed": quality.missed, "extra_alarms": quality.extra_alarms}


def _alarms_if_the_coefficients_jump(simulation: Simulation, key: str) -> list[int]:
    """Alarms if a change is read as a jump of the coefficients instead of the physical parameters."""
    return [int(k) for k in _track(SCHEMES[key], simulation.u, jumps_in_the_coefficients(simulation.u)).alarms]


def _robustness(simulation: Simulation, key: str) -> Facts:
    return {
        "least_outlier": {str(at): _least_outlier(simulation, key, at) for at in OUTLIER_AT},
        "extra_alarms_by_noise": _extra_alarms_by_noise(simulation, key),
    }


def _least_outlier(simulation: Simulation, key: str, at: int) -> float:
    """Smallest error of a single reading that raises an alarm within ten samples [0.1 um], to a thousandth."""
    u, clean = simulation.u[: at + 10], simulation.y[: at + 10] * UNITS_PER_M
    low, high = 1.0, 1e6
    while high > 1.001 * low:
        size = math.sqrt(low * high)
        spoiled = clean + size * (np.arange(len(u)) == at)
        low, high = (low, size) if len(track(SCHEMES[key], u, spoiled).alarms) else (size, high)
    return high


def _extra_alarms_by_noise(simulation: Simulation, key: str) -> dict[str, dict[str, float]]:
    """Mean extra alarms of NOISE_SEEDS in single and in double precision, by the rms noise of y [0.1 um]."""
    config, u = SCHEMES[key], simulation.u
    out: dict[str, dict[str, float]] = {"single precision": {}, "double precision": {}}
    for rms in NOISE_UNITS:
        extra = []
        for seed in NOISE_SEEDS if rms else (0,):
            y = simulation.y * UNITS_PER_M + np.random.default_rng(seed).normal(0.0, rms, PROFILE_N)
            single = track(config, u, y, 1.0 / UNITS_PER_M)
            steps = ReferenceEstimator(config).run(u.tolist(), y.tolist())
            double = dataclasses.replace(single, alarms=np.flatnonzero([step.alarm for step in steps]))
            extra.append([assess(each, PROFILE).extra_alarms for each in (single, double)])
        for row, mean in zip(out.values(), np.mean(extra, axis=0).tolist(), strict=True):
            row[f"{rms:g}"] = mean
    return out


def _second_alarms(rate: int, ceiling: float) -> dict[str, int | None]:
    """Samples between two alarms before the next edge, if there are two, by the duration of a lower mass.

    M falls to 30 kg at sample 200 and is back after so many samples; ``rate`` is the sample rate over 100 Hz.
    """
    n, at, light, period_n = 300 * rate, 200 * rate, PROFILE[-1].plant, 100 * rate
    u = square(n, FRONT_FORCE_N, period_n)
    config = _scheme("mean-between-faults", ceiling, warm_up_n=WARM_UP_N * rate)
    out: dict[str, int | None] = {}
    for apart in range(1, 13):
        segments = [Segment(0, FRONT), Segment(at, light), Segment(at + apart, FRONT)]
        found = _track(config, u, time_varying(u, segments, PERIOD_S / rate)).alarms.tolist()
        alarms = [k for k in found if at < k < at + period_n // 2]
        out[str(apart)] = alarms[1] - alarms[0] if len(alarms) > 1 else None
    return out


def _least(counts: Mapping[str, int | None]) -> int:
    return min(n for n in counts.values() if n is not None)


def _ceilings(simulation: Simulation, key: str) -> Facts:
    innovation = _largest(simulation.tracks["rls"].innovation[WARM_UP_N:])
    still = time_varying(simulation.u, [Segment(0, FRONT)])
    calm = _largest(_track(PLAIN, simulation.u, still).innovation[WARM_UP_N:])
    return {
        "largest_innovation": innovation,
        "with_that_ceiling": _detection(simulation.track(_scheme(key, innovation))),
        "largest_innovation_stationary": calm,
        "with_that_of_the_stationary": {
            each: _detection(simulation.track(_scheme(each, calm))) for each in (key, "prediction-error")
        },
        "serving_ceilings_signed": _suitable_ceilings(simulation, key, 1, absolute=False),
        "serving_ceilings_of_magnitudes": _suitable_ceilings(simulation, key, 1, absolute=True),
    }
