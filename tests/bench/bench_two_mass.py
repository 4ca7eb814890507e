"""Two-mass quarter car: delay of the estimator of order 4, and its false alarms."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from analogrig.datasheet import DEFAULT_ARL0
from analogrig.devices.library import DirectDevice, InprocDevice
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.bursts import BURST, upper_count
from analogrig.judging.courses import first_at_level
from analogrig.plant import Plant
from analogrig.program import Program
from analogrig_emulator import Excitation

from .bench_reality import Delays, delays_of
from .emulated import Emulated
from .figure import Figure
from .played import HIGH_V, LOW_V, Change
from .shipped import ONSET_N, ONSET_SPAN_N, answers_to, direct, exposure_n

PROGRAM = Program.load("two-mass")

SAMPLE_PERIOD_S = 50e-6
POLES = PROGRAM.poles(Plant.of(PROGRAM).values, PROGRAM.equations.speed * SAMPLE_PERIOD_S)

PARAMETERS = ("M2", "B2", "K2", "K1", "M1", "B1")

FACTORS = (0.8, 1.2)

HORIZON_N = 300

SEED, HEALTHY_SEED = 700_000, 800_000

HEALTHY_N = 100_000
"""Samples of a run without a change."""

CONFIDENCE = 0.999

LEAST_NATS = (0.983 / 0.43 - 1.0) / 2.0
"""Information a sample from which the trigger's sum rises: its drift is 0.43 z^2 - 0.983."""

NOTE = f"""Program two-mass on the emulated computer: TL07x amplifiers, 12 bits, 1 LSB, random phase. The
device is `inproc` with the settings that the program chooses, na = 4, nb = 5. Changes are 20 % up
and down in turn. Delays and bounds are means over the detected changes. A bound comes from
noise-free plays with and without the change.

Changes of M1 and B1 are mostly missed. They carry 0.37 nats a sample, and the trigger's sum rises
from {LEAST_NATS:.2f} nats."""


def device() -> DirectDevice:
    """Device set for the program two-mass."""
    return direct(InprocDevice(name="two-mass", estimator=EstimatorConfig.of_poles(POLES)))


def _draw(rng: np.random.Generator, samples: int) -> Excitation:  # noqa: ARG001 - the same for any length
    return Excitation(low_v=LOW_V, high_v=HIGH_V, frequency_hz=200.0, phase=float(rng.uniform()))


CONDITION = Emulated(_draw, program=PROGRAM.circuit)


def delays(device: DirectDevice, parameter: str, trials: int) -> Delays:
    """Delays of changes of one parameter."""
    base = SEED + 1000 * PARAMETERS.index(parameter)
    onsets = (ONSET_N + np.random.default_rng(base).integers(0, ONSET_SPAN_N, trials)).tolist()
    changes = [Change(parameter, FACTORS[i % 2], onset) for i, onset in enumerate(onsets)]
    samples = ONSET_N + ONSET_SPAN_N + HORIZON_N
    alarms, bounds_n = [], []
    for onset, played in zip(onsets, CONDITION.play(range(base, base + trials), samples, changes), strict=True):
        end = onset + 1 + HORIZON_N
        alarms.append([alarm.index for alarm in answers_to(device, played).alarms if alarm.index < end])
        bounds_n.append(first_at_level(played.information[onset + 1 : end], math.log(DEFAULT_ARL0)))
    return delays_of(alarms, onsets, bounds_n)


def false_alarms(device: DirectDevice, runs: int, samples: int = HEALTHY_N) -> tuple[int, int]:
    """False alarms and armed samples of runs without a change."""
    seeds = range(HEALTHY_SEED, HEALTHY_SEED + runs)
    found = exposed = 0
    for played in CONDITION.play(seeds, samples, [None] * runs):
        answers = answers_to(device, played)
        found += len(answers.alarms)
        exposed += exposure_n(device, played, answers)
    return found, exposed


def figures(trials: int = 100, runs: int = 100) -> Iterator[Figure]:
    """Delay of changes by parameter, and the false alarms."""
    made = device()
    for parameter in PARAMETERS:
        yield _figure(parameter, delays(made, parameter, trials))
    alarms, armed = false_alarms(made, runs)
    upper = upper_count(alarms, CONFIDENCE, burst=BURST) / armed
    remark = f"{alarms} in {armed} armed samples; limit 1e-5, one-sided {CONFIDENCE:.1%}, bursts of {BURST:g}"
    yield Figure("false-alarm rate", upper, "per sample at most", remark)


def _figure(parameter: str, found: Delays) -> Figure:
    ratio, error = found.ratio()
    nats = math.log(DEFAULT_ARL0) / found.bound_n.mean() if len(found.bound_n) else math.nan
    remark = f"missed {found.missed} of {found.trials}; +- {error:.2g}; {nats:.2g} nats a sample"
    return Figure(f"delay, {parameter} 20 %", ratio, "bounds", remark)
