"""A package of somebody else that adds a rig; the test installs it beside the device of the page on kinds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from analogrig import Scenario
from analogrig.plant import Plant
from analogrig.program import Program
from analogrig.rigs import Block, Channel, Hindsight, Performance, Rig, RigDescription, Segment

BLOCK_N, CODES = 100, 4096


@dataclass(frozen=True)
class FlatDescription(RigDescription):
    """A plant at rest, whose displacement jumps once."""

    name: str
    kind: str = "flat"
    jump_at: int = 250

    def open(self, *, self_test: bool = True) -> Rig:  # noqa: ARG002
        return FlatRig(self)


class FlatRig(Rig):
    """A displacement of 2000 codes, and of 2300 after one sample, with noise."""

    capabilities: frozenset[str] = frozenset()

    def __init__(self, description: FlatDescription) -> None:
        self._description = description

    def description(self) -> Mapping[str, Any]:
        return self._description.as_table()

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        lsb = 10.0 / CODES
        channels = {
            "force": Channel(0.0, lsb, "N", 294.0, 1.0),
            "displacement": Channel(0.0, lsb, "m", 0.01996, 1.0),
        }
        plant = Plant.of(Program.load("front"))
        changed = plant.changed({"K": 21000.0})
        segments = (Segment(0, plant), Segment(self._description.jump_at, changed))
        return Performance(5e-5, 200.0, channels, self._blocks(scenario, seed), lambda: Hindsight(segments))

    def _blocks(self, scenario: Scenario, seed: int) -> Iterator[Block]:
        random = np.random.default_rng(seed)
        for first in range(0, scenario.samples, BLOCK_N):
            index = np.arange(first, min(first + BLOCK_N, scenario.samples))
            codes = np.zeros((len(index), len(scenario.program.channels)), np.uint16)
            codes[:, 0] = 2000
            displacement = np.where(index <= self._description.jump_at, 2000, 2300) + random.integers(-5, 6, len(index))
            codes[:, 1] = displacement
            yield Block(first, codes.astype(np.float64) * (10.0 / CODES), codes, np.zeros(codes.shape, np.bool_))
