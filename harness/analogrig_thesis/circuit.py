"""Runs of chapter 5: its circuit on the emulated computer, by scenario; and all schemes on the same data."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from analogrig.bench import Bench, raise_if_interrupted
from analogrig.config import fixtures
from analogrig.devices.dut import connect
from analogrig.devices.host import HostDevice
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.verdict import judge
from analogrig.plant import Plant
from analogrig.rigs.description import open_rig
from analogrig.rigs.rig import Rig
from analogrig.run import Channel, Run, Segment
from analogrig.scenario import PlantChoice, PotChange, Scenario
from analogrig_emulator import Excitation
from analogrig_thesis.chapter4 import Simulation
from analogrig_thesis.plants import PERIOD_S, PROFILE
from analogrig_thesis.schemes import (
    ERROR_CEILING,
    MEAN,
    OURS,
    PLAIN,
    UNITS_PER_M,
    WARM_UP_N,
    Samples,
    Track,
    TrackQuality,
    assess,
    schemes,
)
from analogrig_thesis.texts import Signal

SEED = 1995
SEEDS = range(20)

RECORDED = ("fig-5.4", "fig-5.5", "fig-5.7-quantised", "fig-5.7")
"""Names of the recordings."""

QUANTISED, NOISY, SKEWED = "emulator-ideal", "emulator", "emulator-skewed"
"""Rigs: 12 bits alone; with offsets and 1 LSB of noise; and with the force converted before the displacement."""

INFERRED = Plant(30.5, 1505.0, 24500.0)
"""Plant that comes nearest to Equ 5.4 on the skewed card; the text does not name it."""

CUTOFFS_HZ = (5.0, 10.0, 20.0)
"""Cut-off frequencies at the suspension for the filter of section 4.3, which the text does not describe."""

LIVE_CUTOFF_HZ = 10.0

TIMEOUT_S = 20.0
"""Time-out of the device process, generous for a loaded machine."""

MEAN_CEILING = 500.0
"""Section 5.5, in units of 0.1 um."""

CODES_PER_M = 4096 / 0.1996
"""Scale of the card: 10 V are 0.1996 m."""

COMPARISON = Scenario(
    name="fig-5.4", samples=400, excitation=Excitation(frequency_hz=200.0), plant=PlantChoice(set="shock")
)

IDENTIFICATION = Scenario(
    name="fig-5.5", samples=2000, excitation=Excitation(frequency_hz=100.0), plant=PlantChoice(**vars(INFERRED))
)

TRACKING = Scenario(
    name="fig-5.7",
    samples=1000,
    excitation=Excitation(frequency_hz=100.0, phase=0.25),
    # Each change sets all pots, also those that stay.
    tweaks=tuple(
        PotChange(start, **vars(segment.plant))
        for start, segment in zip((200, 400, 600, 800), PROFILE[1:], strict=True)
    ),
    description="the four changes of section 4.4.1, each while the force is on",
)

BATCH = dataclasses.replace(PLAIN, offset=True, p0=1e6, p0_offset=1e9)
"""Recursive least squares with a vague prior: the batch estimate (Equ 3.17) after the last sample."""

LIVE = dataclasses.replace(PLAIN, offset=True, p0_offset=1e6)
"""Codes have a zero of their own: the offset replaces the detrending of section 4.3."""


def samples_of(run: Run) -> Samples:
    """Codes of a recorded run."""
    return _as_samples(run.codes, run.conditions.channels)


def play_alone(rig_name: str, scenario: Scenario, seed: int) -> Samples:
    """Play a scenario on a rig without a device.

    :raises RigError: the rig failed.
    """
    with _shipped_rig(rig_name) as rig:
        performance = rig.perform(scenario, seed)
        codes = np.concatenate([block.codes for block in performance.blocks])
    return _as_samples(codes, performance.channels)


def _as_samples(codes: NDArray[np.uint16], channels: Mapping[str, Channel]) -> Samples:
    u, y = codes[:, :2].T.astype(np.float64)
    return Samples(u, y, channels["displacement"].lsb, channels["force"].lsb)


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
    def codes(self) -> Samples:
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
    """Settings by key: the thesis's five with its ceilings in codes, and ours as shipped."""
    error, mean = (ceiling / UNITS_PER_M / m_per_unit for ceiling in (ERROR_CEILING, MEAN_CEILING))
    return {**schemes(LIVE, error, mean, WARM_UP_N), OURS: EstimatorConfig()}


def _shipped_rig(name: str) -> Rig:
    """Open the rig of the package, whatever a rigs.toml of the working folder calls by its name."""
    return open_rig(str(fixtures() / "rigs" / f"{name}.toml"))


def _play(rig_name: str, scenario: Scenario, config: EstimatorConfig) -> Run:
    device = HostDevice(name="host", exchange="block", estimator=config, timeout_s=TIMEOUT_S)
    with _shipped_rig(rig_name) as rig, connect(device) as dut:
        return raise_if_interrupted(Bench(rig, dut).play(scenario, SEED))


