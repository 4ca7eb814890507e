"""Take: one play of a live session, from rest to the next start, and its record if it is recorded."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from analogrig import PotChange, Run, Scenario
from analogrig.bench import RunBuilder
from analogrig.devices import Answers, Datasheet
from analogrig.judging import unexplained_alarms
from analogrig.plant import MAX_CHANGES, Segment
from analogrig.rigs import Block
from analogrig.scenario import MAX_RAMP_N, segments_of

MOST_RECORDED_N = 2_000_000
"""Samples of the longest recording: 100 s at 20,000 samples/s, 80 MB."""

_MOST_ENDING_N = MAX_RAMP_N + 1024
"""Samples that the end of the last ramp may add."""
_MOST_TOLD = 5
"""Changes that the description of a recording names."""

MOST_KEPT_CHANGES = 50
"""Changes that a take keeps if it is not recorded: bounds are looked for after the last ones only."""

Watch = Callable[[Block, Answers], None]


@dataclass
class Take:
    """One play: its scenario so far, and the changes that were made by hand."""

    scenario: Scenario
    """Scenario at its first sample; older changes of an unrecorded take are part of it."""
    is_recorded: bool = False
    changes: list[PotChange] = field(default_factory=list)
    caveats: list[str] = field(default_factory=list)
    """Reasons that its recording cannot be judged."""
    faulty_from: float = math.inf
    """First sample that an injected fault may spoil."""

    def change(self, sample: int, values: Mapping[str, float], ramp_n: int) -> None:
        """Note a change of parameters after a sample."""
        if sample < 1:
            self.scenario = self.scenario.with_plant(self.scenario.plant.changed(values))
        elif self.changes and self.changes[-1].sample == sample:
            self.changes[-1] = dataclasses.replace(self.changes[-1], set={**self.changes[-1].set, **values})
        else:
            self.changes.append(PotChange(sample, values, ramp_n))
        if not self.is_recorded and len(self.changes) > MOST_KEPT_CHANGES:
            oldest = self.changes.pop(0)
            self.scenario = self.scenario.with_plant(self.scenario.plant.changed(oldest.set))

    def add_caveat(self, reason: str, sample: int) -> None:
        """Note a reason that the recording cannot be judged, and the first sample that it concerns."""
        self.faulty_from = min(self.faulty_from, sample)
        if self.is_recorded and len(self.caveats) < MAX_CHANGES:
            self.caveats.append(reason)

    def segments(self) -> tuple[Segment, ...]:
        """True plant from the start and after each change."""
        return segments_of(self.scenario.plant, self.changes)

    def false_alarms(self, run: Run) -> int:
        """Number of alarms of its concluded run before any injected fault that no change explains.

        :raises ConfigurationError: the recorded rig or scenario does not describe a machine.
        """
        return sum(index < self.faulty_from for index in unexplained_alarms(run))

    def played(self, run: Run) -> Scenario:
        """Scenario that plays this take again."""
        changes = tuple(change for change in self.changes if change.sample < run.samples)
        told = [f"{name} to {value:.6g} at {each.sample}" for each in changes for name, value in each.set.items()]
        more = f" and {len(told) - _MOST_TOLD} more" if len(told) > _MOST_TOLD else ""
        return dataclasses.replace(
            self.scenario,
            samples=run.samples,
            changes=changes,
            name="by hand",
            description=f"Recorded by hand: {', '.join(told[:_MOST_TOLD]) or 'no change'}{more}.",
        )

    def concluded(self, run: Run) -> Run:
        """Run with the scenario that was played by hand, instead of the endless one.

        The scenario allows the false alarms that were seen. Errors as ``false_alarms``.
        """
        scenario = self.played(run)
        conditions = dataclasses.replace(
            run.conditions,
            samples_asked=run.samples,
            scenario=scenario.as_table(),
            segments=run.conditions.segments or scenario.segments(),
            faults=(*run.conditions.faults, *self.caveats),
        )
        concluded = dataclasses.replace(run, conditions=conditions)
        expect = scenario.expect
        expect = dataclasses.replace(expect, false_alarms=max(expect.false_alarms, self.false_alarms(concluded)))
        allowing = dataclasses.replace(scenario, expect=expect).as_table()
        return dataclasses.replace(concluded, conditions=dataclasses.replace(conditions, scenario=allowing))


class TakeBuilder(RunBuilder):
    """Collector of a take: passes every block on, and keeps the samples only of a take that is recorded."""

    def __init__(self, channels: int, sheet: Datasheet, watch: Watch, *, keeps: bool) -> None:
        super().__init__(MOST_RECORDED_N + _MOST_ENDING_N if keeps else 0, channels, sheet)
        self._keeps = keeps
        self._watch = watch

    def add(self, block: Block, answers: Answers) -> None:
        if self._keeps:
            super().add(block, answers)
        else:
            self.samples += len(answers)
        self._watch(block, answers.shifted(self.records[-1]))
