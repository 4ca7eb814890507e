"""The verdict on a Run, computed from the Run alone, so that a recording can be judged again.

An alarm is attributed to the change in whose segment it falls, unless the segment holds next to no information on the
change. The first alarm of a segment is the detection. Every other alarm is a false alarm, except alarms during a ramp.
A detection is late if the information I(n) accumulated until the alarm was many times the information needed.

If the instant of a change is known only as an interval, the run is judged under three hypotheses: all changes at their
earliest, their likeliest, and their latest instants. A finding holds if it holds under all three: an alarm before the
earliest instant is false, and a detection is late if it is late even for the latest instant. The run is INCONCLUSIVE
if the hypotheses disagree, or if a change cannot be found in the samples.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import Cause, Change, SteppedFlag
from analogrig.datasheet import Datasheet
from analogrig.judging import information
from analogrig.judging.courses import Model, first_at_level
from analogrig.judging.estimates import estimate_findings, parameters_of
from analogrig.judging.exposure import Exposure, exposure, latched_from, until_latched
from analogrig.plant import Segment
from analogrig.program import Program
from analogrig.run import IMPORTED, LOST, Run
from analogrig.scenario import MISSING, Expectations
from analogrig.wording import number_of

LARGEST_LEVEL = 700.0
"""Largest argument of exp() whose result is finite."""

_LEAST_INFORMATION = 0.5
"""Least information on a change in its segment, in nats, for an alarm there to be attributed to it."""

_NOT_PROCESSED = np.uint8(LOST | SteppedFlag.MISSING | SteppedFlag.REFUSED)

_MOST_CAUSES = 3
"""Causes of lost samples that a reason names; all are notes."""

Outcome = Literal["passed", "failed", "inconclusive", "unjudged"]
"""``unjudged``: nothing is known of the plant, so that no alarm can be true or false."""

UNKNOWN_PLANT = "nothing is known of the plant and its changes: import again with --scenario FILE to judge it"
"""Reason of an unjudged run."""

UNDETECTABLE = (
    "no change of the scenario is detectable in this recording: check scale, rate and clock of its import, and the"
    " scenario"
)
"""Reason that imported data permit no verdict."""

NOTHING_TO_DETECT = (
    "no change of the scenario is detectable before the next one or the end, so a device that never alarms would pass"
    " too: make a change larger or earlier, or raise the excitation"
)
"""Reason that a run without a finding permits no verdict."""

Result = Literal["detected", "late", "missed", "unseeable", "undecided", "not judged"]
"""Result of one change. ``unseeable``: too little information to be detected. ``undecided``: the result depends on the
instant, which is known only as an interval. ``not judged``: the change was not found in the samples."""

ESTIMATES, STATISTIC, DIAGNOSES = "estimates of parameters", "the trigger's statistic", "diagnoses"
"""Quantities in ``Verdict.not_judged`` that reports show elsewhere."""

BOUNDS = "delays"
"""Quantity in ``Verdict.not_judged`` where no bound is known: every change then counts as detectable."""

CHANNEL_FAULTS = frozenset(change for change in Change if change > Change.SEVERAL)
"""Changes that are faults of a channel. Diagnosed where a parameter has changed, they are wrong."""

GAINS = frozenset({Change.FORCE_GAIN, Change.DISPLACEMENT_GAIN})
"""Faults of a channel that have an extent."""

CURES: Mapping[str, str] = {
    "drift": "remove the mean of the output by a high-pass filter, or make the run shorter",
    "hum": "shield the sensor and its cable, or sample synchronously with the mains",
    "edges": 'set edge_instants = "anywhere", or take the excitation from the clock of the card if it has its own',
    "nonlinear": "reduce the amplitude of the excitation",
    "noise": "shield or filter the output, and use a sampling clock without jitter; without noise_estimated, set"
    " noise_variance as measured at rest",
    "slow plant": "lower the sample rate, or use a converter with more bits",
    "excitation": "raise the amplitude of the excitation",
}
"""Measure against each cause of a misfit."""

FAULT_CURES: Mapping[str, str] = {
    "offset": "measure its code at rest, and correct the zero of its input",
    "gain": "check its range, its reference voltage and its load",
    "delay": "check the order in which the channels are sampled, and whether a transfer lost a sample",
    "stuck": "check its cable and its input",
    "noise": "check its cable, its shield and its ground",
}
"""Measure against each fault of a channel."""

NONLINEAR_CURE = "the program is not linear, the device's model is: reduce the amplitude of the excitation"
"""Measure against a cause or a fault that a plant beyond the device's linear model explains."""

