"""Texts and tables of the page of a run. ``markup`` escapes every text that may come from a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from analogrig.identity import Identity
from analogrig.judging.advice import advice
from analogrig.judging.response import step_responses
from analogrig.judging.verdict import (
    DIAGNOSES,
    ESTIMATES,
    STATISTIC,
    ChangeVerdict,
    ChannelFault,
    MisfitPeriod,
    SegmentEstimate,
    Verdict,
    missing_text,
)
from analogrig.program import Program
from analogrig.protocol.bus_load import load_of
from analogrig.reporting.markup import cell, heading, number, pairs, row, table, text
from analogrig.reporting.payload import is_thinned, marked_alarms
from analogrig.reporting.summary import change_text, lamps_text, load_text, response_text
from analogrig.run import Run
from analogrig.wording import number_of

_MAX_FALSE_ALARMS = 20
"""Rows in the table of false alarms; the plots mark more."""

_MAX_MISFITS = 20
"""Rows in the table of misfits."""

_MAX_CHANNEL_FAULTS = 20
"""Rows in the table of faults of the channels."""

_SIGNS = {"passed": "✓", "failed": "✗", "inconclusive": "?", "unjudged": "–"}

_SENTENCES = {
    "passed": "The device met the expectations of the scenario.",
    "failed": "The device did not meet the expectations of the scenario.",
    "inconclusive": "This run is not valid. The figures below prove nothing about the device.",
    "unjudged": "Nothing is known of the plant: no figure below is a verdict on the device.",
}

_NO_DIAGNOSES = "<p>Not judged: the device does not report diagnoses.</p>"


def title(run: Run, verdict: Verdict) -> str:
    """Title of the page, escaped."""
    return f"{text(verdict.outcome.upper())}: {_run_title(run)}"


def outcome(run: Run, verdict: Verdict) -> str:
    """Banner with the outcome, the reasons, and advice."""
    notes = (f"Note: {sentence}." for sentence in advice(run, verdict))
    reasons = "".join(f"<li>{text(sentence)}</li>" for sentence in (*verdict.reasons, *notes))
    return (
        f'<section class="outcome {verdict.outcome}" aria-labelledby="outcome">'
        f'<h1 id="outcome"><span class="sign" aria-hidden="true">{_SIGNS[verdict.outcome]}</span>'
        f" {text(verdict.outcome.upper())}<small>{_run_title(run)}</small></h1>"
        f"<p>{_SENTENCES[verdict.outcome]}</p>"
        f"{f'<ul>{reasons}</ul>' if reasons else ''}"
        f"{_figures_sentence(run, verdict)}</section>"
    )


def conditions(run: Run, verdict: Verdict) -> str:
    """Table of the conditions: scenario, rig, device, link and provenance."""
    context = run.conditions
    description = context.scenario.get("description")
    load = load_of(run)
    rows = [
        ("Scenario", f"{context.scenario['name']}{f': {description}' if description else ''}"),
        ("Rig", context.rig["name"]),
        ("Device", context.dut["name"]),
        ("Firmware", _firmware(context.dut.get("identity", {})) or "unknown"),
        ("Link", context.link),
        ("Bus load", "unknown, or no CAN bus" if load is None else load_text(load)),
        ("Seed", context.seed),
        ("Samples", _samples(run, verdict)),
        ("Overload lamps", lamps_text(verdict.overloads)),
        ("Theta hash", verdict.theta_hash or "none: the device reports no estimates"),
        ("Alarm hash", verdict.alarm_hash),
        *provenance(context.identity),
    ]
    return pairs("Scenario, rig and device", rows)


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


def tweaks(run: Run, verdict: Verdict) -> str:
    """Table of the changes of the plant, with latency, bound and result."""
    if not verdict.knows_truth:
        return "<p>Not judged: nothing is known of the plant.</p>"
    if not verdict.tweaks:
        return "<p>The plant did not change in this run.</p>"
    assumed = f"the bound is of first order, for one false alarm in {verdict.arl0:,.0f} samples"
    caption = f"Latency and bound in samples from the change; {assumed}"
    if any(tweak.alternatives for tweak in verdict.tweaks):
        caption += "; a range if the instant was estimated from the samples"
    head = heading(("Sample", "Change"), ("Latency", "Bound", "Latency / bound"), ("Result",))
    return table(caption, head, (_change_row(tweak, run.conditions.program) for tweak in verdict.tweaks))


def diagnoses(run: Run, verdict: Verdict) -> str:
    """Table of the diagnoses, compared with the truth."""
    if not run.datasheet.diagnoses:
        return _NO_DIAGNOSES
    if DIAGNOSES in verdict.not_judged:
        return f"<p>Not judged: no parameter of the program {text(run.conditions.program.name)} has a diagnosis.</p>"
    if all(tweak.diagnosis is None for tweak in verdict.tweaks):
        return "<p>The device reported no diagnosis of a change.</p>"
    caption = "Diagnoses of the device; delay and isolation bound in samples from the change"
    numbers = ("Extent", "Error", "Delay", "Bound", "Onset error")
    head = heading(("Sample", "Changed", "Named"), numbers, ("Result",))
    return table(caption, head, map(_diagnosis_row, verdict.tweaks))


def channel_faults(run: Run, verdict: Verdict) -> str:
    """Table of the faults of the channels that the device diagnosed."""
    if not run.datasheet.diagnoses:
        return _NO_DIAGNOSES
    if not verdict.channel_faults:
        return "<p>The device reported none.</p>"
    shown = verdict.channel_faults[:_MAX_CHANNEL_FAULTS]
    caption = "Faults as diagnosed by the device; onset: likeliest sample of the beginning"
    head = heading(("Sample", "Fault"), ("Onset", "Extent"), ("Cure",))
    return table(caption, head, (_channel_fault_row(fault) for fault in shown))


def false_alarms(run: Run, verdict: Verdict) -> str:
    """Table of the false alarms."""
    count = len(verdict.false_alarms)
    if not verdict.knows_truth:
        return f"<p>Not judged: {number_of(len(run.alarm_index), 'alarm', form=',')}, each false or not.</p>"
    if not count and verdict.doubtful_alarms:
        at = ", ".join(map(str, verdict.doubtful_alarms[:_MAX_FALSE_ALARMS]))
        return f"<p>None for certain. Depending on the instants of the changes, the alarms at {at} are false.</p>"
    if not count:
        return f"<p>None in {number_of(run.samples, 'sample', form=',')}.</p>"
    statistics = dict(zip(run.alarm_index.tolist(), run.alarm_statistic.tolist(), strict=True))
    shown = verdict.false_alarms[:_MAX_FALSE_ALARMS]
    caption = f"{count:,} in {number_of(run.samples, 'sample', form=',')}" + (
        f"; the first {len(shown)} are listed" if count > len(shown) else ""
    )
    if STATISTIC in verdict.not_judged:
        return table(caption, heading(("Sample",)), (row([_zoom(index)]) for index in shown))
    rows = (row([_zoom(index), number(statistics.get(index))]) for index in shown)
    return table(caption, heading(("Sample",), ("Statistic",)), rows)


def fit(verdict: Verdict) -> str:
    """Table of the periods in which the model did not fit."""
    if verdict.fit is None:
        return "<p>Not judged: the device does not watch whether its model fits.</p>"
    if not verdict.fit:
        return "<p>The device reported no misfit.</p>"
    caption = "Cause of the misfit as reported by the device; strength: statistic over its limit"
    head = heading(("Samples", "Cause"), ("Frequency [Hz]", "Strength"), ("Cure",))
    return table(caption, head, (_misfit_row(period) for period in verdict.fit[:_MAX_MISFITS]))


def estimates(run: Run, verdict: Verdict) -> str:
    """Table of the estimated parameters at the end of each segment, compared with the truth."""
    program = run.conditions.program
    if not program.estimates:
        why = f"<p>Not judged: the program {text(program.name)} relates no estimate to its parameters.</p>"
        return why + _step_responses(run)
    if ESTIMATES in verdict.not_judged:
        return "<p>Not judged: the device does not report estimates of them.</p>"
    if not verdict.estimates:
        return "<p>The rig does not know the truth about its plant.</p>"
    groups = [
        f'<th scope="colgroup" colspan="3">{name} [{text(program.unit(name))}]</th>' for name in program.estimates
    ]
    head = row(['<th scope="col" rowspan="2">Samples</th>', *groups])
    head += heading((), ("estimate", "truth", "error") * len(program.estimates))
    rows = (_segment_row(segment) for segment in verdict.estimates)
    return table("The estimate after the last sample of each segment", head, rows)


def _step_responses(run: Run) -> str:
    """Table of the estimates' step responses against those of the circuit; empty without any."""
    found = step_responses(run) if run.conditions.segments else ()
    if not found:
        return ""
    head = heading(("Samples", "Largest difference"))
    rows = (
        row([f'<th scope="row">{each.start}–{each.end - 1}</th>', f"<td>{text(response_text(each))}</td>"])
        for each in found
    )
    return table("Step response of the estimate after the last sample, against the circuit's", head, rows)


