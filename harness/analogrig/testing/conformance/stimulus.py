"""Records of the conformance tests: samples that a device takes, and everything that it answers."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import Answers, Samples
from analogrig.datasheet import Datasheet
from analogrig.devices.device import Device
from analogrig.rigs.description import open_rig
from analogrig.run import Channel
from analogrig.scenario import PotChange, Scenario

SAMPLES_N, CHANGE_AT, BLOCK_N = 800, 640, 97
"""Samples of a record, sample of its change, and usual length of a block: a prime, so that none fits a buffer."""


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
        changes = (PotChange(CHANGE_AT, {"M": 60.0, "K": 18_000.0}),)
        scenario = dataclasses.replace(Scenario.load("healthy"), samples=SAMPLES_N, changes=changes)
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


@dataclass(frozen=True, eq=False)
class Answered:
    """Everything that a device answered in one record."""

    sheet: Datasheet
    parts: tuple[Answers, ...]
    """Answers as they came."""
    counters: Mapping[str, int]

    @functools.cached_property
    def whole(self) -> Answers:
        return Answers.joined(self.parts)

    @functools.cached_property
    def digests(self) -> dict[str, str]:
        """SHA-256 of each quantity over the record; empty if it is not reported."""
        quantities = {each.name: getattr(self.whole, each.name) for each in dataclasses.fields(Answers)}
        return {
            name: "" if each is None else hashlib.sha256(each.tobytes()).hexdigest()
            for name, each in quantities.items()
        }


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
