"""Import of a run from a CAN log, with the truth of a scenario and the units of a rig."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analogrig.answers import Answers
from analogrig.bench import RunBuilder
from analogrig.datasheet import Datasheet
from analogrig.devices.captured import CaptureDecoding, CapturedRun
from analogrig.devices.device import DeviceDescription
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.recordings.decoder import CaptureDecoder, FrameDictionary
from analogrig.recordings.files import CapturedFrames
from analogrig.recordings.measured_runs import scaled_to_program
from analogrig.recordings.scales import scale_findings
from analogrig.rigs.emulator import is_emulated
from analogrig.rigs.rig import Block
from analogrig.run import IMPORTED, INPUT, LOST, OUTPUT, Conditions, Run
from analogrig.scenario import Scenario
from analogrig.wording import number_of

if TYPE_CHECKING:
    from analogrig.rigs.rig import Performance, Rig

_MOST_NAMED = 3


def import_run(
    path: Path,
    scenario: Scenario,
    rig: Rig,
    *,
    dbc: Path | None = None,
    device: DeviceDescription | None = None,
    number: int | None = None,
    most_lost_n: int = 0,
    channels: Collection[str] = (),
) -> Run:
    """Run of a CAN log, with the truth of ``scenario`` and the units of ``rig``.

    Samples without codes or without all of their answers are LOST; those without codes are also missing. Channels
    other than input and output are not transmitted: their codes are zero and marked as clipped.

    :param dbc: DBC of the log, if it differs from the catalogue of this build.
    :param device: device with messages of its own (``decodes_logs``), to which the log belongs.
    :param number: number of the run in the log, from 1; None: the log holds exactly one.
    :param most_lost_n: largest number of lost samples in a valid run.
    :param channels: channels of the log to read; empty: all.
    :raises RecordingError: the file cannot be read, or holds no such run.
    :raises ConfigurationError: ``dbc`` is invalid, several buses carry the messages, or the log is longer than the
        scenario.
    """
    frames = CapturedFrames(path, channels=channels)
    performance = rig.perform(scenario, 0)
    decoder = _decoder(frames, dbc, device, performance, scenario.samples)
    frames.check_channels(decoder.known)
    captured = _select_run(decoder, frames, number)
    if captured.extent > scenario.samples:
        cause = f": {decoder.causes.losses[0]}" if decoder.causes.losses else ""
        raise ConfigurationError(
            f"{path}: has {number_of(captured.extent, 'sample')}, scenario {scenario.name} {scenario.samples}:"
            f" pass the scenario that was played{cause}"
        )
    answers = captured.answers(path)
    dut = {**captured.device(path), "most_lost_n": most_lost_n}
    faults = (*captured.faults, *captured.capture_faults(path), *([frames.end] if frames.end else []))
    builder = RunBuilder(captured.extent, len(scenario.program.channels), Datasheet.recorded(dut))
    builder.begin_record()
    builder.add(_block(captured, len(scenario.program.channels)), answers)
    return builder.build(
        Conditions(
            seed=0,
            samples_asked=scenario.samples,
            sample_period_s=performance.sample_period_s,
            time_scale=performance.time_scale,
            channels=performance.channels,
            segments=scenario.segments(),
            scenario=scenario.as_table(),
            rig=rig.description(),
            dut=dut,
            link=str(path),
            counters=_plausible_counters(captured, answers),
            link_counters={name: n for name, n in (*decoder.line.items(), ("lines_damaged", len(frames.damaged))) if n},
            faults=faults,
            losses=decoder.causes.losses,
            remarks=(*decoder.causes.remarks, *_scale_remarks(decoder, captured, rig, performance)),
            program=scenario.program,
        )
    )


def _decoder(
    frames: CapturedFrames, dbc: Path | None, device: DeviceDescription | None, performance: Performance, most_n: int
) -> CaptureDecoding:
    """Decoder of a log's messages: the catalogue's, or those of a device with messages of its own."""
    try:
        if device is None:
            return CaptureDecoder(FrameDictionary(dbc), frames)
        return device.log_decoder(performance.of_device, frames, most_n=most_n)
    except RecordingError as error:
        raise RecordingError(f"{frames.path}: {error}") from error


def _plausible_counters(captured: CapturedRun, answers: Answers) -> Mapping[str, int]:
    """Counters of the device without those of samples that it received and the log lacks."""
    counters = captured.counters
    lost = int(((answers.flags & LOST) != 0).sum())
    if lost <= counters.get("samples_lost", lost):
        return counters
    return {name: value for name, value in counters.items() if name not in {"samples_lost", "updated"}}


def _scale_remarks(
    decoder: CaptureDecoding, captured: CapturedRun, rig: Rig, performance: Performance
) -> Iterator[str]:
    """Sentences on samples that are scaled otherwise than those of the scenario, if an emulated rig can tell."""
    known = sorted(k for k, sample in captured.samples.items() if not sample[2])
    if not (decoder.carriers and known and is_emulated(rig)):
        return
    blocks = [block.codes[:, [INPUT, OUTPUT]] for block in performance.blocks]
    played = np.concatenate(blocks).astype(np.float64)
    known = [k for k in known if k < len(played)]
    logged = np.array([captured.samples[k][:2] for k in known], np.float64)
    yield from scale_findings((decoder.carriers["u"], decoder.carriers["y"]), logged, played[known])


def _block(captured: CapturedRun, channels: int) -> Block:
    """All samples of the run; those that the log lacks repeat the codes before them, as clipped."""
    n = captured.extent
    codes, clipped = np.zeros((n, channels), np.uint16), np.ones((n, channels), np.bool_)
    used = [INPUT, OUTPUT]
    for k in range(n):
        sample = captured.samples.get(k)
        if sample is not None:
            codes[k, used], clipped[k, used] = sample[:2], sample[2]
        elif k:
            codes[k] = codes[k - 1]
    return Block(0, np.full(codes.shape, np.nan), codes, clipped)


def replace_scenario(run: Run, scenario: Scenario) -> Run:
    """The same run with the plant and the expectations of another scenario.

    :raises ConfigurationError: ``scenario`` has fewer samples than the run, other channels, or units other than those
        of imported columns.
    """
    if run.samples > scenario.samples:
        raise ConfigurationError(
            f"the recording has {number_of(run.samples, 'sample')}, scenario {scenario.name} {scenario.samples}"
        )
    if scenario.program.channels != run.conditions.program.channels:
        there, here = (", ".join(each.channels) for each in (run.conditions.program, scenario.program))
        cure = ": import it again with --scenario" if run.conditions.source.kind == IMPORTED else ""
        raise ConfigurationError(f"the recording has the channels {there}, scenario {scenario.name} {here}{cure}")
    conditions = dataclasses.replace(
        run.conditions,
        program=scenario.program,
        scenario=scenario.as_table(),
        segments=scenario.segments(),
        samples_asked=scenario.samples,
    )
    return dataclasses.replace(run, conditions=scaled_to_program(conditions))


def _select_run(decoder: CaptureDecoding, frames: CapturedFrames, number: int | None) -> CapturedRun:
    path, runs = frames.path, [run for run in decoder.runs if run.samples]
    if not runs:
        raise RecordingError(f"{path}: holds no run of a device{_empty_reason(decoder, frames)}")
    if number is None and len(runs) > 1:
        raise RecordingError(f"{path}: holds {len(runs)} runs: select one with --run 1 to {len(runs)}")
    if number is not None and not 1 <= number <= len(runs):
        raise RecordingError(f"{path}: has no run {number}: there are {len(runs)}")
    return runs[(number or 1) - 1]


def _empty_reason(decoder: CaptureDecoding, frames: CapturedFrames) -> str:
    """Clause of a message: the likely reason that the log holds no run; empty if unknown."""
    if frames.end:
        return f": {frames.end}"
    if frames.damaged:
        first = ", ".join(map(str, frames.damaged[:_MOST_NAMED]))
        lines = number_of(len(frames.damaged), "line is no frame", "lines are no frames")
        return f": {lines} (at {first}); candump -L writes the expected format"
    if decoder.causes.losses:
        return f": {'; '.join((*decoder.causes.losses, *decoder.causes.remarks)[:_MOST_NAMED])}"
    foreign = decoder.line["frames_foreign"]
    others = number_of(foreign, "frame has another identifier", "frames have other identifiers")
    return f": {others}; pass the DBC of the log with --dbc" if foreign else ""