def _play_all(rig_name: str) -> TrackedRun:
    """Play the changes once with each scheme; all get the same samples."""
    m_per_unit = play_alone(rig_name, TRACKING, 0).m_per_unit
    runs = {key: _play(rig_name, TRACKING, config) for key, config in circuit_schemes(m_per_unit).items()}
    return TrackedRun(runs[MEAN], {key: Track.of_run(run) for key, run in runs.items()})


def _filter(signal: Signal, order: int, cutoff_hz: float) -> Signal:
    return np.asarray(lfilter(*butter(order, 2.0 * cutoff_hz * PERIOD_S), signal))


def filter_live(samples: Samples, order: int) -> Samples:
    """Samples after a causal Butterworth filter, as in a live estimator."""
    u, y = (_filter(each - each[0], order, LIVE_CUTOFF_HZ) + each[0] for each in (samples.u, samples.y))
    return dataclasses.replace(samples, u=u, y=y)


def filter_off_line(run: Run, cutoff_hz: float = CUTOFFS_HZ[0]) -> Samples:
    """Newtons and units of 0.1 um, filtered by order 2 and without their means (section 4.3)."""
    signals = run.channel("force"), run.channel("displacement") * UNITS_PER_M
    u, y = (_filter(each - each.mean(), 2, cutoff_hz) for each in signals)
    return Samples(u, y, 1.0 / UNITS_PER_M)


def filtered_schemes(run: Run, cutoff_hz: float = CUTOFFS_HZ[0]) -> dict[str, Track]:
    """Tracks on data filtered off line: the thesis's five schemes, and its mean with magnitudes."""
    configs = schemes(PLAIN, ERROR_CEILING, MEAN_CEILING, WARM_UP_N)
    configs["mean-of-magnitudes"] = dataclasses.replace(configs[MEAN], absolute=True)
    return {key: filter_off_line(run, cutoff_hz).track(config) for key, config in configs.items()}


@dataclass(frozen=True)
class ComparedData:
    """Quality of each scheme on the same data."""

    name: str
    schemes: Mapping[str, TrackQuality]
    """Quality by key of the scheme."""
    bound_n: tuple[float | None, ...] = ()
    """Least mean latency of any detector with a false alarm in 100,000 samples, by change."""


@dataclass(frozen=True)
class SeedSummary:
    """Quality of one scheme over many seeds."""

    missed: int
    changes: int
    extra_alarms: int
    samples: int
    latency_n: float | None
    """Mean over the detected changes."""
    reconverged_n: float | None
    """Median; None if at least half of the changes have no convergence."""


@dataclass(frozen=True)
class SchemeComparison:
    """Tables of all schemes on the same data: the question of section 5.6."""

    data: tuple[ComparedData, ...]
    seeds: Mapping[str, SeedSummary]
    instructions: Mapping[str, int]
    """Instructions a sample of the C on x86-64, counted by tests/thesis/cost.py."""


def compare(simulation: Simulation, circuit: CircuitRuns) -> SchemeComparison:
    """Judge all tracks by the true plants; deterministic."""
    ours = Samples(simulation.u, simulation.y * CODES_PER_M, 1.0 / CODES_PER_M).track(EstimatorConfig())
    filtered = {key: assess(each, circuit.noisy.segments) for key, each in filtered_schemes(circuit.noisy.run).items()}
    del filtered["mean-of-magnitudes"]
    played: dict[str, list[TrackQuality]] = {}
    for seed in SEEDS:
        codes = play_alone(NOISY, TRACKING, seed)
        for key, config in circuit_schemes(codes.m_per_unit).items():
            played.setdefault(key, []).append(assess(codes.track(config), circuit.noisy.segments))
    return SchemeComparison(
        data=(
            ComparedData("simulation, no noise", {**simulation.qualities, OURS: assess(ours, PROFILE)}),
            _compare_on("circuit, 12 bits, no noise", circuit.quantised),
            _compare_on("circuit, 12 bits, 1 LSB of noise", circuit.noisy),
            ComparedData(
                "the same, filtered off line at 5 Hz and detrended as in section 4.3, which only the thesis needs",
                filtered,
            ),
        ),
        seeds={key: _summarise(each) for key, each in played.items()},
        instructions=json.loads((Path(__file__).parent / "cost.json").read_text(encoding="utf-8"))["instructions"],
    )


def _compare_on(name: str, tracked: TrackedRun) -> ComparedData:
    return ComparedData(name, tracked.qualities, tuple(tweak.bound_n for tweak in judge(tracked.run).tweaks))


def _summarise(qualities: Sequence[TrackQuality]) -> SeedSummary:
    latencies = [n for each in qualities for n in each.latency_n if n is not None]
    settled = [np.inf if n is None else float(n) for each in qualities for n in each.reconverged_n]
    median = float(np.median(settled))
    return SeedSummary(
        missed=sum(each.missed for each in qualities),
        changes=len(settled),
        extra_alarms=sum(each.extra_alarms for each in qualities),
        samples=len(qualities) * TRACKING.samples,
        latency_n=float(np.mean(latencies)) if latencies else None,
        reconverged_n=median if np.isfinite(median) else None,
    )
