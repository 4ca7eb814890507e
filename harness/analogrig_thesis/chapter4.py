"""Chapter 4: the simulated suspension, Fig. 4.1 to 4.10."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from analogrig import EstimatorConfig, Plant
from analogrig.plant import Segment
from analogrig_thesis.double_precision import PlainEstimator
from analogrig_thesis.models import (
    ERROR,
    ERROR_CEILING,
    FRONT,
    HOLD_N,
    MEAN,
    P0,
    PERIOD_S,
    PLAIN,
    PROFILE,
    PROFILE_N,
    SHOCK,
    UNITS_PER_M,
    WARM_UP_N,
    Arx,
    SignalPair,
    Track,
    TrackQuality,
    assess,
    coefficients,
    damping_ratio,
    jumps_in_the_coefficients,
    marks,
    reconverged,
    relative_errors,
    schemes,
    settling_n,
    square,
    stretches,
    time_varying,
)
from analogrig_thesis.texts import Chapter, Drawing, Facts, Signal, load_chapter

SHOCK_FORCE_N, FRONT_FORCE_N = 1470.0, 2940.0
"""Section 4.3: 12 cm of stroke against 12.25 kN/m; section 4.4.1: twice that."""

SCALES = {"m": 1.0, "m × 5": 5.0, "mm": 1e3, "mm × 5": 5e3, "m × 10⁵": 1e5, "µm": 1e6, "µm × 5": 5e6, "0.1 µm": 1e7}
"""Candidate units of y, to the metre, by name."""
SCALES_OF_FRONT = ("m", "m × 5", "mm", "mm × 5", "m × 10⁵", "0.1 µm")
SCALES_OF_CEILING = ("m × 5", "mm × 5", "m × 10⁵", "µm", "µm × 5", "0.1 µm")

MEAN_CEILING = 300.0
"""Section 4.4.3, in units of 0.1 um."""
CEILINGS = {ERROR: ERROR_CEILING, MEAN: MEAN_CEILING}

PRINTED_4_3 = Arx(-0.8816, 0.0112, 0.8383e-5, 0.2197e-5)
PRINTED_4_8 = Arx(-1.7503, 0.769, -0.3650e-5, 0.3984e-5)
SHOCK_ZETA = 2.87
"""Damping ratio that gives all eight printed figures of Equ 4.3; B = 900 has 2.875."""

FREQUENCY_HZ = np.geomspace(0.05, 50.0, 241)

OUTLIER_AT = (60, 100, 150)
"""Sample indices of single outliers. After 50 samples of warm-up the mean covers 10, 50 and 100 errors."""
NOISE_UNITS = (0.0, 100.0, 300.0)
NOISE_SEEDS = range(5)

SCHEMES = schemes(PLAIN, ERROR_CEILING, MEAN_CEILING)

ENDS = [end - 1 for _, end, _ in stretches(PROFILE, PROFILE_N)]
"""Last samples of the stretches."""

STEADY = (Segment(0, FRONT.plant),)
"""Front suspension without a change."""


@dataclasses.dataclass(frozen=True, eq=False)
class Simulation:
    """Time-varying front suspension without noise, and the estimates of the thesis's five schemes."""

    u: Signal
    y: Signal
    """metres"""
    tracks: Mapping[str, Track]

    @cached_property
    def qualities(self) -> Mapping[str, TrackQuality]:
        """Quality of each scheme."""
        return {key: assess(each, PROFILE) for key, each in self.tracks.items()}

    @cached_property
    def since_start(self) -> Track:
        """Mean prediction error of plain RLS since sample 50, without a trigger."""
        return self.track(_scheme(MEAN, 1e8))

    def track(self, config: EstimatorConfig, scale: float = UNITS_PER_M) -> Track:
        """Run another estimator on the same data, ``scale`` units of y to the metre."""
        return _track(config, self.u, self.y, scale)


def simulate() -> Simulation:
    """Simulate the profile and run the five schemes; deterministic."""
    u = square(PROFILE_N, FRONT_FORCE_N)
    y = time_varying(u)
    return Simulation(u, y, {key: _track(config, u, y) for key, config in SCHEMES.items()})