_UNEXPLAINED_CAUSES = frozenset({"slow plant", "excitation"})
_UNEXPLAINED_FAULTS = frozenset({"stuck"})


def diagnosis_text(change: Change, program: Program) -> str:
    """Diagnosis in the words of a program: a parameter, ``several``, or a channel and its fault: ``force offset``."""
    what = change.name.lower()
    channel, _, fault = what.partition("_")
    if fault:
        return f"{program.measured[channel == 'displacement']} {fault}"
    return program.diagnosed.get(what, "another parameter" if change < Change.SEVERAL else what)


@dataclass(frozen=True)
class ChannelFault:
    """Fault of a channel that the device diagnosed."""

    name: str
    """Channel and fault, such as ``force offset``."""
    sample: int
    """Sample after which it was diagnosed."""
    onset: int
    """Likeliest sample of its beginning."""
    extent: float | None
    """Gain after over gain before; None unless the fault is a gain, or non-finite."""
    beyond_model: bool = False
    """True if the program is not linear and the device's model is: no channel need be at fault."""

    @property
    def cure(self) -> str:
        """Measure against the fault."""
        channel, kind = self.name.rsplit(maxsplit=1)
        if self.beyond_model and kind not in _UNEXPLAINED_FAULTS:
            return NONLINEAR_CURE
        return f"{channel}: {FAULT_CURES[kind]}"


@dataclass(frozen=True)
class MisfitPeriod:
    """Samples ``start`` <= k < ``end`` in which the device reported one cause of a misfit."""

    cause: str
    """Cause of the catalogue, in lower case: ``hum``, ``slow plant``."""
    start: int
    end: int
    strength: float | None
    """Statistic over its limit at ``start``; None if the device does not report it."""
    frequency_hz: float | None
    """Frequency of the disturbance; None unless the cause is ``hum``, or if the device does not report it."""
    beyond_model: bool = False
    """True if the program is not linear and the device's model is: nothing need disturb the rig."""

    @property
    def text(self) -> str:
        """Cause and samples: ``hum at 50.1 Hz in samples 1872-4999``."""
        at = "" if self.frequency_hz is None else f" at {self.frequency_hz:.3g} Hz"
        return f"{self.cause}{at} in samples {self.start}-{self.end - 1}"

    @property
    def cure(self) -> str:
        """Measure against the cause."""
        is_explained = self.beyond_model and self.cause not in _UNEXPLAINED_CAUSES
        return NONLINEAR_CURE if is_explained else CURES[self.cause]


@dataclass(frozen=True)
class DiagnosisVerdict:
    """Verdict on the first diagnosis after the detection of a change."""

    named: str
    """As ``diagnosis_text``."""
    right: bool
    delay_n: int
    """Samples from the change to the diagnosis."""
    bound_n: int | None
    """Isolation bound of this change; None: it could not be isolated before the next change or the end."""
    onset_error_n: int
    """Diagnosed minus true sample of the change."""
    extent: float | None
    """Diagnosed ratio of the new to the old value; None unless a parameter was named, or non-finite."""
    extent_error: float | None
    """Relative error of ``extent``; None unless exactly one parameter changed and was named."""


