"""Summary of a run and its verdict for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from analogrig.judging.advice import advice
from analogrig.judging.response import StepResponse, step_responses
from analogrig.judging.verdict import (
    ESTIMATES,
    ChangeVerdict,
    ChannelFault,
    DiagnosisVerdict,
    MisfitPeriod,
    SegmentEstimate,
    Verdict,
    missing_text,
)
from analogrig.program import Program
from analogrig.reporting import measured
from analogrig.run import Run
from analogrig.wording import counter_text, number_of

SHOWN_ALARMS = 10


def summary(run: Run, verdict: Verdict) -> str:
    """Summary of a run and its verdict: several lines, without a final newline."""
    conditions = run.conditions
    head = (
        f"{conditions.played.name} on {conditions.source.name}, device {conditions.device.name}"
        f" over {conditions.link}, seed {conditions.seed}: {verdict.outcome.upper()}"
    )
    lines = [head, *(f"  {reason}" for reason in verdict.reasons), ""]
    if verdict.changes:
        lines += ["  sample  change                                       latency  bound  (samples)"]
        lines += [line for change in verdict.changes for line in _change_lines(change, conditions.program)]
    diagnoses = [(change.sample, change.diagnosis) for change in verdict.changes if change.diagnosis]
    if diagnoses:
        width = max(len("several"), *(len(diagnosis.named) for _, diagnosis in diagnoses))
        lines += [
            "",
            f"  sample  {'named':{width}}  right  extent   error       delay  bound   onset error  (samples)",
            *(_diagnosis_line(*each, width) for each in diagnoses),
        ]
    raised = verdict.false_alarms if verdict.knows_truth else run.alarm_index.tolist()
    facts = {
        "false alarms" if verdict.knows_truth else "alarms": f"{_alarms(raised)} in {number_of(run.samples, 'sample')}",
        "false or not, depending on the instants of the changes": verdict.doubtful_alarms
        and f"alarms at {', '.join(map(str, verdict.doubtful_alarms[:SHOWN_ALARMS]))}",
        "faults of channels": verdict.channel_faults and channel_faults_text(verdict.channel_faults),
        "misfit": verdict.fit and misfit_text(verdict.fit),
        missing_text(run): verdict.missing_n and number_of(verdict.missing_n, "sample"),
        "overload lamps": verdict.overloads and lamps_text(verdict.overloads),
        "on the line": traffic_text(conditions.link_counters),
    }
    lines += ["", *(f"  {name}: {text}" for name, text in facts.items() if text)]
    if not verdict.knows_truth:
        lines += ["", *measured.lines(run)]
    elif ESTIMATES not in verdict.not_judged:
        units = {name: f"{name} [{conditions.program.unit(name)}]" for name in conditions.program.estimates}
        columns = "  ".join(f"{unit:>12}  {f'true {name}':9}" for name, unit in units.items()).rstrip()
        lines += ["", f"  {'samples':12}{columns}"]
        lines += [_segment_line(segment) for segment in verdict.estimates]
    if verdict.knows_truth and not conditions.program.estimates and (found := step_responses(run)):
        lines += ["", "  samples     step response of the estimate, against the circuit's"]
        lines += [f"  {_span(each.start, each.end)} {response_text(each)}" for each in found]
    digest = f"theta hash {verdict.theta_hash}" if verdict.theta_hash else f"alarm hash {verdict.alarm_hash}"
    lines += ["", *(f"  note: {sentence}" for sentence in advice(run, verdict)), f"  {digest}"]
    return "\n".join(lines)


def channel_faults_text(faults: Sequence[ChannelFault]) -> str:
    """Faults of the channels: ``output stuck at 433 (since 419)``."""
    shown = [f"{fault.name} at {fault.sample} (since {fault.onset})" for fault in faults[:SHOWN_ALARMS]]
    return ", ".join([*shown, *(["..."] if len(faults) > SHOWN_ALARMS else [])])


def misfit_text(fit: Sequence[MisfitPeriod]) -> str:
    """Periods of a misfit: ``hum at 50.1 Hz in samples 1872-4999``; ``none`` without one."""
    more = ", ..." if len(fit) > SHOWN_ALARMS else ""
    return ", ".join(period.text for period in fit[:SHOWN_ALARMS]) + more if fit else "none"


def traffic_text(link_counters: Mapping[str, int]) -> str:
    """Other traffic on the line: ``12 frames foreign, 1 error frame``."""
    return ", ".join(counter_text(n, name) for name, n in link_counters.items() if n)


def lamps_text(overloads: Mapping[str, int]) -> str:
    """Lit overload lamps in order of time: ``U1 from sample 51``; ``none`` without one."""
    in_order = sorted(overloads.items(), key=lambda lamp: (lamp[1], lamp[0]))
    return ", ".join(f"{amplifier} from sample {sample}" for amplifier, sample in in_order) or "none"


def _alarms(samples: Sequence[int]) -> str:
    if not samples:
        return "none"
    more = ", ..." if len(samples) > SHOWN_ALARMS else ""
    return f"{len(samples)} (at {', '.join(map(str, samples[:SHOWN_ALARMS]))}{more})"


def _change_lines(change: ChangeVerdict, program: Program) -> list[str]:
    bound = bound_text(change)
    out = [f"  {change.sample:6}  {change_text(change, program):43}  {change.latency_text:>7}  {bound:>5}"]
    low, high = change.between
    if low < high:
        out += [f"          between {low} and {high} (the likeliest instant is shown): {change.result}"]
    return out


def change_text(change: ChangeVerdict, program: Program) -> str:
    """Parameters before and after a change: ``K 24500 -> 18000 N/m``."""
    return ", ".join(
        f"{name} {old:g} -> {change.after[name]:g} {program.unit(name)}".rstrip() for name, old in change.before.items()
    )


def response_text(found: StepResponse) -> str:
    """Difference of a step response: ``0.25% of the static gain``."""
    return "unstable" if found.error is None else f"{found.error:.2%} of the static gain"


def bound_text(change: ChangeVerdict) -> str:
    """Information bound of a change: ``3``, ``none`` if it is not detectable, ``?`` if it is unknown."""
    return "?" if not change.is_bounded else "none" if change.bound_n is None else str(change.bound_n)


def _diagnosis_line(sample: int, diagnosis: DiagnosisVerdict, width: int) -> str:
    extent = "-" if diagnosis.extent is None else f"{diagnosis.extent:.3f}"
    error = "-" if diagnosis.extent_error is None else f"{diagnosis.extent_error:+.1%}"
    bound = "none" if diagnosis.bound_n is None else str(diagnosis.bound_n)
    right = "yes" if diagnosis.right else "NO"
    return (
        f"  {sample:6}  {diagnosis.named:{width}}  {right:>5}  {extent:>6}  {error:>6}"
        f"  {diagnosis.delay_n:10}  {bound:>5}  {diagnosis.onset_error_n:+12}"
    )


def _segment_line(segment: SegmentEstimate) -> str:
    cells = [
        f"{'-' if segment.estimate is None else format(segment.estimate[name], '.5g'):>12}  {segment.truth[name]:<9.5g}"
        for name in segment.truth
    ]
    return f"  {_span(segment.start, segment.end)} " + "  ".join(cells)


def _span(start: int, end: int) -> str:
    """Samples ``start`` <= k < ``end``, as wide as the head of their column."""
    return f"{f'{start:5}-{end - 1}':11}"
