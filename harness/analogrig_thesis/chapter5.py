"""Chapter 5: the electrical analogue, Fig. 5.4 to 5.10; its circuit is played on the emulated computer."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from analogrig import Bench, EstimatorConfig, Plant, PotChange, Program, Rig, Run, Scenario, open_rig
from analogrig.bench import raise_if_interrupted
from analogrig.config import fixtures
from analogrig.devices import HostDevice
from analogrig.plant import SampledPlant, Segment
from analogrig.run import Channel
from analogrig_emulator import Excitation
from analogrig_thesis.models import (
    DEFAULT,
    ERROR,
    ERROR_CEILING,
    FRONT,
    MEAN,
    OURS,
    PERIOD_S,
    PLAIN,
    PROFILE,
    SHOCK,
    UNITS_PER_M,
    Arx,
    SignalPair,
    Suspension,
    Track,
    TrackQuality,
    assess,
    damping_ratio,
    marks,
    reconverged,
    schemes,
    square,
    time_varying,
)
from analogrig_thesis.texts import Chapter, Drawing, Facts, Signal, load_chapter

SEED = 1995
SEEDS = range(20)

RECORDED = ("fig-5.4", "fig-5.5", "fig-5.7-quantised", "fig-5.7")
"""Names of the recordings."""

QUANTISED, NOISY, SKEWED = "emulator-ideal", "emulator", "emulator-skewed"
"""Rigs: 12 bits alone; with offsets and 1 LSB of noise; and with the force converted before the displacement."""

INFERRED = Suspension(30.5, 1505.0, 24500.0)
"""Plant that comes nearest to Equ 5.4 on the skewed card; the text does not name it."""

CUTOFFS_HZ = (5.0, 10.0, 20.0)
"""Cut-off frequencies at the suspension for the filter of section 4.3, which the text does not describe."""

LIVE_CUTOFF_HZ = 10.0

TIMEOUT_S = 20.0
"""Time-out of the device process, generous for a loaded machine."""

MEAN_CEILING = 500.0
"""Section 5.5, in units of 0.1 um."""

COMPARISON = Scenario(
    name="fig-5.4", samples=400, excitation=Excitation(frequency_hz=200.0), program=Program.load("shock")
)

IDENTIFICATION = Scenario(
    name="fig-5.5", samples=2000, excitation=Excitation(frequency_hz=100.0), set=INFERRED.plant.overrides
)

TRACKING = Scenario(
    name="fig-5.7",
    samples=1000,
    excitation=Excitation(frequency_hz=100.0, phase=0.25),
    # Each change sets all pots, also those that stay.
    changes=tuple(
        PotChange(start, segment.plant.parameters())
        for start, segment in zip((200, 400, 600, 800), PROFILE[1:], strict=True)
    ),
    description="the four changes of section 4.4.1, each while the force is on",
)

BATCH = dataclasses.replace(PLAIN, offset=True, p0=1e6, p0_offset=1e9)
"""Recursive least squares with a vague prior: the batch estimate (Equ 3.17) after the last sample."""

LIVE = dataclasses.replace(PLAIN, offset=True, p0_offset=1e6)
"""Codes have a zero of their own: the offset replaces the detrending of section 4.3."""

PRINTED_5_4 = Arx(-1.5628, 0.0766, 0.1817e-5, 0.0766e-5)

FIRST_N = 1000
"""Section 5.4: "The first 1000 samples of this data were used"."""

WARM_N = 100
"""Samples left out of the prediction error."""

EARLY = 0.2
"""Lead of the force, in samples: 10 us at 20 kHz."""

CEILINGS_LSB = np.geomspace(0.1, 100.0, 61)

TRIGGERS = {f"{ERROR} e": (ERROR, False), f"{MEAN} e": (MEAN, False), f"{MEAN} |e|": (MEAN, True)}
"""Key of the scheme, and True for the mean of magnitudes, by name of the trigger."""

Sweep = list[tuple[int, int]]
"""Missed changes and extra alarms at each of CEILINGS_LSB."""
Sweeps = Mapping[str, Mapping[str, Sweep]]
"""Sweeps by data and name of the trigger."""


def samples_of(run: Run) -> SignalPair:
    """Codes of a recorded run."""
    return _as_samples(run.codes, run.conditions.channels)


def play_alone(rig_name: str, scenario: Scenario, seed: int) -> SignalPair:
    """Play a scenario on a rig without a device.

    :raises RigError: the rig failed.
    """
    with _shipped_rig(rig_name) as rig:
        performance = rig.perform(scenario, seed)
        codes = np.concatenate([block.codes for block in performance.blocks])
    return _as_samples(codes, performance.channels)


def _as_samples(codes: NDArray[np.uint16], channels: Mapping[str, Channel]) -> SignalPair:
    u, y = codes[:, :2].T.astype(np.float64)
    return SignalPair(u, y, channels["displacement"].lsb, channels["force"].lsb)


@dataclass(frozen=True, eq=False)
class TrackedRun:
    """One run of the circuit, and the track of each scheme as a device on the link."""

    run: Run
    """The run with the mean between faults."""
    tracks: Mapping[str, Track]

    @property
    def segments(self) -> tuple[Segment, ...]:
        """True plants of the run."""
        return self.run.conditions.segments

    @cached_property
    def codes(self) -> SignalPair:
        """Codes of the run."""
        return samples_of(self.run)

    @cached_property
    def qualities(self) -> Mapping[str, TrackQuality]:
        """Quality of each scheme."""
        return {key: assess(each, self.segments) for key, each in self.tracks.items()}


@dataclass(frozen=True, eq=False)
class CircuitRuns:
    """All runs of the circuit."""

    comparison: Run
    identification: Run
    quantised: TrackedRun
    noisy: TrackedRun

    @property
    def by_file(self) -> dict[str, Run]:
        """Runs by the names of their files."""
        runs = (self.comparison, self.identification, self.quantised.run, self.noisy.run)
        return dict(zip(RECORDED, runs, strict=True))


def play_circuit() -> CircuitRuns:
    """Play all scenarios over the link, through the C estimator in a process of its own; deterministic.

    :raises DeviceError, LinkError, RigError: a run failed.
    """
    return CircuitRuns(
        _play(NOISY, COMPARISON, LIVE), _play(SKEWED, IDENTIFICATION, BATCH), _play_all(QUANTISED), _play_all(NOISY)
    )


def circuit_schemes(m_per_unit: float) -> dict[str, EstimatorConfig]:
    """Settings by key: the thesis's five with its ceilings in codes, and ours."""
    error, mean = (ceiling / UNITS_PER_M / m_per_unit for ceiling in (ERROR_CEILING, MEAN_CEILING))
    return {**schemes(LIVE, error, mean), OURS: DEFAULT}


