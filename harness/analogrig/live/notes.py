"""Notes of a live session on what its device says: alarms with latency and bound, diagnosis, misfit, estimates."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analogrig.answers import Answers
from analogrig.catalogue import Cause, Change
from analogrig.devices.device import Device
from analogrig.judging import information
from analogrig.judging.verdict import DIAGNOSABLE
from analogrig.live.desk import Desk
from analogrig.live.ring import Ring
from analogrig.live.take import Take
from analogrig.plant import PARAMETERS, Segment, physical_parameters
from analogrig.rigs.rig import Block
from analogrig.run import Conditions, Run

_LEAD_N = 1500
"""Samples before a change from which its bound is computed: the plant forgets its start in some hundred."""
_BOUND_AFTER_N = (64, 256, 1024)
"""Samples after a change at which its bound is looked for."""
_MOST_NOTED = 50


@dataclass
class NotedAlarm:
    """Alarm of the device, with its latency."""

    take: int
    sample: int
    what: str = ""
    """Names of the changed parameters; empty: no change explains the alarm."""
    change: int = 0
    """Sample of the change."""
    latency_n: int | None = None
    bound_n: int | None = None
    searched: int = 0
    """Number of searches for the bound."""


class Notes:
    """Notes on the device's answers, written by the thread that plays."""

    def __init__(self, desk: Desk, device: Device, ring: Ring, seed: int) -> None:
        self._desk = desk
        self._device = device
        self._ring = ring
        self._seed = seed
        self._take = Take(desk.scenario)
        self._number = 0
        self._unfelt: list[tuple[int, float]] = []
        """Samples that feel a turn of a pot, and the times of the turns."""
        self.felt_s: deque[float] = deque(maxlen=1000)
        """Times from a turn of a pot to the first answered sample that feels it."""
        self.alarms: deque[NotedAlarm] = deque(maxlen=_MOST_NOTED)
        self.alarm_count = 0
        self.diagnosis = ""
        self.misfit = ""
        self.missing_n = 0

    def begin(self, take: Take, number: int) -> None:
        """Begin a take."""
        self._take, self._number = take, number
        self._unfelt = []
        self.diagnosis, self.misfit = "", ""

    def await_turn(self, sample: int, times_s: Sequence[float]) -> None:
        """Await the first sample that feels a turn of pots, ordered at these times."""
        self._unfelt += [(sample, at_s) for at_s in times_s]

    def watch(self, block: Block, answers: Answers, now_s: float) -> bool:
        """Take note of an answered block that is in the ring. Return True if there is news."""
        end = self._ring.end
        self.missing_n += int(np.count_nonzero(~block.samples().valid))
        self.felt_s.extend(now_s - at_s for sample, at_s in self._unfelt if sample < end)
        self._unfelt = [each for each in self._unfelt if each[0] >= end]
        for alarm in answers.alarms:
            self._note_alarm(alarm.index)
        for diagnosis in answers.diagnoses:
            self.diagnosis = DIAGNOSABLE.get(Change(diagnosis.change), "undecided")
        for misfit in answers.misfits:
            self.misfit = "" if misfit.cause == Cause.NONE else Cause(misfit.cause).name.lower().replace("_", " ")
        has_searched = self._search_bounds(end)
        return has_searched or bool(answers.alarms or answers.diagnoses or answers.misfits)

    def _note_alarm(self, sample: int) -> None:
        alarm = NotedAlarm(self._number, sample)
        plants = self._take.plants()
        i = max((i for i, (start, _, _) in enumerate(plants) if start < sample), default=0)
        seen = any(each.take == self._number and each.what and each.change == plants[i][0] for each in self.alarms)
        is_ramp = sample <= plants[i][0] + plants[i][2]
        if i and (is_ramp or not seen):
            alarm.what = ", ".join(plants[i - 1][1].changes_to(plants[i][1]))
            alarm.change = plants[i][0]
            alarm.latency_n = sample - plants[i][0]
        self.alarms.append(alarm)
        self.alarm_count += 1

    def _search_bounds(self, end: int) -> bool:
        """Look for the information bounds of the changes that were detected. Return True if a search was made."""
        has_searched = False
        if self._take.scenario.caveats:
            return False
        for alarm in self.alarms:
            is_open = alarm.take == self._number and alarm.what and alarm.bound_n is None
            if not is_open or alarm.searched >= len(_BOUND_AFTER_N):
                continue
            if end >= alarm.change + _BOUND_AFTER_N[alarm.searched]:
                alarm.searched += 1
                alarm.bound_n = self._bound(alarm.change, min(end, alarm.change + _BOUND_AFTER_N[-1]))
                has_searched = True
        return has_searched

    def _bound(self, change: int, end: int) -> int | None:
        """Information bound of the change at a sample, from the samples before ``end``; None: not reached."""
        first = max(self._ring.start, change - _LEAD_N)
        plants = self._take.plants()
        begun = max(i for i, (start, _, _) in enumerate(plants) if start <= first)
        number = next(i for i, (start, _, _) in enumerate(plants) if start == change)
        end = min([end, *(start for start, _, _ in plants[number + 1 :])])
        segments = [Segment(0, plants[begun][1])]
        segments += [Segment(start - first, plant, ramp_n) for start, plant, ramp_n in plants[begun + 1 : number + 1]]
        try:
            run = self._window(first, end, segments)
        except LookupError:
            return None
        level = self._device.datasheet.log_arl0(self._take.scenario.expect.arl0)
        return information.first_at_level(information.change_information(run)[-1], level)

    def _window(self, first: int, end: int, segments: list[Segment]) -> Run:
        """Samples of the ring as a run.

        :raises LookupError: the ring does not hold them.
        """
        performance = self._desk.performance
        if performance is None:
            raise LookupError("nothing is played yet")
        columns: Any = {name: self._ring.read(name, first, end) for name in self._ring.columns if name != "probed"}
        conditions = Conditions(
            seed=self._seed,
            samples_asked=end - first,
            sample_period_s=performance.sample_period_s,
            time_scale=performance.time_scale,
            channels=performance.channels,
            segments=tuple(segments),
            scenario={},
            rig={},
            dut=self._device.description(),
            link=self._device.link_name,
        )
        none = np.zeros(0, np.int64)
        return Run(
            conditions,
            alarm_index=none,
            alarm_kind=none.astype(np.uint8),
            alarm_statistic=none.astype(np.float32),
            **columns,
        )

    def estimates(self) -> dict[str, float | None]:
        """Last estimates by parameter; empty if the device reports none."""
        sheet, performance = self._device.datasheet, self._desk.performance
        end = self._ring.end
        if sheet.model is None or not sheet.theta_n or performance is None or not end:
            return {}
        try:
            theta: Any = self._ring.read("theta", end - 1, end)
        except LookupError:
            return {}
        channels = performance.channels
        found = physical_parameters(
            theta,
            sheet.model,
            n_per_code=channels["force"].lsb,
            m_per_code=channels["displacement"].lsb,
            period_s=performance.sample_period_s * performance.time_scale,
        )[0]
        return {name: None if np.isnan(value) else float(value) for name, value in zip(PARAMETERS, found, strict=True)}
