"""Runs of chapter 5: its circuit on the emulated computer, by scenario."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cached_property

import numpy as np

from analogrig.bench import Bench, raise_if_interrupted
from analogrig.config import fixtures
from analogrig.devices.dut import connect
from analogrig.devices.host import HostDevice
from analogrig.estimator_config import EstimatorConfig
from analogrig.plant import Plant, Segment
from analogrig.rigs.description import open_rig
from analogrig.rigs.rig import Rig
from analogrig.run import Run
from analogrig.scenario import PlantChoice, PotChange, Scenario
from analogrig_emulator import Excitation
from analogrig_thesis.document import Signal
from analogrig_thesis.plants import PERIOD_S, PROFILE
from analogrig_thesis.schemes import ERROR_CEILING, OURS, PLAIN, UNITS_PER_M, WARM_UP_N, schemes
from analogrig_thesis.tracking import Track, TrackQuality, assess, track, track_of_run

SEED = 1995

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


@dataclasses.dataclass(frozen=True, eq=False)
class ScaledSamples:
    """Force ``u`` and displacement ``y`` (n,), in codes of the card or in other units."""

    u: Signal
    y: Signal
    n_per_unit: float
    m_per_unit: float

    @classmethod
    def of_run(cls, run: Run) -> ScaledSamples:
        """Return the codes of a recorded run."""
        channels, samples = run.conditions.channels, run.codes.astype(np.float64)
        return cls(samples[:, 0], samples[:, 1], channels["force"].lsb, channels["displacement"].lsb)

    @classmethod
    def play(cls, rig_name: str, scenario: Scenario, seed: int) -> ScaledSamples:
        """Play a scenario on a rig without a device.

        :raises RigError: the rig failed.
        """
        with _shipped_rig(rig_name) as rig:
            performance = rig.perform(scenario, seed)
            samples = np.concatenate([block.codes for block in performance.blocks]).astype(np.float64)
        channels = performance.channels
        return cls(samples[:, 0], samples[:, 1], channels["force"].lsb, channels["displacement"].lsb)

    @property
    def b_scale(self) -> float:
        """Factor from b's in these units to b's in metres per newton."""
        return self.m_per_unit / self.n_per_unit

    def track(self, config: EstimatorConfig) -> Track:
        """Run an estimator in this process: for sweeps and many seeds."""
        return track(config, self.u, self.y, self.m_per_unit, self.n_per_unit)

    def filtered(self, order: int) -> ScaledSamples:
        """Return the samples after a causal Butterworth filter, as in a live estimator."""
        from scipy.signal import butter, lfilter

        b, a = butter(order, 2.0 * LIVE_CUTOFF_HZ * PERIOD_S)
        u, y = (np.asarray(lfilter(b, a, each - each[0]) + each[0]) for each in (self.u, self.y))
        return dataclasses.replace(self, u=u, y=y)


@dataclasses.dataclass(frozen=True, eq=False)
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
    def codes(self) -> ScaledSamples:
        """Codes of the run."""
        return ScaledSamples.of_run(self.run)

    @cached_property
    def qualities(self) -> Mapping[str, TrackQuality]:
        """Quality of each scheme."""
        return {key: assess(each, self.segments) for key, each in self.tracks.items()}


@dataclasses.dataclass(frozen=True, eq=False)
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
    m_per_unit = ScaledSamples.play(rig_name, TRACKING, 0).m_per_unit
    runs = {key: _play(rig_name, TRACKING, config) for key, config in circuit_schemes(m_per_unit).items()}
    return TrackedRun(runs["mean-between-faults"], {key: track_of_run(run) for key, run in runs.items()})


def filter_off_line(run: Run, cutoff_hz: float = CUTOFFS_HZ[0]) -> ScaledSamples:
    """Return newtons and units of 0.1 um, filtered by order 2 and without their means (section 4.3)."""
    from scipy.signal import butter, lfilter

    b, a = butter(2, 2.0 * cutoff_hz * run.conditions.sample_period_problem_s)
    force, displacement = run.channel("force"), run.channel("displacement") * UNITS_PER_M
    u, y = (np.asarray(lfilter(b, a, each - each.mean())) for each in (force, displacement))
    return ScaledSamples(u, y, 1.0, 1.0 / UNITS_PER_M)


def filtered_schemes(run: Run, cutoff_hz: float = CUTOFFS_HZ[0]) -> dict[str, Track]:
    """Tracks on data filtered off line: the thesis's five schemes, and its mean with magnitudes."""
    configs = schemes(PLAIN, ERROR_CEILING, MEAN_CEILING, WARM_UP_N)
    configs["mean-of-magnitudes"] = dataclasses.replace(configs["mean-between-faults"], absolute=True)
    return {key: filter_off_line(run, cutoff_hz).track(config) for key, config in configs.items()}
