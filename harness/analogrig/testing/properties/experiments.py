"""Shipped properties as experiments: each makes its plays from a scenario and a first seed, and returns a finding.

The tests beside this module draw scenarios and state limits. A failure keeps both, and the function that failed judges
them again (``analogrig.testing.statement``).
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.bench import Bench, raise_if_interrupted
from analogrig.campaigns.together import can_be_direct, direct_bench
from analogrig.devices.catalogue_device import CatalogueDescription, has_our_estimator
from analogrig.devices.device import Device, DeviceDescription
from analogrig.devices.registry import recorded
from analogrig.errors import AnalogrigError, ConfigurationError
from analogrig.judging.bursts import BURST, lower_count
from analogrig.judging.exposure import exposure, until_latched
from analogrig.judging.statistics import Decision, SequentialTest, lower_rate
from analogrig.judging.verdict import judge, unreported
from analogrig.rigs.recording import RecordingRig
from analogrig.rigs.rig import Rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig.testing.one_play import Played, rate_below
from analogrig.testing.statement import Finding, Inconclusive, Play, experiment

LONGEST_TIMEOUT_S = 1.0
"""Longest time-out of a line on which faults are tried: some faults cost one time-out, or a few."""

_WITNESS_N = 2000
"""Samples of the play kept as evidence of many trials; more if its first alarm came later."""

_AFTER_N = 100
"""Samples of the kept play after its first alarm."""

_MOST_UNARMED = 2
"""Largest ratio of samples to samples with the trigger armed. Beyond it, zero alarms prove nothing."""

Trials = Sequence[tuple[Scenario, int]]
"""Scenarios with their seeds."""

_EVER = 1e9
"""Multiple of the information bound that allows any latency: an alarm before the next change suffices."""


def device_description(dut: Device) -> DeviceDescription:
    """Description of the device in its present configuration."""
    return recorded(dut.description())


def needs_reported(play: Play, quantity: str) -> None:
    """Skip the test if the device does not report ``quantity``, one of ``analogrig.judging.verdict``."""
    if quantity in unreported(play.bench.dut.datasheet):
        pytest.skip(f"needs {quantity}, which {play.bench.dut.name} does not report")


def is_playable(rig: Rig, scenario: Scenario) -> bool:
    """True if the rig has the waveform and the pots. A rig that has next to none fails hypothesis's health check."""
    try:
        rig.perform(scenario, 0)
    except ConfigurationError:
        return False
    return True


def play_valid(play: Play, scenario: Scenario, seed: int) -> Played:
    """:raises Inconclusive: the play is not valid."""
    played = play(scenario, seed, allow_inconclusive=True)
    if not played.verdict.valid:
        raise Inconclusive(played.verdict.reasons[0], played.run)
    return played


# --------------------------------------------------------------------------------------------------------- false alarms


@experiment
def rate_of_plays_below(
    play: Play,
    scenario: Scenario,
    seed: int,
    rate: float,
    confidence: float,
    plays: int,
    burst: float | None = None,
    *,
    or_misfit: bool = False,
) -> Finding:
    """Finding of ``analogrig.testing.one_play.rate_below`` for a given number of plays."""
    played = [play(scenario, seed + number, allow_inconclusive=True) for number in range(plays)]
    return rate_below(rate, played, confidence=confidence, burst=burst, or_misfit=or_misfit)


@experiment
def false_alarms_at_most(
    play: Play, scenario: Scenario, seed: int, allowed: int, samples: int, samples_each: int
) -> Finding:
    """Finding: at most ``allowed`` false alarms while the trigger was armed in ``samples`` samples.

    Each trial takes ``samples_each`` samples.
    """
    most = _MOST_UNARMED * samples // samples_each
    trials = [(dataclasses.replace(scenario, samples=samples_each), seed + number) for number in range(most)]
    alarms, armed = _count_alarms(play, f"takes {samples} samples: analogrig certify", trials, samples, may_stop=True)
    count = sum(map(len, alarms))
    why = f"{count} false alarms in {armed} samples, allowed {allowed}"
    return Finding(holds=True, why=why) if count <= allowed else _witness(play, trials, alarms, why)


