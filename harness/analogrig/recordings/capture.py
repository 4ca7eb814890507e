"""Import of a run from a CAN log, with the truth of a scenario and the units of a rig."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analogrig import catalogue
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.estimator_config import MAX_PARAMETERS, EstimatorConfig
from analogrig.recordings.decoder import CaptureDecoder, CapturedRun, FrameDictionary
from analogrig.recordings.files import CapturedFrames
from analogrig.run import CHANNELS, LOST, UNREPORTED, Conditions, Run
from analogrig.scenario import Scenario
from analogrig.wording import number_of

if TYPE_CHECKING:
    from analogrig.rigs.rig import Rig

_MOST_NAMED = 3
_COUNTERS = ("updated", "refused", "alarms", "samples_lost")
"""Counters of the device that prove whether the capture is complete."""


def import_run(
    path: Path,
    scenario: Scenario,
    rig: Rig,
    *,
    dbc: Path | None = None,
    number: int | None = None,
    most_lost_n: int = 0,
) -> Run:
    """Run of a CAN log, with the truth of ``scenario`` and the units of ``rig``.

    Samples without codes or without all of their answers are LOST; those without codes are also missing. Velocity and
    net force are not transmitted: their codes are zero and marked as clipped.

    :param dbc: DBC of the log, if it differs from the catalogue of this build.
    :param number: number of the run in the log, from 1; None: the log holds exactly one.
    :param most_lost_n: largest number of lost samples in a valid run.
    :raises RecordingError: the file cannot be read, or holds no such run.
    :raises ConfigurationError: ``dbc`` is invalid, or the log is longer than the scenario.
    """
    frames = CapturedFrames(path)
    try:
        decoder = CaptureDecoder(FrameDictionary(dbc), frames)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    captured = _select_run(decoder, frames, number)
    if captured.extent > scenario.samples:
        raise ConfigurationError(
            f"{path}: has {number_of(captured.extent, 'sample')}, scenario {scenario.name} {scenario.samples}:"
            " pass the scenario that was played"
        )
    return _run(
        path, captured, scenario, rig, most_lost_n=most_lost_n, line=_line_counts(decoder, frames), end=frames.end
    )


def replace_scenario(run: Run, scenario: Scenario) -> Run:
    """The same run with the plant and the expectations of another scenario.

    :raises ConfigurationError: ``scenario`` has fewer samples than the run.
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


def _line_counts(decoder: CaptureDecoder, frames: CapturedFrames) -> dict[str, int]:
    """Traffic other than intact messages of harness and device: counts by name."""
    counts = {**decoder.line, "lines_damaged": len(frames.damaged)}
    return {name: n for name, n in counts.items() if n}


def _select_run(decoder: CaptureDecoder, frames: CapturedFrames, number: int | None) -> CapturedRun:
    path, runs = frames.path, [run for run in decoder.runs if run.samples]
    if not runs:
        raise RecordingError(f"{path}: holds no run of a device{_empty_reason(decoder, frames)}")
    if number is None and len(runs) > 1:
        raise RecordingError(f"{path}: holds {len(runs)} runs: select one with --run 1 to {len(runs)}")
    if number is not None and not 1 <= number <= len(runs):
        raise RecordingError(f"{path}: has no run {number}: there are {len(runs)}")
    return runs[(number or 1) - 1]


def _empty_reason(decoder: CaptureDecoder, frames: CapturedFrames) -> str:
    """Clause of a message: the likely reason that the log holds no run; empty if unknown."""
    if frames.end:
        return f": {frames.end}"
    if frames.damaged:
        first = ", ".join(map(str, frames.damaged[:_MOST_NAMED]))
        lines = number_of(len(frames.damaged), "line is no frame", "lines are no frames")
        return f": {lines} (at {first}); candump -L writes the expected format"
    foreign = decoder.line["frames_foreign"]
    others = number_of(foreign, "frame has another identifier", "frames have other identifiers")
    return f": {others}; pass the DBC of the log with --dbc" if foreign else ""


