"""Records of the conformance tests: samples that a device takes, and everything that it answers."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import Answers, RaisedAlarm, ReportedDiagnosis, ReportedMisfit, Samples
from analogrig.datasheet import Datasheet
from analogrig.devices.device import Device
from analogrig.rigs.description import open_rig
from analogrig.run import Channel
from analogrig.scenario import PotChange, Scenario

SAMPLES_N, CHANGE_AT, BLOCK_N = 800, 640, 97
"""Samples of a record, sample of its change, and usual length of a block: a prime, so that none fits a buffer."""

_ARRAYS = ("flags", "theta", "innovation", "statistic")


@dataclass(frozen=True, eq=False)
class Stimulus:
    """Samples of one record, with the scales of their channels."""

    channels: Mapping[str, Channel]
    period_s: float
    u: NDArray[np.uint16]
    y: NDArray[np.uint16]
    valid: NDArray[np.bool_]

    @classmethod
    def of_plant(cls, seed: int) -> Self:
        """Samples of the emulated computer, whose plant changes after the warm-up of most devices."""
        scenario = Scenario.load("healthy")
        changes = (PotChange(CHANGE_AT, {"M": 60.0, "K": 18_000.0}),)
        scenario = dataclasses.replace(scenario, samples=SAMPLES_N, changes=changes)
        with open_rig("emulator") as rig:
            performance = rig.perform(scenario, seed)
            parts = [block.samples() for block in performance.blocks]
        u, y, valid = (np.concatenate([getattr(part, name) for part in parts]) for name in ("u", "y", "valid"))
        return cls(performance.of_device, performance.sample_period_s, u, y, valid)

    def replaced(self, **arrays: Any) -> Stimulus:
        """The same with other arrays."""
        return dataclasses.replace(self, **arrays)

    @property
    def full_scale(self) -> int:
        """Largest code of both channels."""
        return min(channel.codes for channel in self.channels.values()) - 1

    def blocks(self, *lengths: int) -> Iterator[Samples]:
        """The samples in blocks of these lengths, over and over."""
        first = 0
        for length in itertools.cycle(lengths or (BLOCK_N,)):
            if first >= len(self.u):
                return
            here = slice(first, first + length)
            yield Samples(first, self.u[here], self.y[here], self.valid[here])
            first += length

    def as_table(self) -> dict[str, Any]:
        """Plain values, from which ``from_table`` makes the same."""
        channels = {name: dataclasses.asdict(channel) for name, channel in self.channels.items()}
        arrays = {name: getattr(self, name).tolist() for name in ("u", "y", "valid")}
        return {"channels": channels, "period_s": self.period_s, **arrays}

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Self:
        channels = {name: Channel(**channel) for name, channel in table["channels"].items()}
        u, y = (np.array(table[name], np.uint16) for name in ("u", "y"))
        return cls(channels, table["period_s"], u, y, np.array(table["valid"], np.bool_))


@dataclass(frozen=True, eq=False)
class Answered:
    """Everything that a device answered in one record."""

    sheet: Datasheet
    parts: tuple[Answers, ...]
    """Answers as they came."""
    counters: Mapping[str, int]

    def array(self, name: str) -> NDArray[Any] | None:
        """An array of the answers over the record; None if it is not reported."""
        found = [getattr(part, name) for part in self.parts]
        return None if not found or any(each is None for each in found) else np.concatenate(found)

    @property
    def alarms(self) -> tuple[RaisedAlarm, ...]:
        return tuple(RaisedAlarm(*each) for part in self.parts for each in part.alarms.tolist())

    @property
    def diagnoses(self) -> tuple[ReportedDiagnosis, ...]:
        return tuple(ReportedDiagnosis(*each) for part in self.parts for each in part.diagnoses.tolist())

    @property
    def misfits(self) -> tuple[ReportedMisfit, ...]:
        return tuple(ReportedMisfit(*each) for part in self.parts for each in part.misfits.tolist())

    @property
    def alarm_indices(self) -> list[int]:
        return [alarm.index for alarm in self.alarms]

    def digests(self) -> dict[str, str]:
        """SHA-256 of each quantity over the record; empty if it is not reported."""
        arrays = {name: self.array(name) for name in _ARRAYS}
        found = {name: "" if each is None else _digest(each.tobytes()) for name, each in arrays.items()}
        events = {"alarms": self.alarms, "diagnoses": self.diagnoses, "misfits": self.misfits}
        rows = {name: [tuple(map(float, vars(each).values())) for each in every] for name, every in events.items()}
        return found | {name: _digest(repr(each).encode()) for name, each in rows.items()}


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def begin(device: Device, stimulus: Stimulus) -> None:
    """Start a record."""
    device.prepare(stimulus.channels, stimulus.period_s)
    device.start()


def play(device: Device, stimulus: Stimulus, *lengths: int) -> Answered:
    """Play a record in blocks of these lengths."""
    begin(device, stimulus)
    return finish(device, device.play(stimulus.blocks(*lengths)))


def finish(device: Device, answers: Iterable[Answers]) -> Answered:
    """Collect the answers of a record, and end it."""
    parts = tuple(answers)
    return Answered(device.datasheet, parts, device.stop())


def settle(device: Device) -> None:
    """Bring a device that was left in the middle of a record to the state of the first one."""
    device.recover()
    device.configure()