@dataclass(frozen=True)
class ChangeVerdict:
    """Verdict on one change of the plant. Latencies and bounds are in samples after the change."""

    sample: int
    what: str
    """Names of the parameters that changed, such as ``B, K``."""
    before: Mapping[str, float]
    after: Mapping[str, float]
    latency_n: int | None
    """None: no alarm before the next change or the end."""
    bound_n: int | None
    """Information bound of this change; None: not detectable before the next change or the end."""
    deadline_n: int | None
    """Latest alarm that is not late; None: no alarm is late."""
    is_cut: bool = False
    """True if the run ends fewer than ``late_slack_n`` samples after the bound: a change without an alarm is not
    missed."""
    is_bounded: bool = True
    """False: the bound is unknown, and the change counts as detectable."""
    diagnosis: DiagnosisVerdict | None = None
    """None: the device reported no diagnosis."""
    alternatives: tuple[ChangeVerdict, ...] = ()
    """Verdicts for the earliest and the latest possible instant; empty if the instant is exact."""
    unseen: str = ""
    """Reason that the change was not found in the samples and is not judged; empty otherwise."""

    @property
    def hypotheses(self) -> tuple[ChangeVerdict, ...]:
        """Verdicts under all hypotheses, in order of time."""
        return tuple(sorted((self, *self.alternatives), key=lambda each: each.sample))

    @property
    def between(self) -> tuple[int, int]:
        """Earliest and latest possible sample of the change."""
        return self.hypotheses[0].sample, self.hypotheses[-1].sample

    @property
    def latencies_n(self) -> tuple[int, int] | None:
        """Smallest and largest possible latency; None: no alarm is attributed to the change."""
        known = [each.latency_n for each in self.hypotheses if each.latency_n is not None]
        return (min(known), max(known)) if known else None

    @property
    def latency_text(self) -> str:
        """Latency: ``4``, ``1-9`` if the instant is an interval, ``missed``, ``unknown``, or ``-``."""
        if self.result in {"missed", "not judged"}:
            return {"missed": "missed", "not judged": "unknown"}[self.result]
        if self.latencies_n is None:
            return "-"
        return "-".join(map(str, dict.fromkeys(self.latencies_n)))

    @property
    def result(self) -> Result:
        """Result under all hypotheses; ``undecided`` if they differ."""
        if self.unseen:
            return "not judged"
        results = {_result_at_instant(each) for each in self.hypotheses}
        return results.pop() if len(results) == 1 else "undecided"

    @property
    def missed(self) -> bool:
        """True if the change was detectable, raised no alarm, and the run left the time for one."""
        return self.latency_n is None and not self.is_cut and (self.bound_n is not None or not self.is_bounded)

    @property
    def late(self) -> bool:
        """True if the first alarm came after the deadline."""
        return self.latency_n is not None and self.deadline_n is not None and self.latency_n > self.deadline_n


def _result_at_instant(change: ChangeVerdict) -> Result:
    """Result of the change if ``change.sample`` is its true instant."""
    if change.missed:
        return "missed"
    if change.late:
        return "late"
    return "unseeable" if change.latency_n is None else "detected"


@dataclass(frozen=True)
class SegmentEstimate:
    """Last estimates of parameters in a segment of constant plant, samples ``start`` <= k < ``end``."""

    start: int
    end: int
    truth: Mapping[str, float]
    estimate: Mapping[str, float] | None
    """None: the estimate describes no plant of the program."""

    @property
    def error(self) -> Mapping[str, float]:
        """Relative errors by name; empty without an estimate."""
        if self.estimate is None:
            return {}
        return {name: self.estimate[name] / truth - 1.0 for name, truth in self.truth.items()}


@dataclass(frozen=True)
class Verdict:
    """Verdict on a run, with the reasons and the figures behind it. Instants are sample indices.

    An inconclusive verdict and an unjudged run never count as passed.
    """

    outcome: Outcome
    reasons: tuple[str, ...]
    """Reasons for any outcome but ``passed``; empty if passed."""
    changes: tuple[ChangeVerdict, ...]
    false_alarms: tuple[int, ...]
    """Sample indices of the alarms that are false under all hypotheses."""
    estimates: tuple[SegmentEstimate, ...]
    arl0: float
    """Mean time between false alarms assumed by the bounds, in samples."""
    ceiling: float | None
    """Alarm threshold of the trigger's statistic; None without a trigger, or if it is not known."""
    missing_n: int
    armed_n: int
    """Samples in which the trigger was armed."""
    after_warm_up_n: int
    """Samples after the warm-up; the trigger should have been armed in most of them."""
    theta_hash: str
    """``Run.theta_hash``; empty if the device reports no estimate."""
    alarm_hash: str = ""
    """``Run.alarm_hash``."""
    not_judged: tuple[str, ...] = ()
    """Quantities that the device does not report, as noun phrases: nothing is judged by them."""
    cannot_tell: tuple[str, ...] = ()
    """Faults that the device's protocol leaves unnoticed, as noun phrases."""
    overloads: Mapping[str, int] = field(default_factory=dict)
    """First sample with a lit overload lamp, by amplifier."""
    unarmed_alarms: tuple[int, ...] = ()
    """Sample indices of the alarms that came while the trigger was not armed, whatever they are attributed to."""
    doubtful_alarms: tuple[int, ...] = ()
    """Sample indices of the alarms that are false under some hypotheses only."""
    fit: tuple[MisfitPeriod, ...] | None = None
    """Periods of a misfit, in order; None if the device does not watch whether its model fits."""
    channel_faults: tuple[ChannelFault, ...] = ()
    """Faults of the channels that the device diagnosed, in order. No scenario contains one."""
    knows_truth: bool = True
    """False if nothing is known of the plant: the alarms are then neither detections nor false."""

    def __bool__(self) -> bool:
        raise TypeError('a verdict is neither true nor false: ask for verdict.outcome == "passed"')

    @property
    def valid(self) -> bool:
        """True if the run permits a verdict on the device."""
        return self.outcome not in {"inconclusive", "unjudged"}


