"""The circuit of chapter 5, played on the emulated computer: the scenarios, and their recordings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from analogrig.bench import Bench, uninterrupted
from analogrig.devices.dut import connect
from analogrig.devices.estimator_config import EstimatorConfig
from analogrig.devices.host import HostDevice
from analogrig.plant import Plant, physical_parameters
from analogrig.rigs.description import open_rig
from analogrig.run import Run, Segment
from analogrig.scenario import PlantChoice, Scenario, Tweak
from analogrig_emulator import Excitation
from analogrig_thesis.chapter4 import ERROR_CEILING, UNITS_PER_M, WARM_UP_N
from analogrig_thesis.document import Signal
from analogrig_thesis.model import PROFILE
from analogrig_thesis.schemes import OURS, PLAIN, Scheme, schemes
from analogrig_thesis.tracking import Track, track, tracked

SEED = 1995

QUANTISED, NOISY, SKEWED = "emulator-ideal", "emulator", "emulator-skewed"
"""Rigs: 12 bits alone; with offsets and 1 LSB of noise; and with the force converted before the displacement."""

INFERRED = Plant(30.5, 1505.0, 24500.0)
"""The plant that comes nearest to Equ 5.4 on the skewed card; nothing in the text names it."""

PATIENCE_S = 20.0
"""With the device process, on a machine that has other things to do."""

MEAN_CEILING = 500.0
"""Section 5.5"""

COMPARISON = Scenario(
    name="fig-5.4",
    samples=400,
    excitation=Excitation(frequency_hz=200.0),
    plant=PlantChoice(set="shock"),
)

IDENTIFICATION = Scenario(
    name="fig-5.5",
    samples=2000,
    excitation=Excitation(frequency_hz=100.0),
    plant=PlantChoice(
        mass_kg=INFERRED.mass_kg,
        damping_n_s_per_m=INFERRED.damping_n_s_per_m,
        stiffness_n_per_m=INFERRED.stiffness_n_per_m,
    ),
)


def _tweaks(starts: Sequence[int]) -> tuple[Tweak, ...]:
    """Every pot is set at each, also where it stays."""
    plants = (segment.plant for segment in PROFILE[1:])
    return tuple(Tweak(start, **vars(plant)) for start, plant in zip(starts, plants, strict=True))


TRACKING = Scenario(
    name="fig-5.7",
    samples=1000,
    excitation=Excitation(frequency_hz=100.0, phase=0.25),
    tweaks=_tweaks((200, 400, 600, 800)),
    description="the four changes of section 4.4.1, each while the force is on",
)

BATCH = dataclasses.replace(PLAIN, offset=True, p0=1e6, p0_offset=1e9)
"""Recursive least squares with a prior that says nothing: after the last sample the batch estimate (Equ 3.17)."""

LIVE = dataclasses.replace(PLAIN, offset=True, p0_offset=1e6)
"""Codes have a zero of their own: the offset stands for the detrending of section 4.3."""


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """One play of the circuit, and what each scheme, as a device on the link, made of the same samples."""

    run: Run
    """As it was played, with the first scheme."""
    tracks: Mapping[str, Track]

    @property
    def segments(self) -> tuple[Segment, ...]:
        return self.run.conditions.segments


def circuit_schemes(m_per_code: float) -> tuple[Scheme, ...]:
    """The thesis's five with its ceilings in codes, and ours as it is shipped."""
    error, mean = (ceiling / UNITS_PER_M / m_per_code for ceiling in (ERROR_CEILING, MEAN_CEILING))
    return (*schemes(LIVE, error, mean, WARM_UP_N), OURS)


def play(rig_name: str, scenario: Scenario, config: EstimatorConfig, seed: int = SEED) -> Run:
    """On the emulated circuit, over the pseudo terminal, through the C estimator in a process of its own.

    :raises DeviceError, LinkError, RigError: the run failed.
    """
    device = HostDevice(name="host", exchange="block", estimator=config, timeout_s=PATIENCE_S)
    with open_rig(rig_name) as rig, connect(device) as dut:
        return uninterrupted(Bench(rig, dut).play(scenario, seed))


def record(rig_name: str, scenario: Scenario, seed: int = SEED) -> Recording:
    """Every scheme on the same samples; the recording keeps the thesis's own trigger."""
    m_per_code = _m_per_code(rig_name)
    runs = {scheme.key: play(rig_name, scenario, scheme.config, seed) for scheme in circuit_schemes(m_per_code)}
    kept = runs["mean-between-faults"]
    return Recording(kept, {key: tracked(run) for key, run in runs.items()})


def _m_per_code(rig_name: str) -> float:
    with open_rig(rig_name) as rig:
        return rig.perform(TRACKING, 0).channels["displacement"].lsb


def codes(rig_name: str, scenario: Scenario, seed: int) -> tuple[Signal, Signal, float, float]:
    """Force and displacement (n,) in codes, newtons and metres to a code: the rig alone."""
    with open_rig(rig_name) as rig:
        performance = rig.perform(scenario, seed)
        samples = np.concatenate([block.codes for block in performance.blocks]).astype(np.float64)
    force, displacement = performance.channels["force"], performance.channels["displacement"]
    return samples[:, 0], samples[:, 1], force.lsb, displacement.lsb


def track_codes(config: EstimatorConfig, samples: tuple[Signal, Signal, float, float]) -> Track:
    """As ``tracked``, in this process: for sweeps and many seeds."""
    u, y, n_per_code, m_per_code = samples
    each = track(config, u, y)
    parameters = physical_parameters(each.theta, dataclasses.asdict(config), n_per_code, m_per_code, 0.01)
    return dataclasses.replace(each, parameters=parameters)


CUTOFFS_HZ = (5.0, 10.0, 20.0)
"""Of the filter that section 4.3 asks for and does not describe, in problem time."""


def conditioned(run: Run, cutoff_hz: float = CUTOFFS_HZ[0]) -> tuple[Signal, Signal]:
    """Force [N] and displacement [0.1 um] (n,), off line as in section 4.3: a low-order low-pass Butterworth filter on
    both, their means removed, scaled."""
    from scipy.signal import butter, lfilter

    b, a = butter(2, 2.0 * cutoff_hz * run.conditions.sample_period_problem_s)
    force, displacement = run.channel("force"), run.channel("displacement") * UNITS_PER_M
    u, y = (lfilter(b, a, each - each.mean()) for each in (force, displacement))
    return np.asarray(u), np.asarray(y)


def conditioned_tracks(run: Run, cutoff_hz: float = CUTOFFS_HZ[0]) -> dict[str, Track]:
    """The thesis's five with its ceilings, in this process, and its mean with magnitudes."""
    u, y = conditioned(run, cutoff_hz)
    configs = {each.key: each.config for each in schemes(PLAIN, ERROR_CEILING, MEAN_CEILING, WARM_UP_N)}
    configs["mean-of-magnitudes"] = dataclasses.replace(configs["mean-between-faults"], absolute=True)
    return {key: track(config, u, y, UNITS_PER_M) for key, config in configs.items()}


def run_codes(run: Run) -> tuple[Signal, Signal, float, float]:
    """As ``codes``, of a recording."""
    channels = run.conditions.channels
    samples = run.codes.astype(np.float64)
    return samples[:, 0], samples[:, 1], channels["force"].lsb, channels["displacement"].lsb