@experiment
def false_alarms_of_plants_rarer(
    play: Play, scenario: Scenario, seed: int, rate: float, confidence: float, plants: int, samples_each: int
) -> Finding:
    """Finding: over random plants, the lower confidence limit of the false-alarm rate is at most ``rate``.

    It covers bursts of BURST alarms on average. Plants may differ in their rates, which is no burst.
    """
    from analogrig.testing.strategies import random_suspensions

    scenario, samples = dataclasses.replace(scenario, samples=samples_each), plants * samples_each
    trials = [(scenario.with_plant(plant), seed) for plant in random_suspensions(plants, seed)]
    least = samples // _MOST_UNARMED
    alarms, armed = _count_alarms(play, f"takes {samples} samples: analogrig campaign", trials, least)
    count = sum(map(len, alarms))
    low = lower_count(count, confidence, BURST) / armed
    why = f"{count} false alarms in {armed} samples: the rate is at least {low:.2g} per sample, allowed {rate:g}"
    return Finding(holds=True, why=why) if low <= rate else _witness(play, trials, alarms, why)


def _count_alarms(
    play: Play, otherwise: str, trials: Trials, least: int, *, may_stop: bool = False
) -> tuple[list[NDArray[np.int64]], int]:
    """Samples with an alarm of each trial, without a line, and number of samples with the trigger armed.

    The test is skipped with the advice ``otherwise`` unless such trials equal those on the bench.

    :param least: least number of samples with the trigger armed; with ``may_stop`` it ends the trials.
    :raises Inconclusive: they are fewer, or a trial could raise no alarm.
    """
    rig, device = play.bench.rig, device_description(play.bench.dut)
    if not can_be_direct(rig, device):
        pytest.skip(f"{otherwise}, or an emulated rig and --hil-dut inproc, not {play.bench.dut.name}")
    bench, armed, samples = direct_bench(rig, device, alarms_only=True), 0, 0
    alarms: list[NDArray[np.int64]] = []
    for scenario, seed in trials:
        run = raise_if_interrupted(bench.play(scenario, seed))
        shown = exposure(run)
        if shown.lack_of_evidence:
            raise Inconclusive(shown.lack_of_evidence)
        alarms.append(until_latched(run).alarm_index)
        armed, samples = armed + shown.armed, samples + run.samples
        if may_stop and armed >= least:
            break
    if armed < least:
        raise Inconclusive(f"the trigger was armed in {armed} of {samples} samples")
    return alarms, armed


def _witness(play: Play, trials: Trials, alarms: Sequence[NDArray[np.int64]], why: str) -> Finding:
    """Failed finding with the play of most alarms, which leaves a recording."""
    most = int(np.argmax([len(each) for each in alarms]))
    (scenario, seed), first = trials[most], alarms[most][:1].tolist()
    samples = min(max([_WITNESS_N, *(each + _AFTER_N for each in first)]), scenario.samples)
    short = dataclasses.replace(scenario, samples=samples)
    return Finding(holds=False, why=why, run=play(short, seed, allow_inconclusive=True).run)


# ------------------------------------------------------------------------------------------------ latency and diagnoses


@experiment
def changes_are_noticed_soon_and_rightly_named(
    play: Play,
    scenario: Scenario,
    seed: int,
    plays: int,
    latency: float,
    doubtful_latency: float,
    most_plays: int,
    right: float,
    confidence: float,
) -> Finding:
    """Finding: mean latency over mean bound is at most ``latency``, and enough diagnoses are right.

    With ``confidence``, the diagnoses must not refute that at least the part ``right`` of them is right.

    A ratio up to ``doubtful_latency`` after ``plays`` plays is decided by ``most_plays`` plays.
    """
    every = [play_valid(play, scenario, seed + number) for number in range(plays)]
    if latency < _latency_over_bound(every) <= doubtful_latency:
        every += [play_valid(play, scenario, seed + number) for number in range(plays, most_plays)]
    missed = [finding for played in every if not (finding := played.detects(_EVER))]
    if missed:
        why = f"in {len(missed)} of {len(every)} plays changes were missed: {missed[0].why}"
        return Finding(holds=False, why=why, run=missed[0].run)
    ratio = _latency_over_bound(every)
    if ratio > latency:
        slowest = max(every, key=lambda played: sum(change.latency_n or 0 for change in played.verdict.changes))
        why = f"mean latency is {ratio:.2f} times the mean bound in {len(every)} plays, allowed {latency:g}"
        return Finding(holds=False, why=why, run=slowest.run)
    said = _diagnoses_are_right(every)
    if said and lower_rate(said.count(False), len(said), confidence) > 1.0 - right:
        first = _first_wrong_diagnosis(every)
        why = f"{said.count(False)} of {len(said)} changes were called wrongly, allowed {1.0 - right:.0%}: {first.why}"
        return Finding(holds=False, why=why, run=first.run)
    return Finding(holds=True, why=f"mean latency is {ratio:.3f} times the mean bound")


