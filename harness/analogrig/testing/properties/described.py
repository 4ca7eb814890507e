"""Experiments that compare a device with the reference of the estimator that it describes."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.catalogue import Cause
from analogrig.devices.catalogue_description import CatalogueDescription, has_our_estimator
from analogrig.devices.device import Device
from analogrig.devices.estimator import Estimator
from analogrig.devices.registry import recorded
from analogrig.errors import DeviceRefused
from analogrig.run import Run, missing_samples
from analogrig.scenario import Scenario
from analogrig.testing.properties.experiments import device_description
from analogrig.testing.reference.cases import CASES, HUM, ReferenceCase, SpoiledRig, U, Y, hum
from analogrig.testing.reference.comparison import Expected, expected_of
from analogrig.testing.reference.drawn import drawn
from analogrig.testing.reference.fit import SETTLING_N, STATED_N, hum_in_second_block
from analogrig.testing.statement import Finding, Inconclusive, Play, experiment

ROUNDING = 0.1
"""Largest deviation of an innovation from the reference, in standard deviations of that innovation: float32 may cost a
tenth of what noise costs. Half of it is the most that was measured (harness/docs/background/properties.md)."""

THETA_ROUNDING = 0.2
"""The same of an element of theta, in its own standard deviations."""

STATISTIC_ROUNDING = 0.2
"""The same of the statistic, relative to the statistic and 1."""

EXTENT_ROUNDING = 0.0075
"""The same of the extent of a change, in its own standard deviations."""


FREQUENCY_UNITS, STRENGTH_UNITS = 65_536, 256
"""Units of a Misfit."""

MISFIT_ROUNDING = 1e-3
"""Largest deviation of the strength of a misfit, relative to it."""


@experiment
def computes_what_it_describes(play: Play, scenario: Scenario, seed: int, case: str, tries: int) -> Finding:
    """Finding: estimates, innovations, statistic, flags, alarms, diagnoses and counters are those of the reference.

    A play is judged up to where rounding may decide a threshold. Of ``tries`` seeds one has to be judged whole, unless
    there is but one.

    :param case: name of one of ``analogrig.testing.reference.cases``, or the number of a drawn one.
    """
    description = described_estimator(play)
    chosen = drawn(int(case)) if case.isdecimal() else CASES[case]
    rig = SpoiledRig(play.bench.rig, chosen.spoil) if chosen.spoil else play.bench.rig
    with _configured(play, description, chosen) as device:
        for number in range(tries):
            run = play.on(rig, device)(scenario, seed + number, allow_inconclusive=True).run
            expected = expected_for(run)
            wrong = next(itertools.chain(run.conditions.faults, differences(run, expected), _altered(run)), "")
            if wrong or tries == 1 or not expected.is_doubtful:
                judged = f"{expected.sure_n} of {run.samples} samples as described"
                return Finding(not wrong, f"{case}: {wrong or judged}", run=run)
    raise Inconclusive(f"{case}: rounding may decide a threshold in each of {tries} plays")


@experiment
def states_hum(play: Play, scenario: Scenario, seed: int) -> Finding:
    """Finding: in two runs the device states a hum once, with the frequency and the strength in its innovations."""
    description = described_estimator(play)
    with _configured(play, description, HUM) as device:
        player = play.on(SpoiledRig(play.bench.rig, hum), device)
        runs = [player(scenario, seed + number, allow_inconclusive=True).run for number in range(2)]
    for run in runs:
        if run.flags[SETTLING_N:].any() or len(run.alarm_index) or run.conditions.faults:
            raise Inconclusive("the device raised an alarm, or left out samples")
        expected = hum_in_second_block(run.innovation.astype(np.float64), HUM.settings["noise_variance"])
        stated = list(zip(run.misfit_index.tolist(), run.misfit_cause.tolist(), strict=True))
        frequency, strength = run.misfit_frequency.tolist(), run.misfit_strength.tolist()
        is_right = (
            stated == [(STATED_N, Cause.HUM)]
            and abs(frequency[0] - expected.frequency) < 1.0 / FREQUENCY_UNITS
            and abs(strength[0] - expected.strength) < MISFIT_ROUNDING * expected.strength + 1.0 / STRENGTH_UNITS
        )
        if not is_right:
            break
    return Finding(is_right, f"stated {stated} {frequency} {strength}, expected {STATED_N} {expected}", run=run)


def described_estimator(play: Play) -> CatalogueDescription:
    """Description of the device, if it declares the estimator of the reference; else the test is skipped."""
    description = device_description(play.bench.dut)
    if not has_our_estimator(description):
        pytest.skip(f"needs a device with the settings of EstimatorConfig, not {play.bench.dut.name}")
    if description.computes != "est":
        pytest.skip(f"needs a device with computes = 'est', not {description.computes!r}")
    return description


@contextlib.contextmanager
def _configured(play: Play, description: CatalogueDescription, case: ReferenceCase) -> Iterator[Device]:
    """The device with the settings of a case; the test is skipped if its build lacks them."""
    with contextlib.ExitStack() as stack:
        device = play.bench.dut
        if case.exchange and "in-process" in description.capabilities:
            device = stack.enter_context(dataclasses.replace(description, exchange=case.exchange).connect())
        try:
            device.configure(**{"arl0": None, **case.settings})  # a ceiling or another trigger goes without it
        except DeviceRefused as error:
            if case.is_optional:
                pytest.skip(str(error))
            raise
        yield device


def expected_for(run: Run) -> Expected:
    """Answers of the reference to the samples of a run."""
    description = recorded(run.conditions.dut)
    assert has_our_estimator(description)
    u, y = (np.ascontiguousarray(run.codes[:, channel]) for channel in (U, Y))
    return expected_of(description.estimator, u, y, ~missing_samples(run.clipped))


def differences(run: Run, expected: Expected) -> Iterator[str]:
    """Differences of a run from the reference, the most telling first, as far as rounding decides nothing."""
    sure = slice(0, expected.sure_n)
    if not np.array_equal(run.flags[sure], expected.flags[sure]):
        at = int(np.argmax(run.flags != expected.flags))
        yield f"flags at sample {at} are {run.flags[at]:#04x}, expected {expected.flags[at]:#04x}"
    alarms, wanted = ([k for k in each if k < sure.stop] for each in (run.alarm_index.tolist(), expected.alarms))
    if alarms != wanted:
        yield f"alarms at {alarms[:9]}, expected at {wanted[:9]}"
    for name, deviation in (
        ("innovation", ROUNDING * expected.deviation),
        ("theta", THETA_ROUNDING * expected.theta_deviation),
        ("statistic", STATISTIC_ROUNDING * (1.0 + expected.statistic)),
    ):
        yield from _beyond(name, getattr(run, name)[sure], getattr(expected, name)[sure], deviation[sure])
    if not np.array_equal(run.alarm_statistic, run.statistic[run.alarm_index]):
        yield "an alarm has another statistic than its sample"
    yield from _other_diagnoses(run, expected)
    for name, count in expected.counters.items() if sure.stop == run.samples else ():
        if run.conditions.counters[name] != count:
            yield f"{run.conditions.counters[name]} {name} counted, expected {count}"


def _altered(run: Run) -> Iterator[str]:
    """Values that the messages have altered, if the same estimator can be had without messages."""
    description = recorded(run.conditions.dut)
    if not has_our_estimator(description) or "blocks" not in description.capabilities:
        return
    direct = Estimator(description.estimator, library=description.estimator_library)
    steps = direct.run(run.codes[:, U], run.codes[:, Y], ~missing_samples(run.clipped))
    for name in ("theta", "innovation", "statistic"):
        if getattr(run, name).tobytes() != getattr(steps, name).tobytes():
            yield f"{name} is another than without messages"


def _other_diagnoses(run: Run, expected: Expected) -> Iterator[str]:
    sure = run.diagnosis_index < expected.sure_diagnoses_n
    named = np.column_stack([run.diagnosis_index, run.diagnosis_change, run.diagnosis_onset])[sure].tolist()
    diagnoses = [each for each in expected.diagnoses if each[0] < expected.sure_diagnoses_n]
    wanted = [list(each[:3]) for each in diagnoses]
    if named != wanted:
        yield f"diagnoses (sample, change, onset) {named}, expected {wanted}"
        return
    extents, deviations = (np.array([each[i] for each in diagnoses]) for i in (3, 4))
    yield from _beyond("extent", run.diagnosis_extent[sure], extents, EXTENT_ROUNDING * deviations)


def _beyond(
    name: str, found: NDArray[np.float32], expected: NDArray[np.float64], allowed: NDArray[np.float64]
) -> Iterator[str]:
    if found.shape != expected.shape:
        yield f"{name} has the shape {found.shape}, expected {expected.shape}"
        return
    outside = np.argwhere(~(np.abs(found - expected) <= allowed + 1e-6 * (1.0 + np.abs(expected))))
    if len(outside):
        at = tuple(outside[0].tolist())
        element = f"[{at[1]}]" if len(at) > 1 else ""
        yield f"{name}{element} at sample {at[0]} is {found[at]:g}, expected {expected[at]:g} +- {allowed[at]:.2g}"
