"""A sound device, and devices with one fault each: the conformance suite must find every one of them.

The class of a fault states the test that must find it.
"""

from __future__ import annotations

import dataclasses
import os
import secrets
import subprocess
import threading
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from analogrig.devices import (
    AdaptedDescription,
    Answers,
    Capability,
    Datasheet,
    Device,
    DeviceRefused,
    RaisedAlarm,
    Samples,
    SteppedFlag,
)

SHEET = Datasheet(theta_n=2, statistic=True, warm_up_n=20, hold_off_n=10)
SHARED_MEMORY = "analogrig-faulty-"
"""Beginning of the names that a faulty device leaves in /dev/shm."""


@dataclass(frozen=True, kw_only=True)
class FaultyDescription(AdaptedDescription):
    """A device with the fault of the place, or a sound one."""

    kind: ClassVar[str] = "faulty"
    usage: ClassVar[str] = "faulty[:FAULT]"
    summary: ClassVar[str] = "device with a fault"
    datasheet: Datasheet = field(default_factory=lambda: SHEET)
    settings: Mapping[str, bool | int | float | str] = field(default_factory=lambda: {"limit": 40.0})
    fault: str = "Sound"

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:  # noqa: ARG003
        return {"fault": place} if place else {}

    @property
    def capabilities(self) -> frozenset[Capability]:
        return frozenset({"configure"})

    @property
    def only_one(self) -> str:
        return "" if self.fault == "Sound" or FAULTS[self.fault].needs_process else self.name

    def open(self) -> Device:
        return FAULTS[self.fault](self)