def simulated_data(simulation: Simulation) -> dict[str, Signal]:
    """Force [N] and displacement [m] by figure."""
    shock, front = square(400, SHOCK_FORCE_N), square(400, FRONT_FORCE_N)
    return {
        "fig-4.1-u": shock,
        "fig-4.1-y": time_varying(shock, [Segment(0, SHOCK.plant)]),
        "fig-4.3-u": front,
        "fig-4.3-y": time_varying(front, STEADY),
        "fig-4.5-u": simulation.u,
        "fig-4.5-y": simulation.y,
    }


def reproduce_chapter(simulation: Simulation) -> Chapter:
    """Figures, printed numbers, errata and claims of chapter 4."""
    # Equ. 4.5: one period, y in millimetres, data of the printed Equ. 4.3.
    one_period = square(100, SHOCK_FORCE_N)
    identified = _least_squares_with_prior(one_period, PRINTED_4_3.response(one_period), P0)
    measured = {
        **_measure_stationary(identified),
        **_measure_error(simulation),
        **_measure_mean(simulation),
        **_measure_ceilings(simulation),
    }
    facts = {"identified": identified, **_facts(simulation, measured)}
    return load_chapter(4, facts, _drawings(simulation, identified), measured)


def _facts(simulation: Simulation, measured: Mapping[str, Facts]) -> dict[str, Any]:
    """Values for the texts beside those behind the claims."""
    bias, second = measured["4.5-biased"], measured["4.9-sample-rate"]
    damping = 2 * SHOCK_ZETA * math.sqrt(SHOCK.stiffness_n_per_m * SHOCK.mass_kg)
    return {
        "quality": simulation.qualities,
        "shock": Arx.of(SHOCK.plant),
        "front": Arx.of(FRONT.plant),
        "shock_damping": damping,
        "shock_by_zeta": Arx.of(SHOCK._replace(damping_n_s_per_m=damping).plant),
        "compliances": [1.0 / PRINTED_4_8.gain, 1.0 / Arx.of(FRONT.plant).gain],
        "zeta": [damping_ratio(segment.plant) for segment in PROFILE],
        "critical": 2 * 0.9 * math.sqrt(FRONT.stiffness_n_per_m * FRONT.mass_kg),
        "stroke_force": SHOCK.stiffness_n_per_m * 0.12,
        "two_stiffnesses": 2 * SHOCK.stiffness_n_per_m,
        "two_dampings": 2 * SHOCK.damping_n_s_per_m,
        "hold_s": HOLD_N * PERIOD_S,
        "largest_bias": _largest(bias["relative_errors_of_M_B_K_at_the_ends"][1:]),
        "second_alarm_list": list(second["second_alarm_after_n"].values()),
        "least_distance_n": _least(second["second_alarm_after_n"]),
        "least_distance_at_200_hz_n": _least(second["at_200_hz_with_a_quarter_of_the_ceiling"]),
        "largest_error_in_fig_4_7": _largest(simulation.tracks[ERROR].innovation[60:]),
    }


def _least_squares_with_prior(u: Signal, y_m: Signal, p0: float) -> Arx:
    """Least-squares estimate with the prior theta = 0 of variance p0, y in millimetres."""
    return Arx.scaled(_track(dataclasses.replace(PLAIN, p0=p0), u, y_m, 1e3).theta[-1], 1e-3)


def _track(config: EstimatorConfig, u: Signal, y_m: Signal, scale: float = UNITS_PER_M) -> Track:
    """Run an estimator over displacements in metres times ``scale``."""
    return SignalPair(u, y_m * scale, 1.0 / scale).track(config)


def _scheme(key: str, ceiling: float, **changes: Any) -> EstimatorConfig:
    return dataclasses.replace(schemes(PLAIN, ceiling, ceiling)[key], **changes)


def _largest(values: Any) -> float:
    return float(np.abs(values).max())


def _least(counts: Mapping[str, int | None]) -> int:
    return min(n for n in counts.values() if n is not None)