def _shipped_rig(name: str) -> Rig:
    """Open the rig of the package, whatever a rigs.toml of the working folder calls by its name."""
    return open_rig(str(fixtures() / "rigs" / f"{name}.toml"))


def _play(rig_name: str, scenario: Scenario, config: EstimatorConfig) -> Run:
    device = HostDevice(name="host", exchange="block", estimator=config, timeout_s=TIMEOUT_S)
    with _shipped_rig(rig_name) as rig, device.connect() as dut:
        return raise_if_interrupted(Bench(rig, dut).play(scenario, SEED))


def _play_all(rig_name: str) -> TrackedRun:
    """Play the changes once with each scheme; all get the same samples."""
    m_per_unit = play_alone(rig_name, TRACKING, 0).m_per_unit
    runs = {key: _play(rig_name, TRACKING, config) for key, config in circuit_schemes(m_per_unit).items()}
    return TrackedRun(runs[MEAN], {key: Track.of_run(run) for key, run in runs.items()})


def _filter(signal: Signal, order: int, cutoff_hz: float) -> Signal:
    return np.asarray(lfilter(*butter(order, 2.0 * cutoff_hz * PERIOD_S), signal))


def filter_live(samples: SignalPair, order: int) -> SignalPair:
    """Samples after a causal Butterworth filter, as in a live estimator."""
    u, y = (_filter(each - each[0], order, LIVE_CUTOFF_HZ) + each[0] for each in (samples.u, samples.y))
    return dataclasses.replace(samples, u=u, y=y)


def filter_off_line(run: Run, cutoff_hz: float = CUTOFFS_HZ[0]) -> SignalPair:
    """Newtons and units of 0.1 um, filtered by order 2 and without their means (section 4.3)."""
    signals = run.channel("force"), run.channel("displacement") * UNITS_PER_M
    u, y = (_filter(each - each.mean(), 2, cutoff_hz) for each in signals)
    return SignalPair(u, y, 1.0 / UNITS_PER_M)


