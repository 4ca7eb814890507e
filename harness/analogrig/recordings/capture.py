"""A run from a CAN log: with the truth of a scenario, and the units of a rig."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analogrig import catalogue
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.estimator_config import MAX_PARAMETERS, EstimatorConfig
from analogrig.recordings.dictionary import Dictionary
from analogrig.recordings.frames import CapturedFrames
from analogrig.recordings.talk import CapturedRun, CapturedTalk
from analogrig.run import CHANNELS, LOST, UNREPORTED, Conditions, Run
from analogrig.scenario import Scenario
from analogrig.wording import number_of

if TYPE_CHECKING:
    from analogrig.rigs.rig import Rig

_MOST_NAMED = 3
_COUNTERS = ("updated", "refused", "alarms", "samples_lost")
"""Of the device; by these it is known whether all that it did was heard."""


def captured_run(
    path: Path,
    scenario: Scenario,
    rig: Rig,
    *,
    dbc: Path | None = None,
    number: int | None = None,
    most_lost_n: int = 0,
) -> Run:
    """The run that a CAN log holds, with the truth of ``scenario`` and the units of ``rig``.

    Samples without codes or without all of their answers are LOST, and those without codes missing. Velocity and net
    force do not travel: their codes are zero, and marked as clipped.

    :param number: which of several runs, from 1; None: there is only one.
    :raises RecordingError: the file cannot be read, or there is no such run in it.
    :raises ConfigurationError: ``dbc`` is wrong, or the scenario is not the one of the log.
    """
    frames = CapturedFrames(path)
    try:
        talk = CapturedTalk(Dictionary(dbc), frames)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    said = _chosen(talk, frames, number)
    if said.extent > scenario.samples:
        raise ConfigurationError(
            f"{path}: has {number_of(said.extent, 'sample')}, scenario {scenario.name} {scenario.samples}:"
            " is it another one?"
        )
    return _run(path, said, scenario, rig, most_lost_n=most_lost_n, line=_line(talk, frames), end=frames.end)


def retold(run: Run, scenario: Scenario) -> Run:
    """A recorded run with what another scenario says of its plant and asks of its device.

    :raises ConfigurationError: it has fewer samples.
    """
    if run.samples > scenario.samples:
        raise ConfigurationError(
            f"the recording has {number_of(run.samples, 'sample')}, scenario {scenario.name} {scenario.samples}"
        )
    conditions = dataclasses.replace(
        run.conditions,
        scenario=scenario.as_table(),
        segments=scenario.segments(),
        samples_asked=scenario.samples,
    )
    return dataclasses.replace(run, conditions=conditions)


def _line(talk: CapturedTalk, frames: CapturedFrames) -> dict[str, int]:
    """What else was seen, by name."""
    seen = {**talk.line, "lines_damaged": len(frames.damaged)}
    return {name: n for name, n in seen.items() if n}


def _chosen(talk: CapturedTalk, frames: CapturedFrames, number: int | None) -> CapturedRun:
    path, runs = frames.path, [run for run in talk.runs if run.samples]
    if not runs:
        raise RecordingError(f"{path}: holds no run of a device{_why(talk, frames)}")
    if number is None and len(runs) > 1:
        raise RecordingError(f"{path}: holds {len(runs)} runs: say --run 1 to {len(runs)}")
    if number is not None and not 1 <= number <= len(runs):
        raise RecordingError(f"{path}: has no run {number}: there are {len(runs)}")
    return runs[(number or 1) - 1]


def _why(talk: CapturedTalk, frames: CapturedFrames) -> str:
    """As far as that can be told."""
    if frames.end:
        return f": {frames.end}"
    if frames.damaged:
        first = ", ".join(map(str, frames.damaged[:_MOST_NAMED]))
        lines = number_of(len(frames.damaged), "line is no frame", "lines are no frames")
        return f": {lines} (at {first}); candump -L writes what can be read"
    foreign = talk.line["frames_foreign"]
    others = number_of(foreign, "frame has another identifier", "frames have other identifiers")
    return f": {others}; --dbc says which are ours" if foreign else ""


def _run(
    path: Path, said: CapturedRun, scenario: Scenario, rig: Rig, *, most_lost_n: int, line: Mapping[str, int], end: str
) -> Run:
    most = min(MAX_PARAMETERS, said.identity.get("theta_max", MAX_PARAMETERS))
    estimator = EstimatorConfig.from_settings(said.settings, str(path), most)
    rows = _Rows(said, estimator.parameters)
    counters = dict(said.counters)
    lost = int(((rows.flags & LOST) != 0).sum())
    if lost > counters.get("samples_lost", lost):  # it has seen what the capture has not
        counters = {name: value for name, value in counters.items() if name not in {"samples_lost", "updated"}}
    faults = (*scenario.caveats, *said.faults, *_gaps(path, said), *([end] if end else []))
    performance = rig.perform(scenario, 0)
    alarms = [alarm for alarm in said.alarms if 0 <= alarm[0] < said.extent]
    diagnoses = [each for each in said.diagnoses if 0 <= each[0] < said.extent]
    return Run(
        conditions=Conditions(
            seed=0,
            samples_asked=scenario.samples,
            sample_period_s=performance.sample_period_s,
            time_scale=performance.time_scale,
            channels=performance.channels,
            segments=scenario.segments(),
            scenario=scenario.as_table(),
            rig=rig.description(),
            dut={
                "name": "captured",
                "kind": "log",
                "report_interval_n": said.report_interval_n,
                "most_lost_n": most_lost_n,
                "estimator": estimator.as_table(),
                "assumed_n": sum(key not in said.settings for key, _ in estimator.settings()),
                "identity": dict(said.identity),
            },
            link=str(path),
            counters=counters,
            link_counters=line,
            faults=faults,
        ),
        codes=rows.codes,
        clipped=rows.clipped,
        theta=rows.values[:, :-1],
        innovation=rows.values[:, -1],
        statistic=rows.statistic,
        flags=rows.flags,
        **_columns(alarms, ("alarm_index", "alarm_kind", "alarm_statistic")),
        **_columns(diagnoses, ("diagnosis_index", "diagnosis_change", "diagnosis_onset", "diagnosis_extent")),
    )


def _gaps(path: Path, said: CapturedRun) -> Iterator[str]:
    """What the device did by its counters and the capture does not hold."""
    alarms = said.counters.get("alarms", len(said.alarms))
    if alarms != len(said.alarms):
        yield f"the device raised {number_of(alarms, 'alarm')}, {path} holds {len(said.alarms)}"
    lacking = [name for name in _COUNTERS if name not in said.counters]
    if lacking:
        yield f"the device's counters {', '.join(lacking)} after the run are not in {path}"


_TYPES = {"index": np.int64, "onset": np.int64, "kind": np.uint8, "change": np.uint8}


def _columns(rows: Sequence[Sequence[float]], names: Sequence[str]) -> dict[str, Any]:
    columns: Iterable[Sequence[float]] = zip(*rows, strict=True) if rows else itertools.repeat(())
    types = [_TYPES.get(name.rpartition("_")[2], np.float32) for name in names]
    return {name: np.array(column, kind) for name, kind, column in zip(names, types, columns, strict=False)}


class _Rows:
    """The arrays of a run."""

    def __init__(self, said: CapturedRun, parameters: int) -> None:
        n, elements = said.extent, (*range(parameters), int(catalogue.Element.INNOVATION))
        self.codes = np.zeros((n, len(CHANNELS)), np.uint16)
        self.clipped = np.ones((n, len(CHANNELS)), np.bool_)
        self.values = np.zeros((n, len(elements)), np.float32)
        self.statistic = np.zeros(n, np.float32)
        self.flags = np.zeros(n, np.uint8)
        used = [CHANNELS.index("force"), CHANNELS.index("displacement")]
        for k in range(n):
            sample, estimate = said.samples.get(k), said.estimates.get(k, {})
            is_whole = set(estimate) >= set(elements)
            if sample is not None:
                self.codes[k, used], self.clipped[k, used] = sample[:2], sample[2]
            elif k:
                self.codes[k] = self.codes[k - 1]
            if is_whole:
                self.values[k] = [estimate[element] for element in elements]
            elif k:
                self.values[k, :-1] = self.values[k - 1, :-1]
            flags, self.statistic[k] = said.steps.get(k, (LOST, self.statistic[k - 1] if k else 0.0))
            is_due = bool(estimate) or said.report_interval_n == 1
            if sample is None or k in said.torn or (is_due and not is_whole):
                flags |= LOST
            self.flags[k] = flags if is_whole or flags & LOST else flags | UNREPORTED