def _latency_over_bound(plays: Sequence[Played]) -> float:
    changes = [change for played in plays for change in played.verdict.changes if change.bound_n is not None]
    bounds_n = sum(change.bound_n or 0 for change in changes)
    return sum(change.latency_n or 0 for change in changes) / bounds_n if bounds_n else math.inf


def _diagnoses_are_right(plays: Sequence[Played]) -> list[bool]:
    changes = [change for played in plays for change in played.verdict.changes]
    return [change.diagnosis.right for change in changes if change.diagnosis is not None]


def _first_wrong_diagnosis(plays: Sequence[Played]) -> Finding:
    """Finding of the first play with a wrong diagnosis; the caller knows that there is one."""
    return next(finding for played in plays if not (finding := played.isolates()))


@experiment
def single_changes_are_rightly_named(
    play: Play,
    scenario: Scenario,
    seed: int,
    expected: float,
    refuted: float,
    miss: float,
    false_failure: float,
    most_plays: int,
    silent: int,
) -> Finding:
    """Finding: Wald's test accepts the part ``expected`` of wrong diagnoses against ``refuted``.

    A device without a diagnosis in ``silent`` plays does not diagnose changes at all, which is allowed.
    """
    test = SequentialTest(expected, refuted, miss=miss, false_alarm=false_failure)
    every: list[Played] = []
    for number in range(most_plays):
        every.append(play_valid(play, scenario, seed + number))
        right = _diagnoses_are_right(every[-1:])
        test.add(len(right), right.count(False))
        if test.decision is not Decision.OPEN or (number + 1 >= silent and not test.trials):
            break
    why = f"{test.events} of {test.trials} single changes were called wrongly"
    if test.decision is Decision.BELOW or not test.trials:
        return Finding(holds=True, why=why)
    first = _first_wrong_diagnosis(every)
    why = f"{why}, where {expected:.0%} are expected and {refuted:.0%} too many: {first.why}"
    return Finding(holds=False, why=why, run=first.run)


# -------------------------------------------------------------------------------------------------- whatever may happen


@experiment
def answers_with_numbers(play: Play, scenario: Scenario, seed: int) -> Finding:
    """Finding: the device answers any input with finite numbers, and raises no alarm below its ceiling."""
    played = play(scenario, seed, allow_inconclusive=True)
    run, ceiling = played.run, played.verdict.ceiling
    wrong = list(run.conditions.faults[:1])
    for name in ("theta", "innovation", "statistic"):
        rows = np.isfinite(getattr(run, name)).reshape(run.samples, -1).all(axis=1)
        if not rows.all():
            wrong.append(f"{name} is no number after sample {int(np.argmin(rows))}")
    if (run.statistic < 0.0).any():
        wrong.append(f"the statistic is negative after sample {int(np.argmax(run.statistic < 0.0))}")
    if ceiling is not None:
        low = run.alarm_index[run.statistic[run.alarm_index] < np.float32(ceiling)]
        wrong += [f"an alarm at {index}: the statistic is below its ceiling {ceiling:g}" for index in low[:1].tolist()]
    return Finding(not wrong, "; ".join(wrong) or f"{run.samples} samples, all answered with numbers", run=run)


@experiment
def pause_does_no_harm(play: Play, scenario: Scenario, seed: int, until: int) -> Finding:
    """Finding: while the force has no edge, up to sample ``until``, the device raises no alarm and its estimate stays
    finite."""
    _configure(play, stuck_n=0)  # a displacement that does not move is a measurement then
    played = play_valid(play, scenario, seed)
    run, wrong = played.run, []
    early = run.alarm_index[run.alarm_index < until].tolist()
    wrong += [f"alarms in the pause, at {', '.join(map(str, early[:5]))}"] if early else []
    wrong += [] if np.isfinite(run.theta).all() else ["theta is no number"]
    return Finding(not wrong, "; ".join(wrong) or f"{run.samples} samples without harm", run=run)


