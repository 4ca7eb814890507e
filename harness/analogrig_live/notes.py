"""Notes on the reports of a session's device: alarms with latency and bound, diagnosis, misfit, estimates."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Device
from analogrig.devices import Answers, Cause, Change
from analogrig.judging import LinearPlant, Model, PlantChange, diagnosis_text, first_at_level, information_of, weights
from analogrig.plant import estimated_parameters
from analogrig.rigs import Block
from analogrig.run import INPUT, LOST, OUTPUT, missing_samples
from analogrig_live.desk import Desk
from analogrig_live.ring import Ring
from analogrig_live.take import Take

_BOUND_AFTER_N = (64, 256, 1024)
"""Samples after a change at which its bound is looked for."""
_AFTER_N = 2000
"""Samples after an alarm, or after an injected fault, in which another alarm may have the same cause."""
_MOST_NOTED = 50
_MOST_TIMED = 1000


@dataclass
class NotedAlarm:
    """Alarm of the device, with its latency."""

    number: int
    """Number in the session, from 1."""
    take: int
    sample: int
    what: str = ""
    """Names of the changed parameters; empty: no change explains the alarm."""
    again: str = ""
    """Names of the parameters of a change that an earlier alarm had found already."""
    fault: str = ""
    """Injected fault or mode of the computer in force, if no change explains the alarm."""
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
        self._sheet = device.datasheet
        """Data sheet, which a device may suit to the program as a take begins."""
        self._is_new = True
        """True until the first block of a take."""
        self.take = Take(desk.scenario)
        """Take that the ring holds."""
        self._unfelt: deque[tuple[int, float]] = deque(maxlen=_MOST_TIMED)
        """Samples that feel a turn of a pot, and the times of the turns."""
        self.felt_s: deque[float] = deque(maxlen=_MOST_TIMED)
        """Times from a turn of a pot to the first answered sample that feels it."""
        self._disturbed: dict[str, float] = {}
        """Last samples that injected faults and modes of this take act on."""
        self.alarms: deque[NotedAlarm] = deque(maxlen=_MOST_NOTED)
        self.alarm_count = 0
        self.diagnosis = ""
        self.misfit = ""
        self.missing_n = 0
        """Samples that the device has not got: clipped, or lost on its line."""

    def begin(self, take: Take) -> None:
        """Begin a take; its samples follow in the ring."""
        self.take, self._is_new = take, True
        self._ring.restart()
        self.forget_turns()
        self.diagnosis, self.misfit = "", ""
        self._disturbed = {}

    def disturb(self, sample: int, what: str, *, lasts: bool) -> None:
        """Note an injected fault or a mode at a sample, from which alarms may come."""
        self._disturbed[what] = math.inf if lasts else sample + _AFTER_N

    def await_turn(self, sample: int, times_s: Sequence[float]) -> None:
        """Await the first sample that feels a turn of pots, ordered at these times."""
        self._unfelt.extend((sample, at_s) for at_s in times_s)

    def forget_turns(self) -> None:
        """Await no turns."""
        self._unfelt.clear()

    def watch(self, block: Block, answers: Answers, now_s: float) -> bool:
        """Take note of an answered block that is in the ring. Return True if there is news."""
        if self._is_new:
            self._sheet, self._is_new = self._device.datasheet, False
        end = self._ring.end
        self.missing_n += int(np.count_nonzero(~block.samples().valid[: len(answers)] | (answers.flags & LOST != 0)))
        self.felt_s.extend(now_s - at_s for sample, at_s in self._unfelt if sample < end)
        self._unfelt = deque((each for each in self._unfelt if each[0] >= end), _MOST_TIMED)
        for index in answers.alarms.index.tolist():
            self._note_alarm(index)
        for diagnosis in answers.diagnoses:
            self.diagnosis = diagnosis_text(Change(diagnosis.change), self._desk.program)
        for misfit in answers.misfits:
            self.misfit = "" if misfit.cause == Cause.NONE else Cause(misfit.cause).name.lower().replace("_", " ")
        has_searched = self._search_bounds(end)
        return has_searched or any(map(len, (answers.alarms, answers.diagnoses, answers.misfits)))

    def _note_alarm(self, sample: int) -> None:
        self.alarm_count += 1
        alarm = NotedAlarm(self.alarm_count, self._ring.place[0], sample)
        earlier = [segment for segment in self.take.segments() if segment.start < sample][-2:]
        start, ramp_n = earlier[-1].start, earlier[-1].ramp_n
        seen = [each for each in self.alarms if each.take == self._ring.place[0] and each.change == start]
        names = ", ".join(earlier[0].plant.changes_to(earlier[-1].plant))
        if names and (sample <= start + ramp_n or not seen):
            alarm.what, alarm.change, alarm.latency_n = names, start, sample - start
        elif names and sample <= seen[-1].sample + _AFTER_N:
            alarm.again, alarm.change = names, start
        else:
            alarm.fault = ", ".join(what for what, end in self._disturbed.items() if sample <= end)
        self.alarms.append(alarm)

    def _search_bounds(self, end: int) -> bool:
        """Look for the information bounds of the changes that were detected. Return True if a search was made."""
        has_searched = False
        for alarm in self.alarms:
            is_open = alarm.take == self._ring.place[0] and alarm.what and alarm.bound_n is None
            if not is_open or alarm.searched >= len(_BOUND_AFTER_N):
                continue
            if end >= alarm.change + _BOUND_AFTER_N[alarm.searched]:
                alarm.searched += 1
                alarm.bound_n = self._bound(alarm.change, min(end, alarm.change + _BOUND_AFTER_N[-1]))
                has_searched = True
        return has_searched

    def _bound(self, change: int, end: int) -> int | None:
        """Information bound of the change at a sample, from the samples before ``end``; None: not reached, or unknown.

        The course starts from the machine's own state at the change; that of a linear plant follows the input of the
        record, which begins at rest.
        """
        segments, performance = self.take.segments(), self._desk.performance
        number = next((i for i, segment in enumerate(segments) if segment.start == change), 0)
        if not number:  # no longer kept
            return None
        end = min([end, *(segment.start for segment in segments[number + 1 :])])
        before, after = (segment.plant.parameters() for segment in segments[number - 1 : number + 1])
        program, output = self._desk.program, performance.channels[self._desk.program.channels[OUTPUT]]
        try:
            clipped: Any = self._ring.read("clipped", change, end)
            model: Model | None = self._desk.machine(end, output.lsb_v)
            moment: Any
            if model is not None:
                moment = self._desk.moments[change]
            elif program.is_linear:
                codes: Any = self._ring.read("codes", 0, end)
                driven = performance.channels[program.channels[INPUT]].physical(codes[:, INPUT])
                period_s = performance.sample_period_s * performance.time_scale
                model = LinearPlant(program, driven, output.lsb, period_s)
                unchanged = model.course(model.at_rest(0, before), before, before, 0)
                unchanged.advance(change)
                moment = unchanged.moment()
            else:
                return None
            course_lsb = model.course(moment, before, after, segments[number].ramp_n).advance(end - change - 1)
            weight = weights(missing_samples(clipped), output.noise_lsb)
            found = information_of(model, PlantChange(0, before, after, moment, course_lsb), weight)
        except (LookupError, ConfigurationError):  # no longer in the ring; or a machine that cannot play so
            return None
        return first_at_level(found, self._sheet.log_arl0(self.take.scenario.expect.arl0))

    def estimated(self, theta: NDArray[np.floating]) -> NDArray[np.float64]:
        """Parameters ``program.estimates`` (n, m) of estimates theta; NaN if they describe no such plant."""
        program, sheet, performance = self._desk.program, self._sheet, self._desk.performance
        if sheet.model is None:
            return np.full((len(theta), len(program.estimates)), np.nan)
        input_per_code, output_per_code = (performance.channels[name].lsb for name in program.measured)
        period_s = performance.sample_period_s * performance.time_scale
        return estimated_parameters(program, theta, sheet.model, input_per_code, output_per_code, period_s)

    @property
    def estimate_names(self) -> tuple[str, ...]:
        """Parameters that the device estimates."""
        return self._desk.program.estimates if self._sheet.model is not None else ()

    def estimates(self) -> dict[str, float | None]:
        """Last estimates by parameter."""
        end = self._ring.end
        if not self.estimate_names or not end:
            return {}
        try:
            theta: Any = self._ring.read("theta", end - 1, end)
        except LookupError:
            return {}
        found = zip(self.estimate_names, self.estimated(theta)[0].tolist(), strict=True)
        return {name: None if math.isnan(value) else value for name, value in found}
