"""Rig that replays a recorded run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from analogrig.errors import ConfigurationError, RecordingError
from analogrig.rigs.rig import BLOCK_SAMPLES, Block, Hindsight, Performance, Rig, RigDescription
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig.trust import FiledName

RECORDING = "recording:"
"""Start of the name of such a rig, before its file."""

WRONG_SAMPLES = "wrong samples: "
"""Start of the fault of a run whose samples are wrong. A replay of them has this fault too."""


@dataclass(frozen=True)
class RecordingDescription(RigDescription):
    """Recording in a file."""

    path: Path

    def as_table(self) -> Mapping[str, Any]:
        """:raises RecordingError: the file cannot be read."""
        return RecordingRig.open(self.path).description()

    def open(self, *, self_test: bool = True) -> Rig:  # noqa: ARG002 - for real rigs
        """:raises RecordingError: the file cannot be read, or there is nothing in it to play."""
        return RecordingRig.open(self.path)


class RecordingRig(Rig):
    """Recorded run as a rig; it plays only its own scenario, which another file may name with other equipment."""

    capabilities: frozenset[str] = frozenset()

    def __init__(self, run: Run, path: Path) -> None:
        self.run = run
        self.path = path
        self._name = f"{RECORDING}{path}"

    @classmethod
    def open(cls, path: Path) -> RecordingRig:
        """:raises RecordingError: the file cannot be read, or there is nothing in it to play."""
        return cls.of(Run.load(path), path)

    @classmethod
    def of(cls, run: Run, path: Path) -> RecordingRig:
        """Rig of a run that was read from ``path``."""
        if run.samples == 0:
            raise RecordingError(f"{path}: holds no samples: the run failed before the first block was complete")
        return cls(run, path)

    def description(self) -> Mapping[str, Any]:
        return {**self.run.conditions.rig, "name": self._name}

    def scenario(self) -> Scenario:
        """Recorded scenario. If the recording ended early, so does the replay: its run is then not valid either."""
        scenario = Scenario.from_table(self.run.conditions.scenario, self._name)
        dut = FiledName(scenario.dut, str(self.path))
        return dataclasses.replace(scenario, samples=self.run.conditions.samples_asked, dut=dut)

    @property
    def recorded(self) -> tuple[Scenario, int]:
        return self.scenario(), self.run.conditions.seed

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        conditions = self.run.conditions
        if _samples_of(scenario) != _samples_of(self.scenario()):
            raise ConfigurationError(f"{self._name}: holds the scenario {self.scenario().name!r} and can play no other")
        if seed != conditions.seed:
            raise ConfigurationError(f"{self._name}: was recorded with seed {conditions.seed}, not {seed}: name none")
        return Performance(
            conditions.sample_period_s,
            conditions.time_scale,
            conditions.channels,
            self._blocks(),
            hindsight=lambda: Hindsight(
                conditions.segments,
                conditions.overloads,
                tuple(fault for fault in conditions.faults if fault.startswith(WRONG_SAMPLES)),
            ),
        )

    def _blocks(self) -> Iterator[Block]:
        for record, (start, end) in enumerate(self.run.records):
            for first in range(start, end, BLOCK_SAMPLES):
                samples = slice(first, min(first + BLOCK_SAMPLES, end))
                codes = self.run.codes[samples]
                volts = np.full(codes.shape, np.nan)
                for i, name in enumerate(self.run.conditions.program.channels):
                    if name in self.run.conditions.channels:
                        volts[:, i] = self.run.conditions.channels[name].volts(codes[:, i])
                yield Block(first, volts, codes, self.run.clipped[samples], record)


def _samples_of(scenario: Scenario) -> Scenario:
    """Scenario without what leaves its samples as they are: names, equipment, and the statement that it repeats."""
    return dataclasses.replace(scenario, name="", description="", seed=None, rig="", dut="", statement=None)