def _drawings(simulation: Simulation, identified: Arx) -> dict[str, Drawing]:
    data, tracks, since_start = simulated_data(simulation), simulation.tracks, simulation.since_start
    still = _track(PLAIN, data["fig-4.3-u"], data["fig-4.3-y"], SCALES["mm × 5"])
    known = coefficients(PROFILE, PROFILE_N)

    def watched(each: Track, signal: Signal, *ceilings: float) -> Drawing:
        return Drawing([[signal, *(np.full(PROFILE_N, ceiling) for ceiling in ceilings)]], marks(each, PROFILE))

    return {
        "4.1": Drawing([[data["fig-4.1-u"]], [data["fig-4.1-y"] * 1e3]]),
        "4.2": _bode(Arx.of(SHOCK.plant), identified),
        "4.3": Drawing([[data["fig-4.3-u"]], [data["fig-4.3-y"] * 1e3]]),
        "4.4": Drawing(_theta_panels(still.theta[:100], coefficients(STEADY, 100), SCALES["mm × 5"])),
        "4.7": watched(tracks[ERROR], tracks[ERROR].innovation, ERROR_CEILING, -ERROR_CEILING),
        "4.8": watched(since_start, since_start.statistic, MEAN_CEILING),
        "4.9": watched(tracks[MEAN], tracks[MEAN].statistic, MEAN_CEILING),
        **{
            number: Drawing(_theta_panels(tracks[key].theta, known, UNITS_PER_M), marks(tracks[key], PROFILE))
            for number, key in (("4.5", "rls"), ("4.6", ERROR), ("4.10", MEAN))
        },
    }


def _bode(*models: Arx) -> Drawing:
    responses = [model.frequency_response(FREQUENCY_HZ) for model in models]
    phases = [np.degrees(np.unwrap(np.angle(each))) for each in responses]
    return Drawing([[20.0 * np.log10(np.abs(each)) for each in responses], phases], x=FREQUENCY_HZ)


def _theta_panels(theta: Signal, known: Signal, scale: float) -> list[list[Signal]]:
    """Truth and estimates of the a's, and of the b's in 1e-6 m/N."""
    a, b = slice(0, 2), slice(2, 4)
    return [[*known[:, a].T, *theta[:, a].T], [*known[:, b].T * 1e6, *theta[:, b].T / scale * 1e6]]


def _measure_stationary(identified: Arx) -> dict[str, Facts]:
    """Values behind the claims of sections 4.3 and 4.4.1 about stationary plants, by identifier."""
    force, u = square(400, SHOCK_FORCE_N), square(400, FRONT_FORCE_N)
    vague = _least_squares_with_prior(force, time_varying(force, [Segment(0, SHOCK.plant)]), 1e6)
    bandwidth_hz, error = _bandwidth_hz(SHOCK.plant), _largest(np.array(vague) / Arx.of(SHOCK.plant) - 1.0)
    gains = _bode(Arx.of(SHOCK.plant), identified).panels[0]
    tracks = {name: _track(PLAIN, u, time_varying(u, STEADY), SCALES[name]) for name in SCALES_OF_FRONT}
    return {
        "4.3-excitation": {"bandwidth_hz": bandwidth_hz, "criterion_hz": 0.16 * bandwidth_hz, "largest_error": error},
        "4.3-batch": {
            "largest_difference_db": _largest(gains[0] - gains[1]),
            "error_of_least_squares": error,
            "estimated": identified,
        },
        "4.4-30-samples": {
            "within_5_percent_after_n": {
                name: settling_n(relative_errors(each, FRONT.plant)) for name, each in tracks.items()
            },
            "theta_within_5_percent_after_n": {
                name: settling_n(_errors_of_theta(each, SCALES[name], STEADY)) for name, each in tracks.items()
            },
            "largest_error": _largest(relative_errors(tracks["mm × 5"], FRONT.plant)[-1]),
        },
    }