def _run(
    path: Path,
    captured: CapturedRun,
    scenario: Scenario,
    rig: Rig,
    *,
    most_lost_n: int,
    line: Mapping[str, int],
    end: str,
) -> Run:
    most = min(MAX_PARAMETERS, captured.identity.get("theta_max", MAX_PARAMETERS))
    estimator = EstimatorConfig.from_settings(captured.settings, str(path), most)
    rows = _RunArrays(captured, estimator.parameters)
    counters = dict(captured.counters)
    lost = int(((rows.flags & LOST) != 0).sum())
    if lost > counters.get("samples_lost", lost):  # the device received samples that the capture lacks
        counters = {name: value for name, value in counters.items() if name not in {"samples_lost", "updated"}}
    faults = (*scenario.caveats, *captured.faults, *_capture_faults(path, captured), *([end] if end else []))
    performance = rig.perform(scenario, 0)
    alarms = [alarm for alarm in captured.alarms if 0 <= alarm[0] < captured.extent]
    diagnoses = [each for each in captured.diagnoses if 0 <= each[0] < captured.extent]
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
                "report_interval_n": captured.report_interval_n,
                "most_lost_n": most_lost_n,
                "estimator": estimator.as_table(),
                "assumed_n": sum(key not in captured.settings for key, _ in estimator.settings()),
                "identity": dict(captured.identity),
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
        **_event_arrays(alarms, _ALARM),
        **_event_arrays(diagnoses, _DIAGNOSIS),
    )


def _capture_faults(path: Path, captured: CapturedRun) -> Iterator[str]:
    """Faults: alarms missing from the capture, or counters that cannot confirm it."""
    alarms = captured.counters.get("alarms", len(captured.alarms))
    if alarms != len(captured.alarms):
        yield f"the device raised {number_of(alarms, 'alarm')}, {path} holds {len(captured.alarms)}"
    lacking = [name for name in _COUNTERS if name not in captured.counters]
    if lacking:
        yield f"the device's counters {', '.join(lacking)} after the run are not in {path}"


_ALARM = (("alarm_index", np.int64), ("alarm_kind", np.uint8), ("alarm_statistic", np.float32))
_DIAGNOSIS = (
    ("diagnosis_index", np.int64),
    ("diagnosis_change", np.uint8),
    ("diagnosis_onset", np.int64),
    ("diagnosis_extent", np.float32),
)
"""Fields of ``Run``, in the order of the rows of ``CapturedRun``."""


def _event_arrays(rows: Sequence[Sequence[float]], fields: Sequence[tuple[str, type]]) -> dict[str, Any]:
    return {name: np.array([row[i] for row in rows], kind) for i, (name, kind) in enumerate(fields)}


class _RunArrays:
    """Arrays of a run, filled from a capture."""

    def __init__(self, captured: CapturedRun, parameters: int) -> None:
        n, elements = captured.extent, (*range(parameters), int(catalogue.Element.INNOVATION))
        self.codes = np.zeros((n, len(CHANNELS)), np.uint16)
        self.clipped = np.ones((n, len(CHANNELS)), np.bool_)
        self.values = np.zeros((n, len(elements)), np.float32)
        self.statistic = np.zeros(n, np.float32)
        self.flags = np.zeros(n, np.uint8)
        used = [CHANNELS.index("force"), CHANNELS.index("displacement")]
        for k in range(n):
            sample, estimate = captured.samples.get(k), captured.estimates.get(k, {})
            is_whole = set(estimate) >= set(elements)
            if sample is not None:
                self.codes[k, used], self.clipped[k, used] = sample[:2], sample[2]
            elif k:
                self.codes[k] = self.codes[k - 1]
            if is_whole:
                self.values[k] = [estimate[element] for element in elements]
            elif k:
                self.values[k, :-1] = self.values[k - 1, :-1]
            flags, self.statistic[k] = captured.steps.get(k, (LOST, self.statistic[k - 1] if k else 0.0))
            is_due = bool(estimate) or captured.report_interval_n == 1
            if sample is None or k in captured.incomplete or (is_due and not is_whole):
                flags |= LOST
            self.flags[k] = flags if is_whole or flags & LOST else flags | UNREPORTED