def is_captured(run: Run) -> bool:
    """True if the run was read from a CAN log. Gaps in a log do not prove that the device lost samples."""
    return run.conditions.device.kind == "log"


def missing_text(run: Run) -> str:
    """Predicate for the missing samples of ``run``, for messages."""
    return "missing for the device or not in the log" if is_captured(run) else MISSING


def judge(run: Run) -> Verdict:
    """Verdict on ``run`` against the expectations of its scenario. Deterministic.

    :raises ConfigurationError: the recorded scenario has an invalid expectation.
    """
    model = information.model_of(run) if is_exact(run) else None
    return judge_with(run, run.conditions.played.expect, model, exposure(run), segment_estimates([run])[0])


def judge_with(
    run: Run, expect: Expectations, model: Model | None, shown: Exposure, estimates: tuple[SegmentEstimate, ...]
) -> Verdict:
    """Verdict on a run with this model of its plant, exposure and estimates.

    :param model: None if the instants of the changes are not exact, or if there is none.
    """
    run, sheet = until_latched(run), run.datasheet
    level = sheet.log_arl0(expect.arl0)
    results = _evaluate_hypotheses(run, model, expect, level)
    invalid = invalid_reasons(run, shown, expect)
    if run.conditions.source.kind == IMPORTED and _shows_no_change(results):
        invalid.append(UNDETECTABLE)
    outcome, reasons = _decide_outcome(results, expect)
    findings = [shown.contradiction] if shown.contradiction else []
    findings += estimate_findings(run, expect.estimate_error)
    if findings:
        outcome, reasons = "failed", [*findings, *reasons]
    if outcome == "passed" and not invalid:  # a device that never alarms must not pass as well
        reasons = [shown.shortfall(expect.least_exposure), NOTHING_TO_DETECT if _permits_silence(results) else ""]
        reasons = [reason for reason in reasons if reason]
        outcome = "inconclusive" if reasons else "passed"
    certain = set(results[0].false_alarms).intersection(*(each.false_alarms for each in results))
    possible = {index for each in results for index in each.false_alarms}
    knows_truth = bool(run.conditions.segments) or not run.samples
    if not knows_truth:
        outcome, reasons, certain, possible = "unjudged", [UNKNOWN_PLANT], set(), set()
    return Verdict(
        outcome="inconclusive" if invalid else outcome,
        reasons=(*invalid, *reasons),
        changes=_merge_hypotheses(results),
        false_alarms=tuple(sorted(certain)),
        doubtful_alarms=tuple(sorted(possible - certain)),
        estimates=estimates,
        arl0=math.exp(min(level, LARGEST_LEVEL)),
        ceiling=sheet.ceiling,
        missing_n=int(np.count_nonzero(run.missing)),
        armed_n=shown.armed,
        after_warm_up_n=shown.after_warm_up,
        unarmed_alarms=shown.unarmed_alarms,
        theta_hash=run.theta_hash(),
        alarm_hash=run.alarm_hash(),
        not_judged=not_judged(run),
        cannot_tell=sheet.cannot_tell,
        overloads=dict(run.conditions.overloads),
        fit=misfit_periods(run) if sheet.misfits else None,
        channel_faults=channel_faults(run),
        knows_truth=knows_truth,
    )


def is_beyond_model(run: Run) -> bool:
    """True if the device's model is linear and the plant is not."""
    return bool(run.conditions.segments) and run.datasheet.model is not None and not run.conditions.program.is_linear


def channel_faults(run: Run) -> tuple[ChannelFault, ...]:
    """Faults of the channels that the device diagnosed."""
    beyond_model = is_beyond_model(run) if len(run.diagnosis_index) else False
    reported = zip(run.diagnosis_change, run.diagnosis_index, run.diagnosis_onset, run.diagnosis_extent, strict=True)
    return tuple(
        ChannelFault(
            name=diagnosis_text(Change(change), run.conditions.program),
            sample=int(sample),
            onset=int(onset),
            extent=float(extent) if Change(change) in GAINS and math.isfinite(extent) else None,
            beyond_model=beyond_model,
        )
        for change, sample, onset, extent in reported
        if change in CHANNEL_FAULTS
    )