def settings(run: Run) -> str:
    """Table of all settings and counters in the recording."""
    context = run.conditions
    channels = {name: vars(channel) for name, channel in context.channels.items()}
    everything = {
        "scenario": context.scenario,
        "rig": context.rig,
        "device": context.dut,
        "channel": channels,
        "counter": context.counters,
    }
    return pairs("As recorded", _flatten(everything))


def period(run: Run) -> str:
    """Sample period in problem time and at the machine, escaped."""
    context = run.conditions
    problem_ms, machine_us = context.sample_period_problem_s * 1e3, context.sample_period_s * 1e6
    return text(f"{problem_ms:.4g} ms of problem time, {machine_us:.4g} µs at the machine")


def resolution(run: Run, verdict: Verdict) -> str:
    """Sentences about samples and alarms that the plots leave out, with a leading space; empty if none."""
    out = ""
    if is_thinned(run):
        out += (
            " The run is long: the plots hold every sample near changes and the first alarms; elsewhere minima and"
            " maxima of several samples. The recording holds every sample."
        )
    marked, alarms = marked_alarms(run, verdict), len(run.alarm_index)
    if marked < alarms:
        out += f" {marked:,} of {alarms:,} alarms are marked."
    return out


def _run_title(run: Run) -> str:
    context = run.conditions
    return f"{text(context.scenario['name'])} on {text(context.rig['name'])}, device {text(context.dut['name'])}"