def filtered_schemes(run: Run, cutoff_hz: float = CUTOFFS_HZ[0]) -> dict[str, Track]:
    """Tracks on data filtered off line: the thesis's five schemes, and its mean with magnitudes."""
    configs = schemes(PLAIN, ERROR_CEILING, MEAN_CEILING)
    configs["mean-of-magnitudes"] = dataclasses.replace(configs[MEAN], absolute=True)
    return {key: filter_off_line(run, cutoff_hz).track(config) for key, config in configs.items()}


def _identify(run: Run) -> Arx:
    """Batch estimate of the first 1000 samples in newtons and metres."""
    return Arx.scaled(_batch_theta(run), samples_of(run).b_scale)


def _batch_theta(run: Run) -> Signal:
    """Batch estimate a1, a2, b0, b1, d (5,) of the device after the first 1000 samples, in codes."""
    return np.asarray(run.theta[FIRST_N - 1], np.float64)


def _simulate_second_half(run: Run) -> tuple[Signal, Signal]:
    """Output in codes from sample 1000 on, and its simulation from the force and two samples before it."""
    samples, theta = samples_of(run), _batch_theta(run)
    arx, before = Arx.scaled(theta, 1.0), slice(FIRST_N - 2, FIRST_N)
    level = float(theta[4]) / (1.0 + arx.a1 + arx.a2)
    simulated = arx.response(samples.u[FIRST_N:], samples.u[before], samples.y[before] - level) + level
    return samples.y[FIRST_N:], simulated


def reproduce_chapter(circuit: CircuitRuns) -> Chapter:
    """Figures, printed numbers, errata and claims of chapter 5."""
    noisy, quantised = circuit.noisy, circuit.quantised
    sweeps = {
        "quantised": _sweep(quantised.codes, quantised.segments, LIVE, 1.0),
        "noisy": _sweep(noisy.codes, noisy.segments, LIVE, 1.0),
        "conditioned": _sweep(filter_off_line(noisy.run), noisy.segments, PLAIN, noisy.codes.m_per_unit * UNITS_PER_M),
    }
    measured = {**_measure_identification(circuit), **_measure_tracking(circuit, sweeps)}
    return load_chapter(5, _facts(circuit, measured), _drawings(circuit, sweeps), measured)


def _facts(circuit: CircuitRuns, measured: Mapping[str, Facts]) -> dict[str, Any]:
    """Values for the texts beside those behind the claims."""
    conditions, estimate = circuit.identification.conditions, _identify(circuit.identification)
    unskewed, variances = Arx.of(INFERRED.plant), measured["5.4-variance"]["variances"]
    spread = measured["5.9-forgetting"]["spread_of_b_1e-6_m_per_N"]["noisy"]
    return {
        "estimate": estimate,
        "shock": Arx.of(SHOCK.plant),
        "front": Arx.of(FRONT.plant),
        "rate_hz": 1.0 / conditions.sample_period_s,
        "problem_rate_hz": 1.0 / conditions.sample_period_problem_s,
        "time_scale": conditions.time_scale,
        "printed_poles": PRINTED_5_4.poles,
        "a2_from_gain": (PRINTED_5_4.b0 + PRINTED_5_4.b1) * INFERRED.stiffness_n_per_m - 1.0 - PRINTED_5_4.a1,
        "inferred": INFERRED,
        "inferred_zeta": damping_ratio(INFERRED.plant),
        "moved_by_skew": [estimate.b0 / unskewed.b0 - 1.0, estimate.b1 / unskewed.b1 - 1.0],
        "moved_by_deviations": abs(estimate.b0 - unskewed.b0) * 1e5 / np.sqrt(variances[2]),
        "ceiling_lsb": MEAN_CEILING / UNITS_PER_M / circuit.noisy.codes.m_per_unit,
        "mean_alarms": len(circuit.noisy.tracks[MEAN].alarms),
        "walk_over_forgetting": spread["random-walk"] / spread["forgetting"],
    }