def misfit_periods(run: Run) -> tuple[MisfitPeriod, ...]:
    """Periods in which the device reported a misfit. Each ends with the next report, or with its record."""
    changes = [*run.misfit_index.tolist(), run.samples]
    beyond_model = is_beyond_model(run) if len(run.misfit_index) else False
    out = []
    for i, cause in enumerate(map(Cause, run.misfit_cause.tolist())):
        start = changes[i]
        record_end = min((record for record in run.conditions.records if record > start), default=run.samples)
        if cause != Cause.NONE:
            frequency = float(run.misfit_frequency[i])
            is_known = cause == Cause.HUM and frequency > 0.0
            out.append(
                MisfitPeriod(
                    cause=cause.name.lower().replace("_", " "),
                    start=start,
                    end=min(changes[i + 1], record_end),
                    strength=float(run.misfit_strength[i]) or None,
                    frequency_hz=frequency / run.conditions.sample_period_s if is_known else None,
                    beyond_model=beyond_model,
                )
            )
    return tuple(out)


def not_judged(run: Run) -> tuple[str, ...]:
    """Quantities that the device does not report, or that the program does not relate to its parameters."""
    program = run.conditions.program
    stated = {ESTIMATES: program.estimates, DIAGNOSES: program.diagnosed, BOUNDS: information.is_bounded(run)}
    unstated = (name for name, is_stated in stated.items() if not is_stated)
    return tuple(dict.fromkeys((*unreported(run.datasheet), *unstated)))


def unreported(sheet: Datasheet) -> tuple[str, ...]:
    """Quantities that the device does not report."""
    reported = {
        ESTIMATES: sheet.theta_n > 0 and sheet.model is not None,
        "innovations": sheet.innovation,
        STATISTIC: sheet.statistic,
        DIAGNOSES: sheet.diagnoses,
    }
    return tuple(name for name, is_reported in reported.items() if not is_reported)


def as_json(verdict: Verdict) -> dict[str, Any]:
    """Verdict in plain JSON types; latencies and bounds in samples."""
    return {
        "outcome": verdict.outcome,
        "valid": verdict.valid,
        "reasons": list(verdict.reasons),
        "changes": [
            {
                "sample": change.sample,
                "what": change.what,
                "from": dict(change.before),
                "to": dict(change.after),
                "between": list(change.between),
                "result": change.result,
                "latency": change.latency_n,
                "latencies": None if change.latencies_n is None else list(change.latencies_n),
                "bound": change.bound_n,
                "deadline": change.deadline_n,
                "missed": change.result == "missed",
                "unseen": change.unseen,
                "diagnosis": None if change.diagnosis is None else dataclasses.asdict(change.diagnosis),
            }
            for change in verdict.changes
        ],
        "false_alarms": list(verdict.false_alarms),
        "doubtful_alarms": list(verdict.doubtful_alarms),
        "unarmed_alarms": list(verdict.unarmed_alarms),
        "exposure": {"armed": verdict.armed_n, "after_warm_up": verdict.after_warm_up_n},
        "estimates": [
            {
                "start": segment.start,
                "end": segment.end,
                "truth": dict(segment.truth),
                "estimate": None if segment.estimate is None else dict(segment.estimate),
            }
            for segment in verdict.estimates
        ],
        "arl0": verdict.arl0,
        "missing": verdict.missing_n,
        "theta_hash": verdict.theta_hash,
        "alarm_hash": verdict.alarm_hash,
        "not_judged": list(verdict.not_judged),
        "cannot_tell": list(verdict.cannot_tell),
        "overloads": dict(verdict.overloads),
        "fit": None if verdict.fit is None else [_with_cure(period) for period in verdict.fit],
        "channel_faults": [_with_cure(fault) for fault in verdict.channel_faults],
    }


def _with_cure(found: MisfitPeriod | ChannelFault) -> dict[str, Any]:
    return dataclasses.asdict(found) | {"cure": found.cure}


@dataclass(frozen=True)
class _HypothesisResult:
    """Result of a run under one hypothesis about the instants of its changes."""

    changes: tuple[ChangeVerdict, ...]
    false_alarms: tuple[int, ...]
    failures: tuple[str, ...]


def _evaluate_hypotheses(run: Run, model: Model | None, expect: Expectations, level: float) -> list[_HypothesisResult]:
    """Results at the likeliest instants and, unless these are exact, at the earliest and the latest."""
    runs = [run]
    if not is_exact(run):
        runs += [run.with_change_instants(Segment.earliest), run.with_change_instants(Segment.latest)]
    out = []
    for supposed in runs:
        changes, false_alarms = _attribute_alarms(supposed, model, expect, level)
        out.append(_HypothesisResult(changes, false_alarms, tuple(_failure_reasons(changes, false_alarms, expect))))
    return out