def _figures_sentence(run: Run, verdict: Verdict) -> str:
    """Detections and false alarms in one sentence; empty for an invalid run, whose figures prove nothing."""
    if not verdict.valid:
        return ""
    detected = sum(tweak.result in {"detected", "late"} for tweak in verdict.tweaks)
    count = len(verdict.tweaks)
    changes = f"{detected} of {_plural(count, 'change')} detected" if count else "No change to detect"
    false = _plural(len(verdict.false_alarms), "false alarm")
    return f"<p>{changes}, {false}, in {_plural(run.samples, 'sample')}.</p>"


def _plural(count: int, noun: str) -> str:
    return number_of(count, noun, form=",") if count else f"no {noun}s"


def _samples(run: Run, verdict: Verdict) -> str:
    asked = run.conditions.samples_asked
    played = f"{run.samples:,}" if run.samples == asked else f"{run.samples:,} of {asked:,} asked"
    return f"{played}; {verdict.missing_n:,} {missing_text(run)}"


def _change_row(tweak: ChangeVerdict, program: Program) -> str:
    exact = not tweak.alternatives and tweak.latency_n is not None and tweak.bound_n
    ratio = (tweak.latency_n or 0) / (tweak.bound_n or 1) if exact else None
    word, kind = _result(tweak)
    low, high = tweak.between
    instant = _zoom(tweak.sample) if low == high else _zoom(low, high)
    latency = "–" if tweak.latencies_n is None else tweak.latency_text.replace("-", "–")
    cells = [instant, cell(change_text(tweak, program).replace("->", "→"))]
    cells += [cell(latency, "number"), cell("?", "number") if not tweak.is_bounded else number(tweak.bound_n)]
    return row([*cells, number(ratio, ".2f"), cell(word, f"text {kind}")])