def _bandwidth_hz(plant: Plant) -> float:
    """Frequency at which the gain of the continuous plant has fallen by 3 dB."""
    frequency_hz = np.geomspace(1e-2, 1e3, 200001)
    s = 2j * math.pi * frequency_hz
    mass_kg, damping_n_s_per_m, stiffness_n_per_m = plant.values
    gain = np.abs(1.0 / (mass_kg * s * s + damping_n_s_per_m * s + stiffness_n_per_m))
    return float(frequency_hz[np.argmax(gain < gain[0] / math.sqrt(2.0))])


def _measure_error(simulation: Simulation) -> dict[str, Facts]:
    """Values behind the claims about plain RLS and the prediction error, by identifier."""
    quality = simulation.qualities[ERROR]
    truth = np.array([segment.plant.values for segment in PROFILE])
    pairs = zip(quality.reconverged_n, quality.latency_n, strict=True)
    return {
        "4.5-biased": {
            "relative_errors_of_M_B_K_at_the_ends": (simulation.tracks["rls"].parameters[ENDS] / truth - 1.0).tolist(),
            "reconverged_n": simulation.qualities["rls"].reconverged_n,
        },
        "4.6-immediately": {
            "latency_n": quality.latency_n,
            "extra_alarms": quality.extra_alarms,
            "reconverged_n": quality.reconverged_n,
            "theta_reconverged_n": _theta_reconverged(simulation, ERROR),
            "alarms_without_hold_off": len(simulation.track(_scheme(ERROR, ERROR_CEILING, hold_off_n=0)).alarms),
            "by_unit_of_y": {
                name: _detection(simulation, ERROR, ERROR_CEILING, SCALES[name]) for name in SCALES_OF_CEILING
            },
            "ceilings_without_a_miss": _suitable_ceilings(simulation, ERROR, 8),
            "alarms_if_the_coefficients_jump": _alarms_if_the_coefficients_jump(simulation, ERROR),
        },
        "4.6-theory": {
            "samples_from_the_alarm": [None if n is None or found is None else n - found for n, found in pairs],
            "samples_from_the_start": settling_n(
                relative_errors(simulation.tracks[ERROR], FRONT.plant, 0, PROFILE[1].start)
            ),
        },
        "4.4-outliers": _robustness(simulation, ERROR),
    }


def _measure_mean(simulation: Simulation) -> dict[str, Facts]:
    """Values behind the claims about the mean since the start and between faults, by identifier."""
    statistic, begun = simulation.since_start.statistic, PROFILE[1].start
    quality, others = simulation.qualities, (MEAN, "forgetting", ERROR)
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
            "latency_n": quality[MEAN].latency_n,
            "extra_alarms": quality[MEAN].extra_alarms,
            "hold_off_from_the_alarm": _detection(simulation, MEAN, MEAN_CEILING, hold_off_n=HOLD_N - 2),
            "with_magnitudes": _detection(simulation, MEAN, MEAN_CEILING, absolute=True),
            "alarms_if_the_coefficients_jump": _alarms_if_the_coefficients_jump(simulation, MEAN),
        },
        "4.10-spikes": {"spikes": {each: quality[each].spikes for each in (MEAN, ERROR)}},
        "4.10-variance": {
            "reconverged_n": {each: quality[each].reconverged_n for each in others},
            "theta_reconverged_n": {each: _theta_reconverged(simulation, each) for each in others},
            "spread_of_M_B_K": {each: quality[each].spread for each in others[:2]},
        },
        "4.5-robust": _robustness(simulation, MEAN),
        "4.9-level": {"alarms": len(_track(SCHEMES[MEAN], halved, time_varying(halved, STEADY)).alarms)},
    }


def _errors_of_theta(each: Track, scale: float, segments: Sequence[Segment]) -> Signal:
    """Errors (n, 4) of a1, a2, b0, b1, relative to the truth."""
    return np.asarray(each.theta / [1.0, 1.0, scale, scale] / coefficients(segments, len(each.theta)) - 1.0)


def _theta_reconverged(simulation: Simulation, key: str) -> list[int | None]:
    """Samples from each change until a1, a2, b0, b1, instead of M, B, K, stay within 5 %."""
    return reconverged(_errors_of_theta(simulation.tracks[key], UNITS_PER_M, PROFILE), PROFILE)