def _decide_outcome(results: Sequence[_HypothesisResult], expect: Expectations) -> tuple[Outcome, list[str]]:
    """Outcome of a valid run, with the reasons unless it is ``passed``."""
    changes = _merge_hypotheses(results)
    unseen = [f"{change.what} at {change.sample} is not judged: {change.unseen}" for change in changes if change.unseen]
    if _fails_under_all_hypotheses(results, expect):
        return "failed", [*results[0].failures, *unseen]
    undecided = []
    for change in changes:
        if change.result == "undecided":
            possible = " or ".join(dict.fromkeys(_result_at_instant(each) for each in change.hypotheses))
            low, high = change.between
            undecided.append(f"{change.what} between {low} and {high} was {possible}, depending on its instant")
    counts = sorted(len(each.false_alarms) for each in results)
    if counts[0] <= expect.false_alarms < counts[-1]:
        undecided.append(
            f"{counts[0]} or {number_of(counts[-1], 'false alarm')}, depending on the instants of the changes;"
            f" at most {expect.false_alarms} expected"
        )
    doubts = undecided if any(each.failures for each in results) else []
    return ("inconclusive" if doubts or unseen else "passed"), [*doubts, *unseen]


def _shows_no_change(results: Sequence[_HypothesisResult]) -> bool:
    """True if there are changes, and the bounds are known and permit the detection of none."""
    changes = [change for each in results for change in each.changes]
    return bool(changes) and all(change.is_bounded and change.bound_n is None for change in changes)


def _permits_silence(results: Sequence[_HypothesisResult]) -> bool:
    """True if there are changes, none was detected, and no silence of the device would count as a miss."""
    changes = [change for each in results for change in each.changes]
    return bool(changes) and not any(
        change.missed or (change.bound_n is not None and change.latency_n is not None) or not change.is_bounded
        for change in changes
    )


def _fails_under_all_hypotheses(results: Sequence[_HypothesisResult], expect: Expectations) -> bool:
    """True if one expectation is violated under every hypothesis.

    A change that is late under one hypothesis and missed under another does not count: at the true instant it may be
    neither.
    """
    by_change = list(zip(*(each.changes for each in results), strict=True))
    missed = sum(all(change.missed and not change.unseen for change in each) for each in by_change)
    late = any(all(change.late and not change.unseen for change in each) for each in by_change)
    return late or missed > expect.missed or min(len(each.false_alarms) for each in results) > expect.false_alarms


def _merge_hypotheses(results: Sequence[_HypothesisResult]) -> tuple[ChangeVerdict, ...]:
    """Verdicts at the likeliest instants, each with the differing verdicts of the other hypotheses."""
    likeliest, *others = (each.changes for each in results)
    if not others:
        return likeliest
    return tuple(
        dataclasses.replace(change, alternatives=tuple(each[i] for each in others if each[i] != change))
        for i, change in enumerate(likeliest)
    )


def _attribute_alarms(
    run: Run, model: Model | None, expect: Expectations, level: float
) -> tuple[tuple[ChangeVerdict, ...], tuple[int, ...]]:
    """Verdict on each change, and the samples of the false alarms."""
    by_start = {segment.start: segment for segment in run.conditions.segments}
    changes = []
    diagnosed, is_bounded = run.conditions.program.diagnosed, information.is_bounded(run)
    isolates = len(run.diagnosis_index) and diagnosed
    model = model or information.model_of(run)
    isolation_bounds = information.isolation_bounds(run, model) if isolates else [None] * len(run.segments)
    informations = information.change_information(run, model)
    alarms = _alarms_by_change(run, informations)
    for (_, _, before), (start, end, after), gathered, in_segment, isolation_bound_n in zip(
        run.segments, run.segments[1:], informations, alarms, isolation_bounds, strict=False
    ):
        if start in run.conditions.records:
            continue  # a device that restarts has no earlier plant to compare with
        if any(record <= latched <= start < stop for (record, stop), latched in latched_from(run).items()):
            continue
        detection = in_segment[0] if in_segment else None
        changed = before.changes_to(after)
        late = first_at_level(gathered, expect.late_information_ratio * level)
        bound_n = first_at_level(gathered, level)
        changes.append(
            ChangeVerdict(
                unseen=by_start[start].unseen,
                sample=start,
                what=", ".join(changed),
                before={name: old for name, (old, _) in changed.items()},
                after={name: new for name, (_, new) in changed.items()},
                latency_n=None if detection is None else detection - start,
                bound_n=bound_n,
                is_cut=end == run.samples and bound_n is not None and start + bound_n + expect.late_slack_n > end,
                is_bounded=is_bounded,
                deadline_n=None if late is None else late + expect.late_slack_n,
                diagnosis=None
                if detection is None or not diagnosed
                else _judge_diagnosis(run, by_start[start], (detection, end), changed, isolation_bound_n),
            )
        )
    return tuple(changes), _unexplained(run, alarms)


