"""Experiments that compare a device with the bundled library, which its device file claims that it runs."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from analogrig.claims.claim_check import ClaimCheck, compare_with_library
from analogrig.devices.catalogue_device import has_our_estimator
from analogrig.devices.device import Device
from analogrig.errors import ConfigurationError, DeviceRefused
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig.testing.properties.cases import PlayedCase, SpoiledRig, case_of, first_with_samples
from analogrig.testing.properties.experiments import device_description, rig_with_gaps
from analogrig.testing.statement import Finding, Inconclusive, Play, experiment

GAPS = ((0, 1), (97, 1), (150, 2), (201, 3), (260, 17), (340, 64), (500, 1), (502, 1))
"""First sample and length of each gap, and one more sample, the last."""


@experiment
def answers_as_claimed(play: Play, scenario: Scenario, seed: int, plays: int, *, gaps: bool = False) -> Finding:
    """Finding: the answers in successive plays are those of the bundled library, configured as claimed.

    :param gaps: declare samples missing.
    """
    needs_claim(play)
    before: Run | None = None
    failed: list[Finding] = []
    agreed = ""
    for number in range(plays):
        run = _play(play, scenario, seed + number)
        if gaps:
            missing = np.zeros(run.samples, np.bool_)
            for first, length in (*GAPS, (run.samples - 1, 1)):
                missing[first : first + length] = True
            rig = rig_with_gaps(run, missing)
            run = _play(play.on(rig, play.bench.dut), rig.scenario(), seed + number)
        comparison = _compared(run, before)
        if not comparison.agrees:
            failed.append(Finding(holds=False, why=comparison.summary, run=run))
            if comparison.cause:
                return failed[-1]
        before, agreed = run, comparison.summary
    return failed[0] if failed else Finding(holds=True, why=agreed)


@experiment
def computes_what_it_describes(play: Play, scenario: Scenario, seed: int, case: str) -> Finding:
    """Finding: the answers to the samples of a case are those of the bundled library with the same settings.

    A device without the settings of ``EstimatorConfig`` keeps its own. It plays the cases with the same samples once.

    :param case: name of one of ``analogrig.testing.properties.cases``, or the number of a drawn one.
    """
    needs_claim(play)
    chosen = case_of(case)
    rig = play.bench.rig if chosen.spoil is None else SpoiledRig(play.bench.rig, chosen.spoil)
    with _configured(play, case, chosen) as device:
        run = _play(play.on(rig, device), scenario, seed)
    comparison = _compared(run, explain=False)
    return Finding(comparison.agrees, f"{case}: {comparison.summary}", run=run)


def needs_claim(play: Play) -> None:
    """Skip the test unless the device claims to run the bundled estimator."""
    name, description = play.bench.dut.name, device_description(play.bench.dut)
    if getattr(description, "estimator", None) is None:
        pytest.skip(f"needs [estimator] in the device file of {name}: the configuration of est.c it runs")
    if (computes := getattr(description, "computes", "est")) != "est":
        pytest.skip(f"needs a device with computes = 'est', not {computes!r}: {name}")


@contextlib.contextmanager
def _configured(play: Play, name: str, case: PlayedCase) -> Iterator[Device]:
    """The device with the settings of a case; the test is skipped if its build lacks them."""
    device, description = play.bench.dut, device_description(play.bench.dut)
    if not has_our_estimator(description):
        if (first := first_with_samples(name)) != name:
            pytest.skip(f"needs a device with the settings of EstimatorConfig: the samples are those of {first!r}")
        yield device
        return
    with contextlib.ExitStack() as stack:
        if case.exchange and "in-process" in description.capabilities:
            device = stack.enter_context(dataclasses.replace(description, exchange=case.exchange).connect())
        try:
            device.configure(**{"arl0": None, **case.settings})  # a ceiling or another trigger goes without it
        except DeviceRefused as error:
            if case.is_optional:
                pytest.skip(str(error))
            raise
        yield device


def _play(play: Play, scenario: Scenario, seed: int) -> Run:
    return play(scenario, seed, allow_inconclusive=True).run


def _compared(run: Run, before: Run | None = None, *, explain: bool = True) -> ClaimCheck:
    """Comparison of a run.

    :raises Inconclusive: there is nothing to compare, or a fault ended a run that agrees.
    """
    if not run.samples:
        raise Inconclusive(next(iter(run.conditions.faults), "no sample was answered"), run)
    try:
        comparison = compare_with_library(run, before, explain=explain)
    except ConfigurationError as error:
        return ClaimCheck(run.samples, (), 0, (str(error),))
    if comparison.agrees and run.conditions.faults:
        raise Inconclusive(run.conditions.faults[0], run)
    return comparison
