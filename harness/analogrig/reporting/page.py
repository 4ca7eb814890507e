"""Page of one run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from analogrig.identity import Identity
from analogrig.judging.advice import advice
from analogrig.judging.response import step_responses
from analogrig.judging.verdict import Verdict, missing_text
from analogrig.output import replace_file
from analogrig.pages import FOLDER, PLOTS, render_page
from analogrig.reporting.measured import measured
from analogrig.reporting.payload import as_script, is_thinned, marked_alarms, payload
from analogrig.reporting.run_summary import change_text, lamps_text, response_text
from analogrig.run import Run


def write_report(run: Run, verdict: Verdict, path: str | Path) -> None:
    """Write a run and its verdict as one HTML page without remote resources, atomically.

    The same run gives the same bytes.

    :raises RecordingError: the page cannot be written, or uPlot is not installed by the build.
    """
    page = render(run, verdict)
    with replace_file(Path(path)) as file:
        file.write(page.encode("utf-8", "replace"))


def render(run: Run, verdict: Verdict) -> str:
    """HTML page of a run and its verdict.

    :raises RecordingError: uPlot is not installed by the build.
    """
    context, program = run.conditions, run.conditions.program
    name = f"{context.played.name} on {context.source.name}, device {context.device.name}"
    problem_ms, machine_us = context.sample_period_problem_s * 1e3, context.sample_period_s * 1e6
    return render_page(
        "run.html",
        (*PLOTS, FOLDER / "page.js"),
        title=f"{verdict.outcome.upper()}: {name}",
        run=run,
        verdict=verdict,
        name=name,
        reasons=[*verdict.reasons, *(f"Note: {sentence}." for sentence in advice(run, verdict))],
        conditions=_conditions(run, verdict),
        measured=measured(run),
        change_text=change_text,
        response_text=response_text,
        responses=step_responses(run) if context.segments and not program.estimates else (),
        statistics=dict(zip(run.alarm_index.tolist(), run.alarm_statistic.tolist(), strict=True)),
        period=f"{problem_ms:.4g} ms of problem time, {machine_us:.4g} µs at the machine",
        is_thinned=is_thinned(run),
        marked=marked_alarms(run, verdict),
        settings=_settings(run),
        data=as_script(payload(run, verdict)),
    )


def _conditions(run: Run, verdict: Verdict) -> list[tuple[str, object]]:
    """Scenario, rig, device, link and provenance, with their names."""
    context = run.conditions
    scenario = context.played
    asked = context.samples_asked
    played = f"{run.samples:,}" if run.samples == asked else f"{run.samples:,} of {asked:,} asked"
    return [
        ("Scenario", f"{scenario.name}{f': {scenario.description}' if scenario.description else ''}"),
        ("Rig", context.source.name),
        ("Device", context.device.name),
        ("Firmware", _firmware(context.device.identity) or "unknown"),
        ("Link", context.link),
        ("Seed", context.seed),
        ("Samples", f"{played}; {verdict.missing_n:,} {missing_text(run)}"),
        ("Overload lamps", lamps_text(verdict.overloads)),
        ("Theta hash", verdict.theta_hash or "none: the device reports no estimates"),
        ("Alarm hash", verdict.alarm_hash),
        *provenance(context.identity),
    ]


def provenance(identity: Identity | None) -> list[tuple[str, str]]:
    """Provenance of a result: names and values, not escaped; empty if unknown."""
    if identity is None:
        return []
    made_by = f"{identity.analogrig}, commit {identity.commit or 'unknown'}, Python {identity.python}"
    return [
        ("analogrig", made_by),
        ("Command", identity.command),
        ("Started", f"{identity.started} on {identity.host}"),
        *(("Device file", f"{each.path}, SHA-256 {each.sha256 or 'unknown'}") for each in identity.devices),
    ]


def _firmware(identity: Mapping[str, Any]) -> str:
    """Identity of the firmware in words; hashes and nonces in hexadecimal."""
    hexadecimal = {key for key, value in identity.items() if isinstance(value, int) and key.endswith(("hash", "nonce"))}
    values = {key: f"{value:#010x}" if key in hexadecimal else value for key, value in identity.items()}
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in values.items())


def _settings(run: Run) -> Iterator[tuple[str, Any]]:
    """All settings and counters in the recording, by their paths ``a.b.c``."""
    context = run.conditions
    return _flatten(
        {
            "scenario": context.scenario,
            "rig": context.rig,
            "device": context.dut,
            "channel": {name: vars(channel) for name, channel in context.channels.items()},
            "counter": context.counters,
        }
    )


def _flatten(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Paths ``a.b.c`` and values of nested tables."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        elif isinstance(value, (list, tuple)) and any(isinstance(item, Mapping) for item in value):
            yield from _flatten({str(i): item for i, item in enumerate(value)}, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