def _rms(values: Signal) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _drawings(circuit: CircuitRuns, sweeps: Sweeps) -> dict[str, Drawing]:
    noisy, quantised, run = circuit.noisy, circuit.quantised, circuit.noisy.run
    ceiling, batch = MEAN_CEILING / UNITS_PER_M / noisy.codes.m_per_unit, _batch_estimates(run)
    estimates = {key: _estimate_panels(_in_si(each, noisy.codes.b_scale), batch) for key, each in noisy.tracks.items()}
    mean, ours = noisy.tracks[MEAN], noisy.tracks[OURS]
    calm = quantised.tracks[MEAN]
    calm_estimates = _estimate_panels(_in_si(calm, quantised.codes.b_scale), _batch_estimates(quantised.run))
    changes, alarms = (marks(mean, noisy.segments, with_alarms=each) for each in (False, True))
    output_mm = run.channel("displacement") * 1e3
    predicted_mm = output_mm - mean.innovation * noisy.codes.m_per_unit * 1e3
    counts = [np.array(each, float).T for data in ("noisy", "conditioned") for each in sweeps[data].values()]
    return {
        "5.4": _comparison(circuit.comparison),
        "5.5": _scaling(circuit.identification),
        "5.6": _simulation_over_second_half(circuit.identification),
        "5.7": Drawing([[run.channel("force")], [output_mm]], changes),
        "5.8": Drawing(estimates[MEAN], alarms),
        "5.8 A": Drawing([*calm_estimates, _statistic(calm, ceiling)], marks(calm, quantised.segments)),
        "5.8 B": Drawing([*estimates[OURS], _statistic(ours, float(np.log(1e5)))], marks(ours, noisy.segments)),
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
    period_n = 2 * round(0.5 / (excitation.frequency_hz * run.conditions.sample_period_s))
    half = run.conditions.channels["force"].unit_per_v * excitation.high_v / 2.0
    return time_varying(square(run.samples, half, period_n) + half, run.conditions.segments[:1]) * 1e3


def _scaling(run: Run) -> Drawing:
    channels = run.conditions.channels
    volts = [channels[name].volts(run.codes[:, i]) for i, name in enumerate(("force", "displacement"))]
    return Drawing([volts, [run.channel("force")], [run.channel("displacement") * 1e3]])


def _simulation_over_second_half(run: Run) -> Drawing:
    channel = run.conditions.channels["displacement"]
    actual, predicted = ((each - channel.zero) * channel.lsb * 1e3 for each in _simulate_second_half(run))
    return Drawing([[actual, predicted], [actual - predicted]], x=np.arange(FIRST_N, run.samples, dtype=np.float64))


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


def _batch_estimates(run: Run) -> Signal:
    """Batch estimate a1, a2, b0, b1 (n, 4) [m/N] of the stretch that each sample belongs to."""
    codes, out = samples_of(run), np.empty((run.samples, 4))
    for start, end, _ in run.segments:
        # The first equation with nothing but the new plant in it begins two samples later.
        theta = SignalPair(codes.u[start + 1 : end], codes.y[start + 1 : end]).track(BATCH).theta[-1]
        out[start:end] = Arx.scaled(theta, codes.b_scale)
    return out


def _sweep(samples: SignalPair, segments: Sequence[Segment], plain: EstimatorConfig, unit: float) -> dict[str, Sweep]:
    """Sweep of each trigger, by its name; ``unit`` is the least significant bit in units of the samples."""
    out: dict[str, Sweep] = {}
    for name, (key, absolute) in TRIGGERS.items():
        configs = (schemes(plain, each * unit, each * unit)[key] for each in CEILINGS_LSB.tolist())
        tracks = (samples.track(dataclasses.replace(config, absolute=absolute)) for config in configs)
        out[name] = [(each.missed, each.extra_alarms) for each in (assess(track, segments) for track in tracks)]
    return out


def _best(sweep: Sweep) -> dict[str, float]:
    """Ceiling with the fewest missed changes, and among those with the fewest extra alarms."""
    i = min(range(len(sweep)), key=lambda j: sweep[j])
    return {"ceiling_lsb": float(CEILINGS_LSB[i]), "missed": sweep[i][0], "extra_alarms": sweep[i][1]}


def _measure_identification(circuit: CircuitRuns) -> dict[str, Facts]:
    """Values behind the claims of sections 5.3 and 5.4, by identifier."""
    run, codes = circuit.comparison, samples_of(circuit.identification)
    rms_mm = _rms(run.channel("displacement") * 1e3 - _simulated_mm(run))
    actual, simulated = _simulate_second_half(circuit.identification)
    residual, span = _rms(actual - simulated), float(np.ptp(codes.y))
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
    many = np.array([list(_deviations(_identify_on_card(SKEWED, INFERRED.plant, seed)).values()) for seed in SEEDS])
    return {
        "deviations": _deviations(_identify(circuit.identification)),
        "seeds_within_3_percent": int((np.abs(many) <= 0.03).all(axis=1).sum()),
        "seeds": len(SEEDS),
        "mean_deviations": many.mean(axis=0).tolist(),
        "deviations_with_an_early_edge": _deviations(_identify_with_early_edge()),
        "deviations_of_other_readings": {
            "the inferred plant without the skew": _deviations(_identify_on_card(NOISY, INFERRED.plant, SEED)),
            "shock absorber of section 4.2": _deviations(Arx.of(SHOCK.plant)),
            "front suspension of section 4.4.1": _deviations(Arx.of(FRONT.plant)),
            "the last plant of section 4.4.1 (M = 30)": _deviations(Arx.of(PROFILE[-1].plant)),
        },
    }


def _deviations(arx: Arx) -> dict[str, float]:
    """Relative deviations from the three legible coefficients of Equ 5.4."""
    return {name: getattr(arx, name) / getattr(PRINTED_5_4, name) - 1.0 for name in ("a1", "b0", "b1")}


def _identify_on_card(rig: str, plant: Plant, seed: int) -> Arx:
    """Batch estimate of the first 1000 samples, in this process."""
    scenario = dataclasses.replace(IDENTIFICATION.with_plant(plant), samples=FIRST_N)
    codes = play_alone(rig, scenario, seed)
    return Arx.scaled(codes.track(BATCH).theta[-1], codes.b_scale)


def _identify_with_early_edge() -> Arx:
    """Batch estimate if both channels are sampled at once and each edge of the force comes 10 us before."""
    u, y = (square(FIRST_N, 1470.0, 200) + 1470.0), np.empty(FIRST_N)
    before, after = (SampledPlant.from_plant(INFERRED.plant, part * PERIOD_S) for part in (1.0 - EARLY, EARLY))
    state = before.at_rest
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
    codes, theta = samples_of(circuit.identification), _batch_theta(circuit.identification)
    phi = _equations(codes.u[:FIRST_N], codes.y[:FIRST_N])
    residual = codes.y[2:FIRST_N] - phi @ theta
    covariance = float(residual @ residual) / (len(residual) - phi.shape[1]) * np.linalg.inv(phi.T @ phi)
    to_si = codes.b_scale * 1e5
    variances: list[float] = (np.diag(covariance)[:4] * [1.0, 1.0, to_si**2, to_si**2]).tolist()
    return variances


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
        "mean_between_faults": dataclasses.asdict(noisy.qualities[MEAN]),
        "mean_between_faults_12_bits_without_noise": dataclasses.asdict(quantised.qualities[MEAN]),
        "forgetting": dataclasses.asdict(noisy.qualities["forgetting"]),
        "default": dataclasses.asdict(noisy.qualities[OURS]),
        "filtered_live_order_2_quantised_mean_0.2_lsb": _filtered(quantised, 2, MEAN, 0.2),
        "filtered_live_order_4_noisy_prediction_error_2_lsb": _filtered(noisy, 4, ERROR, 2.0),
        "filtered_and_detrended_off_line": off_line,
        "theta_reconverged_n": {key: _theta_reconverged(noisy, key) for key in ("forgetting", MEAN)},
        "best_ceilings": {
            f"{data} {name}": _best(sweep) for data, by_name in sweeps.items() for name, sweep in by_name.items()
        },
    }


def _filtered(tracked: TrackedRun, order: int, key: str, ceiling_lsb: float) -> dict[str, Any]:
    """Quality of a scheme on data from a causal filter, as in a live estimator."""
    config = schemes(LIVE, ceiling_lsb, ceiling_lsb)[key]
    return dataclasses.asdict(assess(filter_live(tracked.codes, order).track(config), tracked.segments))


def _theta_reconverged(tracked: TrackedRun, key: str) -> list[int | None]:
    """Samples from each change until a1, a2, b0, b1 stay within 5 % of the batch estimates of the stretches."""
    estimates = _in_si(tracked.tracks[key], tracked.codes.b_scale)
    return reconverged(estimates / _batch_estimates(tracked.run) - 1.0, tracked.segments)


def _b_spread(tracked: TrackedRun, key: str) -> float:
    """Pooled standard deviation of b0 and b1 in the second halves of the stretches, 1e-6 m/N."""
    b = _in_si(tracked.tracks[key], tracked.codes.b_scale)[:, 2:] * 1e6
    late = [b[(start + end) // 2 : end] for start, end, _ in tracked.run.segments]
    return float(np.sqrt(np.mean([each.var(axis=0) for each in late])))