def _detection(
    simulation: Simulation, key: str, ceiling: float, scale: float = UNITS_PER_M, **changes: Any
) -> dict[str, Any]:
    """Latencies, missed changes and extra alarms of a scheme with another ceiling, unit of y or setting."""
    quality = assess(simulation.track(_scheme(key, ceiling, **changes), scale), PROFILE)
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
        low, high = (low, size) if len(SignalPair(u, spoiled).track(SCHEMES[key]).alarms) else (size, high)
    return high


def _extra_alarms_by_noise(simulation: Simulation, key: str) -> dict[str, dict[str, float]]:
    """Mean extra alarms of NOISE_SEEDS in single and in double precision, by the rms noise of y [0.1 um]."""
    config, u, extra = SCHEMES[key], simulation.u, {}
    for rms in NOISE_UNITS:
        found = []
        for seed in NOISE_SEEDS if rms else (0,):
            y = simulation.y * UNITS_PER_M + np.random.default_rng(seed).normal(0.0, rms, PROFILE_N)
            single = SignalPair(u, y, 1.0 / UNITS_PER_M).track(config)
            double = dataclasses.replace(single, alarms=PlainEstimator(config).run(u, y)[0])
            found.append([assess(each, PROFILE).extra_alarms for each in (single, double)])
        extra[f"{rms:g}"] = np.mean(found, axis=0).tolist()
    names = ("single precision", "double precision")
    return {name: {rms: means[i] for rms, means in extra.items()} for i, name in enumerate(names)}


def _second_alarms(rate: int, ceiling: float) -> dict[str, int | None]:
    """Samples between two alarms before the next edge, if there are two, by the duration of a lower mass.

    M falls to 30 kg at sample 200 and is back after so many samples; ``rate`` is the sample rate over 100 Hz.
    """
    n, at, light, period_n = 250 * rate, 200 * rate, PROFILE[-1].plant, 100 * rate
    u = square(n, FRONT_FORCE_N, period_n)
    config = _scheme(MEAN, ceiling, warm_up_n=WARM_UP_N * rate)
    out: dict[str, int | None] = {}
    for apart in range(1, 13):
        segments = [*STEADY, Segment(at, light), Segment(at + apart, FRONT.plant)]
        found = _track(config, u, time_varying(u, segments, PERIOD_S / rate)).alarms.tolist()
        alarms = [k for k in found if at < k < at + period_n // 2]
        out[str(apart)] = alarms[1] - alarms[0] if len(alarms) > 1 else None
    return out


def _measure_ceilings(simulation: Simulation) -> dict[str, Facts]:
    """Values behind the claim about the choice of the ceiling, by identifier."""
    innovation = _largest(simulation.tracks["rls"].innovation[WARM_UP_N:])
    still = _track(PLAIN, simulation.u, time_varying(simulation.u, STEADY))
    calm = _largest(still.innovation[WARM_UP_N:])
    return {
        "4.9-ceiling": {
            "largest_innovation": innovation,
            "with_that_ceiling": _detection(simulation, MEAN, innovation),
            "largest_innovation_stationary": calm,
            "with_that_of_the_stationary": {each: _detection(simulation, each, calm) for each in (MEAN, ERROR)},
            "serving_ceilings_signed": _suitable_ceilings(simulation, MEAN, 1, absolute=False),
            "serving_ceilings_of_magnitudes": _suitable_ceilings(simulation, MEAN, 1, absolute=True),
        }
    }


def _suitable_ceilings(simulation: Simulation, key: str, most_extra: int, **changes: Any) -> list[float]:
    """Lowest and highest ceiling that misses no change and has at most so many extra alarms; empty if there is none.

    41 ceilings from 1 % to 100 times the printed one are tried.
    """
    ceilings = (CEILINGS[key] * np.geomspace(0.01, 100.0, 41)).tolist()
    seen = {ceiling: _detection(simulation, key, ceiling, **changes) for ceiling in ceilings}
    found = [at for at, each in seen.items() if not each["missed"] and each["extra_alarms"] <= most_extra]
    return [min(found), max(found)] if found else []