@experiment
def alarms_keep_hold_off_and_warm_up(
    play: Play, scenario: Scenario, seed: int, hold_off_n: int, warm_up_n: int, at_least: int
) -> Finding:
    """Finding: a device set to raise alarms as often as possible keeps the hold-off and the warm-up."""
    _configure(play, hold_off_n=hold_off_n, warm_up_n=warm_up_n, **RESTLESS)
    played = play_valid(play, scenario, seed)
    run, index = played.run, played.run.alarm_index
    if len(index) < at_least:
        return Finding(holds=False, why=f"{len(index)} alarms, where at least {at_least} were due", run=run)
    wrong = [f"an alarm at {index[0]}, in the warm-up of {warm_up_n} samples"] if index[0] < warm_up_n else []
    gaps = np.diff(index)
    if gaps.min() < hold_off_n:
        at = index[int(np.argmin(gaps)) + 1]
        wrong.append(f"an alarm at {at}, {gaps.min()} samples after the last, in the hold-off of {hold_off_n}")
    return Finding(not wrong, "; ".join(wrong) or f"{len(index)} alarms, at least {gaps.min()} samples apart", run=run)


RESTLESS = {"trigger": "prediction-error", "ceiling": 0.5, "arl0": None, "isolation": False}
"""Settings of a device that raises alarms as often as it can."""


def _configure(play: Play, **settings: Any) -> None:
    """Configure the device until the next test."""
    dut = play.bench.dut
    if not has_our_estimator(device_description(dut)):
        pytest.skip(f"needs a device with the settings of EstimatorConfig, not {dut.name}")
    dut.configure(**settings)


def device_with_faults(play: Play) -> CatalogueDescription:
    """Description of the device, if faults on its line cost little time; else the test is skipped."""
    device = device_description(play.bench.dut)
    if not has_our_estimator(device):
        pytest.skip(f"needs a device with faults on its line, not {device.name}")
    if "in-process" not in device.capabilities and device.timeout_s > LONGEST_TIMEOUT_S:
        pytest.skip(f"time-outs of {device.timeout_s:g} s take their time: --hil-dut inproc, or ?timeout_s=1")
    return device


@experiment
def faults_of_the_line_do_no_harm(play: Play, scenario: Scenario, seed: int, faults: str) -> Finding:
    """Finding: line faults leave the estimate unchanged, or the run is INCONCLUSIVE, or refused with the cause."""
    bench, device = play.bench, device_with_faults(play)
    with contextlib.ExitStack() as stack:
        if device.wire_faults:  # those with which it failed, when this is judged again
            play = play.on(bench.rig, stack.enter_context(dataclasses.replace(device, wire_faults="").connect()))
        clean = play_valid(play, scenario, seed).run
        again = RecordingRig.of(clean, Path("clean"))  # a real rig does not take the same samples twice
        try:
            spoiled = stack.enter_context(dataclasses.replace(device, wire_faults=faults).connect())
            run = Bench(again, spoiled).play(again.scenario(), seed)
        except AnalogrigError as error:
            return Finding(holds=True, why=f"refused before the run: {error}")
    is_same, verdict = run.theta_hash() == clean.theta_hash(), judge(run)
    why = f"with {faults or 'no fault'} on the line the run is {verdict.outcome}"
    why += " and the estimate as without" if is_same else ", and the estimate is another than without"
    return Finding(is_same or not verdict.valid, why, run=run)