def _diagnosis_row(tweak: ChangeVerdict) -> str:
    sample, diagnosis = f'<th scope="row">{tweak.sample}</th>', tweak.diagnosis
    if diagnosis is None:
        return row(
            [sample, cell(tweak.what), cell("nothing"), *[number(None)] * 5, cell("no diagnosis", "text neutral")]
        )
    word, kind = ("✓ right", "good") if diagnosis.right else ("✗ WRONG", "bad")
    cells = [sample, cell(tweak.what), cell(diagnosis.named)]
    cells += [number(diagnosis.extent, ".3f"), number(diagnosis.extent_error, "+.1%")]
    cells += [number(diagnosis.delay_n), number(diagnosis.bound_n), number(diagnosis.onset_error_n, "+d")]
    return row([*cells, cell(word, f"text {kind}")])


def _channel_fault_row(fault: ChannelFault) -> str:
    cells = [_zoom(fault.sample), cell(fault.name), number(fault.onset), number(fault.extent, ".3f")]
    return row([*cells, cell(fault.cure, "text")])


def _misfit_row(period: MisfitPeriod) -> str:
    cells = [_zoom(period.start, period.end - 1), cell(period.cause), number(period.frequency_hz, ".4g")]
    return row([*cells, number(period.strength, ".2f"), cell(period.cure, "text")])


def _result(tweak: ChangeVerdict) -> tuple[str, str]:
    """Result in words, and its style class."""
    return {
        "missed": ("✗ MISSED", "bad"),
        "late": (f"✗ LATE, after {tweak.deadline_n}", "bad"),
        "unseeable": ("not detectable", "neutral"),
        "undecided": ("? depends on its instant", "neutral"),
        "not judged": ("? not judged: not found in the samples", "neutral"),
        "detected": ("✓ detected", "good"),
    }[tweak.result]


def _segment_row(segment: SegmentEstimate) -> str:
    cells = [_zoom(segment.start, segment.end - 1)]
    for name in segment.truth:
        estimate = None if segment.estimate is None else segment.estimate[name]
        error = None if estimate is None else round(segment.error[name], 4) + 0.0  # never a negative zero
        cells += [number(estimate, ".5g"), number(segment.truth[name], ".6g"), number(error, "+.2%")]
    return row(cells)


def _flatten(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Paths ``a.b.c`` and values of nested tables."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        elif isinstance(value, (list, tuple)) and any(isinstance(item, Mapping) for item in value):
            yield from _flatten({str(i): item for i, item in enumerate(value)}, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _firmware(identity: Mapping[str, Any]) -> str:
    """Identity of the firmware in words; hashes and nonces in hexadecimal."""
    hexadecimal = {key for key, value in identity.items() if isinstance(value, int) and key.endswith(("hash", "nonce"))}
    values = {key: f"{value:#010x}" if key in hexadecimal else value for key, value in identity.items()}
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in values.items())


def _zoom(first: int, last: int | None = None) -> str:
    """Row heading that zooms the plots to these samples."""
    shown, until = (str(first), "") if last is None else (f"{first}–{last}", f' data-last="{last}"')
    goal = f'data-first="{first}"{until} title="Show in the plots"'
    return f'<th scope="row"><button type="button" {goal}>{shown}</button></th>'