class Sound(Device):
    """Alarm where a sample is far from the mean before it."""

    found_by: ClassVar[str] = ""
    """Test that must fail."""
    needs_process: ClassVar[bool] = False
    """True if only a process of its own, or a second device, shows the fault."""

    def __init__(self, description: FaultyDescription) -> None:
        super().__init__(description)
        self._settings: Mapping[str, Any] = description.settings
        self._limit = float(self._settings["limit"])
        self.recover()

    def recover(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.mean, self.n, self.armed_from = 0.0, 0, SHEET.warm_up_n

    def configure(self, **settings: Any) -> None:
        for name in settings.keys() - {"limit"}:
            raise DeviceRefused(f"device {self.name}: has no setting {name}")
        self._limit = float(settings.get("limit", self._settings["limit"]))

    def start(self, pace: object = None) -> None:  # noqa: ARG002
        self.reset()

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        for block in blocks:
            yield self.answer(block)

    def answer(self, block: Samples) -> Answers:
        self.n = block.first
        rows = np.zeros((len(block), 2), np.float32)
        statistic, alarms = np.zeros(len(block), np.float32), []
        for k, (y, valid) in enumerate(zip(block.y.tolist(), block.valid.tolist(), strict=True)):
            if valid:
                statistic[k] = abs(y - self.mean)
                self.mean += (y - self.mean) / 16.0
            if valid and statistic[k] > self._limit and self.n >= self.armed_from:
                self.armed_from = self.n + 1 + SHEET.hold_off_n
                alarms.append(RaisedAlarm(block.first + k, statistic=float(statistic[k])))
            self.n += 1
            rows[k] = self.mean, self.n
        flags = np.where(block.valid, 0, SteppedFlag.MISSING).astype(np.uint8)
        return Answers(flags, tuple(alarms), theta=rows, statistic=statistic)


class SharesState(Sound):
    found_by = "test_two_side_by_side_do_not_disturb_each_other"
    needs_process = True
    _state: ClassVar[dict[str, float]] = {"mean": 0.0}

    @property
    def mean(self) -> float:
        return self._state["mean"]

    @mean.setter
    def mean(self, value: float) -> None:
        self._state["mean"] = value


class DropsAnswer(Sound):
    found_by = "test_every_sample_has_one_answer_of_finite_numbers"

    def answer(self, block: Samples) -> Answers:
        whole = super().answer(block)
        if not block.first <= 200 < block.first + len(block):
            return whole
        arrays = {name: getattr(whole, name)[1:] for name in ("flags", "theta", "statistic")}
        return dataclasses.replace(whole, **arrays)


class DisordersAlarms(Sound):
    found_by = "test_alarms_and_diagnoses_come_in_order_with_their_samples"

    def answer(self, block: Samples) -> Answers:
        whole = super().answer(block)
        return dataclasses.replace(whole, alarms=whole.alarms[::-1])


class DelaysAlarms(Sound):
    found_by = "test_alarms_and_diagnoses_come_in_order_with_their_samples"

    def answer(self, block: Samples) -> Answers:
        whole = super().answer(block)
        late = whole.alarms.copy()
        late["index"] += len(block)
        return dataclasses.replace(whole, alarms=late)


class Remembers(Sound):
    found_by = "test_answers_do_not_depend_on_the_record_before"

    def start(self, pace: object = None) -> None:  # noqa: ARG002
        self.n, self.armed_from = 0, SHEET.warm_up_n


class YieldsNan(Sound):
    found_by = "test_extreme_samples_give_numbers"

    def answer(self, block: Samples) -> Answers:
        whole = super().answer(block)
        if whole.statistic is not None and len(block) and block.y.max() == block.y.min():
            whole.statistic[-1] = np.nan
        return whole


class Crashes(Sound):
    found_by = "test_counters_are_whole_numbers"
    needs_process = True

    def answer(self, block: Samples) -> Answers:
        if block.first >= 200:
            os.abort()
        return super().answer(block)


class Leaves(Sound):
    found_by = "test_counters_are_whole_numbers"
    needs_process = True

    def answer(self, block: Samples) -> Answers:
        if block.first >= 200:
            os._exit(0)
        return super().answer(block)


class Hangs(Sound):
    found_by = "test_counters_are_whole_numbers"
    needs_process = True

    def answer(self, block: Samples) -> Answers:
        if block.first >= 200:
            threading.Event().wait()
        return super().answer(block)


class ReadsMissing(Sound):
    found_by = "test_missing_samples_are_ignored"

    def answer(self, block: Samples) -> Answers:
        all_valid = dataclasses.replace(block, valid=np.ones(len(block), np.bool_))
        flags = np.where(block.valid, 0, SteppedFlag.MISSING).astype(np.uint8)
        return dataclasses.replace(super().answer(all_valid), flags=flags)


class HidesMissing(Sound):
    found_by = "test_missing_samples_are_ignored"

    def answer(self, block: Samples) -> Answers:
        return dataclasses.replace(super().answer(block), flags=np.zeros(len(block), np.uint8))


class LiesAboutTheta(Sound):
    found_by = "test_every_sample_has_one_answer_of_finite_numbers"

    @property
    def datasheet(self) -> Datasheet:
        return dataclasses.replace(SHEET, theta_n=3)


class HidesQuantity(Sound):
    found_by = "test_every_sample_has_one_answer_of_finite_numbers"

    def answer(self, block: Samples) -> Answers:
        return dataclasses.replace(super().answer(block), innovation=np.zeros(len(block), np.float32))


class ChangesSheet(Sound):
    found_by = "test_data_sheet_is_final_and_recorded"

    @property
    def datasheet(self) -> Datasheet:
        return dataclasses.replace(SHEET, hold_off_n=10 if self.n < 200 else 5)


class LeaksProcess(Sound):
    """The process ends when this one does, which closes its standard input."""

    found_by = "test_closed_device_leaves_nothing_behind"
    needs_process = True

    def __init__(self, description: FaultyDescription) -> None:
        super().__init__(description)
        self._child = subprocess.Popen(["cat"], stdin=subprocess.PIPE)


class LeaksDescriptor(Sound):
    found_by = "test_closed_device_leaves_nothing_behind"
    needs_process = True

    def close(self) -> None:
        os.open("/dev/null", os.O_RDONLY)


class LeaksSharedMemory(Sound):
    found_by = "test_closed_device_leaves_nothing_behind"
    needs_process = True

    def close(self) -> None:
        Path(f"/dev/shm/{SHARED_MEMORY}{uuid.uuid4()}").touch()  # noqa: S108 - removed by the test


class DependsOnProcess(Sound):
    found_by = "test_answers_are_the_same_in_a_new_process"
    needs_process = True
    _drawn = secrets.randbelow(1 << 20)

    def reset(self) -> None:
        super().reset()
        self.mean = float(self._drawn)


class DependsOnBlocks(Sound):
    found_by = "test_answers_do_not_depend_on_the_blocks[irregular]"

    def answer(self, block: Samples) -> Answers:
        self.mean = round(self.mean, 1)
        return super().answer(block)


class RefusesWithoutName(Sound):
    found_by = "test_unknown_setting_is_refused_by_name"

    def configure(self, **settings: Any) -> None:
        if settings:
            raise DeviceRefused(f"device {self.name}: a setting was refused")


class AppliesHalf(Sound):
    found_by = "test_settings_are_applied_all_or_none"

    def configure(self, **settings: Any) -> None:
        self._limit = float(settings.get("limit", self._settings["limit"]))
        super().configure(**settings)


class IsEager(Sound):
    found_by = "test_no_alarm_while_the_trigger_is_not_armed"

    def reset(self) -> None:
        super().reset()
        self.armed_from = 2


class HoldsOffShortly(Sound):
    found_by = "test_no_alarm_while_the_trigger_is_not_armed"

    def answer(self, block: Samples) -> Answers:
        whole = super().answer(block)
        alarms = [RaisedAlarm(*each) for each in whole.alarms.tolist()]
        again = [RaisedAlarm(each.index + 1) for each in alarms if each.index + 1 < block.first + len(block)]
        return dataclasses.replace(whole, alarms=tuple(sorted((*alarms, *again), key=lambda each: each.index)))


class StaysFailed(Sound):
    found_by = "test_play_after_a_failed_play_is_as_the_first"
    _failed = 0.0

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        self.mean += self._failed
        try:
            yield from super().play(blocks)
        except BaseException:
            self._failed = 1.0
            raise


class ClosesOnce(Sound):
    found_by = "test_device_can_be_closed_twice"

    def close(self) -> None:
        del self._limit


FAULTS: Mapping[str, type[Sound]] = {"Sound": Sound} | {cls.__name__: cls for cls in Sound.__subclasses__()}