@experiment
def faults_among_the_samples_cost_no_more_than_samples(
    play: Play, scenario: Scenario, seed: int, each: int, least_valid: int
) -> Finding:
    """Finding: faults at messages with samples cost no more than those samples.

    The result equals, to the bit, a run in which the lost samples were declared missing. ``each`` faults of each
    passing kind are tried. ``least_valid`` of the kinds must leave a valid run.
    """
    device = dataclasses.replace(device_with_faults(play), wire_faults="")
    kinds = sorted(PASSING.intersection(device.fault_kinds()))
    valid: set[str] = set()
    with device.connect() as alone:
        without = play_valid(play.on(play.bench.rig, alone), scenario, seed).run
        for kind, faults in _cases(kinds, device, without, each):
            # a real rig would not take the same samples twice
            again = RecordingRig.of(without, Path("without"))
            with dataclasses.replace(device, wire_faults=faults, most_lost_n=scenario.samples).connect() as dut:
                run = Bench(again, dut).play(again.scenario(), without.conditions.seed)
            is_affected = run.lost.any() or any(run.conditions.counters.get(name, 0) for name in _EFFECTS)
            if not judge(run).valid or not is_affected:
                continue
            valid.add(kind)
            declared = Bench(rig_with_gaps(without, run.lost), alone).play(again.scenario(), seed)
            if wrong := difference(run, declared, ~run.lost):
                why = f"with {faults} on the line {wrong} than with {int(run.lost.sum())} samples declared missing"
                return Finding(holds=False, why=why, run=run)
    if "repeat" in kinds and _START not in valid:
        return Finding(holds=False, why=f"{_START} is never passed over: no run with one is valid", run=run)
    valid.discard(_START)
    why = f"{len(valid)} of {len(kinds)} kinds of faults left a valid run and took effect ({', '.join(sorted(valid))})"
    if len(valid) < min(least_valid, len(kinds)):
        raise Inconclusive(f"{why}, at least {least_valid} are needed")
    return Finding(holds=True, why=why)


PASSING = frozenset({"drop", "duplicate", "repeat", "reorder", "flip", "lose", "insert", "truncate"})
"""Kinds of faults that end soon and leave the line as it was before."""

_BEFORE_SAMPLES_N = 5
"""Messages to the device before the first with samples, beside two for each of its settings."""


_START, _LATE_STARTS = "an order to start that comes again", 4
"""Repeated start orders, each in a run of its own: some come too late to be recognised as repetitions."""


def _cases(kinds: Sequence[str], device: CatalogueDescription, run: Run, each: int) -> Iterator[tuple[str, str]]:
    """Kinds and faults: ``each`` of a kind, evenly over a run on its own connection; and start orders repeated among
    the samples."""
    first = 2 * len(list(device.estimator.settings())) + _BEFORE_SAMPLES_N
    messages = run.samples // run.conditions.line["samples_per_message"]
    for kind in kinds:
        places = (first + (number + 1) * messages // (each + 1) for number in range(each))
        yield kind, ",".join([*(f"{kind}@to:{place}" for place in places), f"seed={run.conditions.seed}"])
    if "repeat" in kinds:
        yield from ((_START, f"repeat@to:{first - 1},seed={seed}") for seed in range(_LATE_STARTS))


def rig_with_gaps(run: Run, missing: NDArray[np.bool_]) -> RecordingRig:
    """Rig that replays the samples of a run, some of them declared missing."""
    return RecordingRig.of(dataclasses.replace(run, clipped=run.clipped | missing[:, np.newaxis]), Path("missing"))


_EFFECTS = (
    "frames_dropped",
    "sequence_gaps",
    "messages_repeated",
    "messages_refused",
    "samples_lost",
    "samples_ignored",
)
"""Device counters that count the effects of a fault."""


def difference(run: Run, longer: Run, compared: NDArray[np.bool_] | None = None) -> str:
    """First difference of a run from one that may be longer; empty if there is none.

    :param compared: samples whose values are compared, all by default. Flags and diagnoses are compared with all only.
    """
    n = run.samples
    at = np.arange(n) if compared is None else np.flatnonzero(compared)
    for name in ("theta", "innovation", "statistic", *(("flags",) if compared is None else ())):
        ours, theirs = (np.ascontiguousarray(getattr(each, name)[at]) for each in (run, longer))
        different = (ours.view(np.uint8) != theirs.view(np.uint8)).reshape(len(at), -1).any(axis=1)
        if different.any():
            return f"{name} at sample {at[np.argmax(different)]} is another"
    for event in _EVENTS if compared is None else _EVENTS[:1]:
        if _messages(run, event, n) != _messages(longer, event, n):
            return f"{event[1]} is another"
    return ""


def _messages(run: Run, event: Sequence[str], end: int) -> list[tuple[int, float]]:
    """Index and value of the messages of a kind about the samples before ``end``."""
    index, value = (getattr(run, name).tolist() for name in event)
    return [message for message in zip(index, value, strict=True) if message[0] < end]


_EVENTS = (
    ("alarm_index", "alarm_statistic"),
    ("diagnosis_index", "diagnosis_change"),
    ("misfit_index", "misfit_cause"),
)