def unexplained_alarms(run: Run) -> tuple[int, ...]:
    """Sample indices of the alarms that no change explains, at the likeliest instants of the changes.

    :raises ConfigurationError: the recorded rig or scenario does not describe a machine.
    """
    return _unexplained(run, _alarms_by_change(run, information.change_information(run)))


def _alarms_by_change(run: Run, informations: Iterable[NDArray[np.float64]]) -> list[list[int]]:
    """Alarms in the segment of each change; none where it gives too little information. No information is unknown."""
    alarms = []
    for (start, end, _), gathered in zip(run.segments[1:], informations, strict=True):
        may_alarm = not len(gathered) or gathered[-1] >= _LEAST_INFORMATION
        # The sample at which a pot jumps was taken before the jump could act: it still measures the old plant.
        alarms.append([index for index in run.alarm_index.tolist() if may_alarm and start < index <= end])
    return alarms


def _unexplained(run: Run, alarms: Iterable[list[int]]) -> tuple[int, ...]:
    """Alarms that no change explains, in order. ``alarms`` are those in the segment of each change.

    A change explains all alarms until the end of its ramp, and the first one after it. An alarm on a ramp restarts the
    device on a plant that keeps changing. It must detect that change again. A record begins without a change.
    """
    ramps_n = {segment.start: segment.ramp_n for segment in run.conditions.segments}
    unexplained = set(run.alarm_index.tolist())
    for (start, _, _), in_segment in zip(run.segments[1:], alarms, strict=True):
        if start not in run.conditions.records:
            ramp_end = start + ramps_n[start]
            unexplained.difference_update(index for index in in_segment if index <= ramp_end)
            unexplained.difference_update([index for index in in_segment if index > ramp_end][:1])
    return tuple(sorted(unexplained))


def _judge_diagnosis(
    run: Run, segment: Segment, span: tuple[int, int], changed: Mapping[str, tuple[float, float]], bound_n: int | None
) -> DiagnosisVerdict | None:
    """Verdict on the first diagnosis within ``span`` (detection to end of the segment, inclusive); None without one.

    "several" is right as well where the pots moved other parameters with the one that was to change.
    """
    reported = np.flatnonzero((run.diagnosis_index >= span[0]) & (run.diagnosis_index <= span[1]))
    if not len(reported):
        return None
    first = reported[0]
    named = diagnosis_text(Change(run.diagnosis_change[first]), run.conditions.program)
    ratio = float(run.diagnosis_extent[first])
    extent = ratio if named in run.conditions.program.parameters and math.isfinite(ratio) else None
    right = (named,) == tuple(changed) or (named == "several" and len({*changed, *segment.also}) > 1)
    error = extent * changed[named][0] / changed[named][1] - 1.0 if right and extent is not None else None
    return DiagnosisVerdict(
        named=named,
        right=right,
        delay_n=int(run.diagnosis_index[first]) - segment.start,
        bound_n=bound_n,
        onset_error_n=int(run.diagnosis_onset[first]) - segment.start,
        extent=extent,
        extent_error=error,
    )


def invalid_reasons(run: Run, shown: Exposure, expect: Expectations) -> list[str]:
    """Reasons that a run with the exposure ``shown`` permits no verdict; empty if it is valid."""
    reasons = list(run.conditions.faults)
    if run.samples < run.conditions.samples_asked:
        cause = "" if reasons else ": the rig, recording or log gave no more"
        asked = number_of(run.conditions.samples_asked, "sample")
        reasons.append(f"the run ended after {run.samples} of {asked}{cause}")
    reasons += _loss_reasons(run)
    refused = run.conditions.counters.get("refused", 0)
    reasons += [f"the device refused {number_of(refused, 'sample')}{refusal_cause(run)}"] if refused else []
    reasons += expect.excess_missing(run.samples, int(np.count_nonzero(run.missing)), missing_text(run))
    is_evidence = bool(run.conditions.segments) or shown.non_finite > 0  # alarms of an unknown plant prove nothing
    return reasons + ([shown.lack_of_evidence] if shown.lack_of_evidence and run.samples and is_evidence else [])


