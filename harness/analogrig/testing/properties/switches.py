"""Experiments about the settings of a device and the ends of its records. They ask nothing of how it estimates."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from analogrig.catalogue import SteppedFlag
from analogrig.devices.catalogue_device import EXCHANGES, has_our_estimator
from analogrig.devices.device import Device
from analogrig.errors import ConfigurationError, DeviceRefused
from analogrig.rigs.recording import RecordingRig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig.testing.properties.cases import (
    FAULTS,
    FAULTY,
    HEALTHY,
    HIGH,
    LOW,
    MISFITS,
    RARE_EDGES,
    SOFTER,
    PlayedCase,
    SpoiledRig,
    U,
    Y,
    edges_of,
    hold,
    saturate,
)
from analogrig.testing.properties.experiments import RESTLESS, device_description, difference
from analogrig.testing.statement import Finding, Inconclusive, Play, experiment

OFF, ON = "off", "on"

HOLD_OFF_N, WARM_UP_N, LEAST_ALARMS = 80, 120, 5


_CHANGED = PlayedCase(SOFTER, {"warm_up_n": 150})


@dataclass(frozen=True)
class StatedOption:
    """A setting with its two values, and samples for which one of them matters."""

    on: Mapping[str, Any]
    off: Mapping[str, Any]
    has_effect: Callable[[Run], bool]
    case: PlayedCase = _CHANGED


def _flagged(run: Run, flag: SteppedFlag) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.asarray((run.flags & flag) != 0)


def _tells_lost_excitation(run: Run) -> bool:
    """True if edges are told from pauses."""
    idle, edges = _flagged(run, SteppedFlag.IDLE), edges_of(run.codes)
    return bool(idle[edges - 1].any() and not idle[edges].any())


def _refuses_saturated(run: Run) -> bool:
    """True if the samples at or beyond the limits are refused, and no others."""
    codes = run.codes[:, [U, Y]]
    saturated = ((codes <= LOW) | (codes >= HIGH)).any(axis=1) & ~run.missing
    return np.array_equal(_flagged(run, SteppedFlag.REFUSED), saturated)


def _first_alarm(run: Run) -> int:
    """Sample of the first alarm; -1 if there are too few alarms."""
    return int(run.alarm_index[0]) if len(run.alarm_index) >= LEAST_ALARMS else -1


_OFTEN = PlayedCase(FAULTY, {**RESTLESS, "warm_up_n": 0})
_NOISY = PlayedCase(
    FAULTY,
    {**RESTLESS, "trigger": "mean-between-faults", "ceiling": 2.0, "warm_up_n": 150},
    FAULTS["noisy displacement"],
)
"""The mean of the innovations stays small, that of their magnitudes grows."""

OPTIONS: Mapping[str, StatedOption] = {
    "hold_off_n": StatedOption(
        {"hold_off_n": HOLD_OFF_N},
        {"hold_off_n": 0},
        lambda run: _first_alarm(run) >= 0 and int(np.diff(run.alarm_index).min()) >= HOLD_OFF_N,
        _OFTEN,
    ),
    "warm_up_n": StatedOption(
        {"warm_up_n": WARM_UP_N}, {"warm_up_n": 0}, lambda run: _first_alarm(run) >= WARM_UP_N, _OFTEN
    ),
    "trigger": StatedOption({"trigger": "cusum"}, {"trigger": "none"}, lambda run: len(run.alarm_index) > 0),
    "isolation": StatedOption({"isolation": True}, {"isolation": False}, lambda run: len(run.diagnosis_index) > 0),
    "misfit": StatedOption({"misfit": True}, {"misfit": False}, lambda run: len(run.misfit_index) > 0, MISFITS["hum"]),
    "reset": StatedOption(
        {"reset": "all"},
        {"reset": "covariance"},  # the first two elements are zero after an alarm, within the rounding of the others
        lambda run: bool(len(run.alarm_index) and (np.abs(run.theta[run.alarm_index, :2]) < 1e-3).all()),
    ),
    "absolute": StatedOption({"absolute": True}, {"absolute": False}, lambda run: len(run.alarm_index) > 0, _NOISY),
    "stuck_n": StatedOption(
        {"stuck_n": 8},
        {"stuck_n": 0},
        lambda run: bool(_flagged(run, SteppedFlag.REFUSED).any()),
        PlayedCase(HEALTHY, spoil=hold),
    ),
    "idle_n": StatedOption({"idle_n": 60}, {"idle_n": 0}, _tells_lost_excitation, PlayedCase(RARE_EDGES)),
    "code_low and code_high": StatedOption(
        {"code_low": float(LOW), "code_high": float(HIGH)},
        {"code_low": -1.0, "code_high": 4096.0},
        _refuses_saturated,
        PlayedCase(HEALTHY, {"stuck_n": 0}, saturate),
    ),
}
"""Settings that a device may have under these names. One that refuses a setting is not tried."""


@experiment
def option_comes_and_goes(play: Play, scenario: Scenario, seed: int, option: str) -> Finding:
    """Finding: a setting has its effect, loses it, and leaves nothing behind.

    The same samples are played with the setting off, on, off, and on again. Its effect shows when it is on, and only
    then. Answers with the same setting are the same to the bit.

    :param option: one of ``OPTIONS``.
    """
    chosen, device = OPTIONS[option], play.bench.dut
    rig = SpoiledRig(play.bench.rig, chosen.case.spoil) if chosen.case.spoil else play.bench.rig
    before: dict[str, Run] = {}
    for turn in (OFF, ON, OFF, ON):
        settings = chosen.on if turn == ON else chosen.off
        try:
            device.configure(**{**chosen.case.settings, **settings})
        except (ConfigurationError, DeviceRefused) as error:
            pytest.skip(str(error))
        run = _played(play.on(rig, device), scenario, seed)
        rig = RecordingRig.of(run, Path(option))  # a real rig does not take the same samples twice
        scenario = rig.scenario()
        if chosen.has_effect(run) != (turn == ON):
            where = "all the same" if turn == OFF else "nowhere"
            return Finding(holds=False, why=f"{option} is {turn}: its effect shows {where}", run=run)
        if turn in before and (wrong := difference(run, before[turn])):
            return Finding(holds=False, why=f"{option} is {turn} again: {wrong} than the first time", run=run)
        before[turn] = run
    return Finding(holds=True, why=f"{option} comes and goes")


@experiment
def record_may_end_anywhere(play: Play, scenario: Scenario, seed: int, ends: int) -> Finding:
    """Finding: answers up to any sample do not depend on whether the record goes on.

    The record is cut after each of its last ``ends`` samples. A device that can be configured raises alarms as often as
    it can. Each exchange of a device in this process is tried.
    """
    whole: Run | None = None
    for device in _exchanges(play.bench.dut):
        with contextlib.suppress(ConfigurationError, DeviceRefused):
            device.configure(**RESTLESS, warm_up_n=10)
        if whole is None:
            whole = _played(play.on(play.bench.rig, device), scenario, seed)
        for end in range(whole.samples - ends + 1, whole.samples + 1):
            scenario_so_far = {**whole.conditions.scenario, "samples": end}
            conditions = dataclasses.replace(whole.conditions, samples_asked=end, scenario=scenario_so_far)
            first = dataclasses.replace(
                whole, codes=whole.codes[:end], clipped=whole.clipped[:end], conditions=conditions
            )
            rig = RecordingRig.of(first, Path("first samples"))
            run = _played(play.on(rig, device), rig.scenario(), seed)
            if wrong := difference(run, whole):
                return Finding(holds=False, why=f"a record of {end} samples: {wrong} than in a longer one", run=run)
    return Finding(holds=True, why=f"{ends} ends of a record change nothing before them")


def _exchanges(dut: Device) -> Iterator[Device]:
    """The device, and if it is our catalogue's in this process, one for each other exchange."""
    yield dut
    description = device_description(dut)
    if not has_our_estimator(description) or "in-process" not in description.capabilities:
        return
    for exchange in get_args(EXCHANGES):
        if exchange != description.exchange:
            with dataclasses.replace(description, exchange=exchange).connect() as device:
                yield device


def _played(play: Play, scenario: Scenario, seed: int) -> Run:
    run = play(scenario, seed, allow_inconclusive=True).run
    if run.conditions.faults:
        raise Inconclusive(run.conditions.faults[0], run)
    return run