def refusal_cause(run: Run) -> str:
    """End of a sentence on samples that the device refused: the causes it counted, and the first of them."""
    counters, settings = run.conditions.counters, run.conditions.estimator
    limits = "" if settings is None else f"{settings.code_low:g} to {settings.code_high:g}"
    known = {
        f"with u or y saturated, at or beyond codes {limits}": counters.get("saturated", 0),
        f"with a stuck y (stuck_n = {settings.stuck_n if settings else 'unknown'})": counters.get("stuck", 0),
    }
    causes = [f"{n} {text}" for text, n in known.items() if n]
    at = np.flatnonzero((run.flags & (SteppedFlag.REFUSED | LOST)) == SteppedFlag.REFUSED)
    if len(at):
        u, y = run.codes[at[0], :2]
        causes.append(f"the first is sample {at[0]}, with the codes u = {u} and y = {y}")
    return f": {', '.join(causes)}" if causes else ""


def _loss_reasons(run: Run) -> list[str]:
    """Reasons for invalidity from lost samples: too many, or counts of device and harness that disagree."""
    is_lost, most = run.lost, run.conditions.device.most_lost_n
    lost = int(np.count_nonzero(is_lost))
    causes = run.conditions.losses[:_MOST_CAUSES]
    where = "lost" if causes else "lost on the way to the device"
    where = "not or only in part in the log" if is_captured(run) else where
    cause = f": {'; '.join(causes)}" if causes else ""
    text = f"{number_of(lost, 'sample was', 'samples were')} {where}, more than {most}{cause}"
    reasons = [text] if lost > most else []
    after_n = int(np.argmin(is_lost[::-1])) if lost < run.samples else run.samples
    known = lost - after_n  # the device cannot count samples lost after the last one it received
    missed = run.conditions.counters.get("samples_lost", known)
    if missed != known:
        reasons.append(f"the device counted {number_of(missed, 'lost sample')}, the harness {known}")
    answered = run.samples - int(np.count_nonzero(run.flags & _NOT_PROCESSED))
    updated = run.conditions.counters.get("updated", answered)
    if updated != answered:
        reasons.append(f"the device counted {number_of(updated, 'update')}, the harness received {answered}")
    return reasons


def _failure_reasons(
    changes: tuple[ChangeVerdict, ...], false_alarms: tuple[int, ...], expect: Expectations
) -> list[str]:
    """Violated expectations under one hypothesis; empty if there are none."""
    reasons = []
    judged = [change for change in changes if not change.unseen]
    missed = [change for change in judged if change.missed]
    if len(missed) > expect.missed:
        names = "; ".join(f"{change.what} at {change.sample}" for change in missed)
        of = number_of(len(judged), "change")
        reasons.append(f"missed {len(missed)} of {of} ({names}), at most {expect.missed} expected")
    reasons += [
        f"{change.what} at {change.sample} was detected after {number_of(change.latency_n or 0, 'sample')},"
        f" later than its deadline of {number_of(change.deadline_n or 0, 'sample')} (bound {change.bound_n}; [expect]"
        f" late_information_ratio = {expect.late_information_ratio:g}, late_slack_n = {expect.late_slack_n})"
        for change in judged
        if change.late
    ]
    if len(false_alarms) > expect.false_alarms:
        reasons.append(f"{number_of(len(false_alarms), 'false alarm')}, at most {expect.false_alarms} expected")
    return reasons


def segment_estimates(runs: Sequence[Run]) -> list[tuple[SegmentEstimate, ...]]:
    """Last estimate of each segment whose plant is known, for each run."""
    run = runs[0] if is_exact(runs[0]) else runs[0].with_change_instants(Segment.earliest)
    unseen = {segment.start for segment in run.conditions.segments if segment.unseen}
    names = run.conditions.program.estimates
    segments = [
        (start, end, {name: plant.parameters()[name] for name in names})
        for start, end, plant in run.segments
        if start not in unseen
    ]
    ends = [end - 1 for _, end, _ in segments]
    lasts = parameters_of(run, np.concatenate([each.theta[ends] for each in runs]))
    is_known = np.asarray(~np.isnan(lasts).any(axis=1))
    estimates = (
        dict(zip(names, last, strict=True)) if known and names else None
        for last, known in zip(lasts.tolist(), is_known, strict=True)
    )
    return [tuple(SegmentEstimate(*each, next(estimates)) for each in segments) for _ in runs]


def is_exact(run: Run) -> bool:
    """True if the instants of all changes are known."""
    return all(segment.is_exact for segment in run.conditions.segments)
