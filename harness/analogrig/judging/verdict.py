"""The verdict on a Run, computed from the Run alone, so that a recording can be judged again.

An alarm belongs to the change in whose segment it falls; the first one there is its detection, every other alarm is a
false alarm, but for those while a change lasts. The device is late when the information that had accumulated by its
alarm was many times what is needed.

Where nobody knows the instant of a change, but between which instants it lies, the run is judged three times: as if all
changes had come at their earliest, their likeliest, their latest instants. What all three say holds: an alarm before
the earliest instant is a false one, and a device is late if it is late even for the latest. Where they differ the run
is INCONCLUSIVE, and so it is where a change cannot be found in the samples at all.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.catalogue import Change, SteppedFlag
from analogrig.judging import information
from analogrig.judging.exposure import Exposure, exposure
from analogrig.plant import PARAMETERS, physical_parameters
from analogrig.run import LOST, Run, Segment
from analogrig.scenario import MISSING, Expectations
from analogrig.wording import number_of

LARGEST_LEVEL = 700.0
"""exp() of more does not fit a float."""

Outcome = Literal["passed", "failed", "inconclusive"]

Result = Literal["noticed", "late", "missed", "unseeable", "undecided", "not judged"]
"""Of a change: unseeable carried too little information; undecided depends on its instant, which is not known so well;
not judged was not found in the samples."""


DIAGNOSABLE = {Change.MASS: "M", Change.DAMPING: "B", Change.STIFFNESS: "K", Change.SEVERAL: "several"}
"""What a device can say has changed."""


@dataclass(frozen=True)
class DiagnosisVerdict:
    """What the device said had changed, after the alarm that noticed the change."""

    named: str
    """``M``, ``B``, ``K`` or ``several``."""
    right: bool
    delay_n: int
    """Samples from the change until it was said."""
    bound_n: int | None
    """The isolation bound of this very change; None: it could not be told from others before the next or the end."""
    onset_error_n: int
    """Of the sample that was named, in samples."""
    extent: float | None
    """New over old, as it was said; None if several, or non-finite."""
    extent_error: float | None
    """Relative; None unless one parameter has changed and was named."""


@dataclass(frozen=True)
class TweakVerdict:
    """Verdict on one change of the plant. Latencies and bounds are in samples, from the change to the alarm."""

    sample: int
    what: str
    """Names of the parameters that changed, such as ``B, K``."""
    before: Mapping[str, float]
    after: Mapping[str, float]
    latency_n: int | None
    """None: no alarm before the next change or the end."""
    bound_n: int | None
    """The information bound of this very change; None: it could not be seen before the next change or the end."""
    deadline_n: int | None
    """A later alarm is late."""
    diagnosis: DiagnosisVerdict | None = None
    """None: the device did not say, for lack of certainty or because it does not isolate."""
    alternatives: tuple[TweakVerdict, ...] = ()
    """The same for the earliest and the latest instant at which it may have come; none if it is known."""
    unseen: str = ""
    """Why nobody knows whether and when it came; it is then not judged."""

    @property
    def possible(self) -> tuple[TweakVerdict, ...]:
        """For each instant that it is judged for, in order of time."""
        return tuple(sorted((self, *self.alternatives), key=lambda each: each.sample))

    @property
    def between(self) -> tuple[int, int]:
        """The earliest and the latest instant."""
        return self.possible[0].sample, self.possible[-1].sample

    @property
    def latencies_n(self) -> tuple[int, int] | None:
        """The least and the greatest that it may be; None: no alarm belongs to it."""
        known = [each.latency_n for each in self.possible if each.latency_n is not None]
        return (min(known), max(known)) if known else None

    @property
    def result(self) -> Result:
        """For every instant that it is judged for."""
        if self.unseen:
            return "not judged"
        results = {_result_at_instant(each) for each in self.possible}
        return results.pop() if len(results) == 1 else "undecided"

    @property
    def missed(self) -> bool:
        """It could be seen, and was not."""
        return self.latency_n is None and self.bound_n is not None

    @property
    def late(self) -> bool:
        return self.latency_n is not None and self.deadline_n is not None and self.latency_n > self.deadline_n


def _result_at_instant(tweak: TweakVerdict) -> Result:
    """For the very instant that it has."""
    if tweak.missed:
        return "missed"
    if tweak.late:
        return "late"
    return "unseeable" if tweak.latency_n is None else "noticed"


@dataclass(frozen=True)
class SegmentEstimate:
    """M, B, K at the end of a stretch in which the plant did not change, samples ``start`` <= k < ``end``."""

    start: int
    end: int
    truth: Mapping[str, float]
    estimate: Mapping[str, float] | None
    """None: the estimate describes no mass, damper and spring."""

    @property
    def error(self) -> Mapping[str, float]:
        """Relative errors, by name; empty without an estimate."""
        if self.estimate is None:
            return {}
        return {name: self.estimate[name] / truth - 1.0 for name, truth in self.truth.items()}


@dataclass(frozen=True)
class Verdict:
    """Verdict on a run: ``passed``, ``failed`` or ``inconclusive``, with the reasons and the figures behind it.

    Instants are sample indices. An inconclusive verdict is never a passed one.
    """

    outcome: Outcome
    reasons: tuple[str, ...]
    """Why it is not ``passed``; empty if it is."""
    tweaks: tuple[TweakVerdict, ...]
    false_alarms: tuple[int, ...]
    """Sample indices; of those that are so whenever the changes came."""
    estimates: tuple[SegmentEstimate, ...]
    arl0: float
    """The mean time between false alarms that the bounds assume."""
    ceiling: float | None
    """Of the trigger's statistic; None without a trigger."""
    missing_n: int
    theta_hash: str
    overloads: Mapping[str, int] = field(default_factory=dict)
    """Amplifier to the first sample that was taken with its overload lamp lit."""
    doubtful_alarms: tuple[int, ...] = ()
    """Sample indices of those that are false ones, or not, depending on when a change came."""

    @property
    def valid(self) -> bool:
        return self.outcome != "inconclusive"


def is_captured(run: Run) -> bool:
    """Whether it was read from a CAN log, whose gaps say nothing of what the device had."""
    return bool(run.conditions.dut.get("kind") == "log")


def missing_text(run: Run) -> str:
    """What the samples are that count as missing."""
    return "missing for the device or not in the log" if is_captured(run) else MISSING


def judge(run: Run) -> Verdict:
    """Verdict on ``run`` by the expectations of its scenario. The same run gives the same verdict.

    :raises ConfigurationError: the recorded scenario has an expectation that is wrong.
    """
    expect = config.build(Expectations, run.conditions.scenario.get("expect", {}), "the recorded scenario: expect")
    trigger = run.conditions.dut["estimator"]
    level = float(trigger["ceiling"]) if trigger["trigger"] == "cusum" else math.log(expect.arl0)
    judged = _evaluate_hypotheses(run, expect, level)
    invalid = _invalid_reasons(run, expect)
    outcome, reasons = _decide_outcome(judged, expect)
    certain = set(judged[0].false_alarms).intersection(*(each.false_alarms for each in judged))
    possible = {index for each in judged for index in each.false_alarms}
    return Verdict(
        outcome="inconclusive" if invalid else outcome,
        reasons=(*invalid, *reasons),
        tweaks=_merge_hypotheses(judged),
        false_alarms=tuple(sorted(certain)),
        doubtful_alarms=tuple(sorted(possible - certain)),
        estimates=_segment_estimates(run.with_change_instants(Segment.earliest)),
        arl0=math.exp(min(level, LARGEST_LEVEL)),
        ceiling=None if trigger["trigger"] == "none" else float(trigger["ceiling"]),
        missing_n=int(run.missing.sum()),
        theta_hash=run.theta_hash(),
        overloads=dict(run.conditions.overloads),
    )


def trajectory(run: Run, samples: Sequence[int] | slice = slice(None)) -> NDArray[np.float64]:
    """M, B, K after every sample, or those named: (n, 3), NaN where theta describes no mass, damper and spring."""
    channels = run.conditions.channels
    return physical_parameters(
        run.theta[samples],
        run.conditions.dut["estimator"],
        n_per_code=channels["force"].lsb,
        m_per_code=channels["displacement"].lsb,
        period_s=run.conditions.sample_period_problem_s,
    )


def as_json(verdict: Verdict) -> dict[str, Any]:
    """The verdict in plain JSON types; latencies and bounds in samples."""
    return {
        "outcome": verdict.outcome,
        "valid": verdict.valid,
        "reasons": list(verdict.reasons),
        "tweaks": [
            {
                "sample": tweak.sample,
                "what": tweak.what,
                "from": dict(tweak.before),
                "to": dict(tweak.after),
                "between": list(tweak.between),
                "result": tweak.result,
                "latency": tweak.latency_n,
                "latencies": None if tweak.latencies_n is None else list(tweak.latencies_n),
                "bound": tweak.bound_n,
                "deadline": tweak.deadline_n,
                "missed": tweak.result == "missed",
                "unseen": tweak.unseen,
                "diagnosis": None if tweak.diagnosis is None else dataclasses.asdict(tweak.diagnosis),
            }
            for tweak in verdict.tweaks
        ],
        "false_alarms": list(verdict.false_alarms),
        "doubtful_alarms": list(verdict.doubtful_alarms),
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
        "overloads": dict(verdict.overloads),
    }


@dataclass(frozen=True)
class _HypothesisResult:
    """Of a run whose changes came at these instants."""

    tweaks: tuple[TweakVerdict, ...]
    false_alarms: tuple[int, ...]
    failures: tuple[str, ...]


def _evaluate_hypotheses(run: Run, expect: Expectations, level: float) -> list[_HypothesisResult]:
    """At the likeliest instants; and at the earliest and the latest, where they are not exact."""
    runs = [run]
    if not all(segment.is_exact for segment in run.conditions.segments):
        runs += [run.with_change_instants(Segment.earliest), run.with_change_instants(Segment.latest)]
    out = []
    for supposed in runs:
        tweaks, false_alarms = _attribute_alarms(supposed, expect, level)
        out.append(_HypothesisResult(tweaks, false_alarms, tuple(_failure_reasons(tweaks, false_alarms, expect))))
    return out


def _decide_outcome(judged: Sequence[_HypothesisResult], expect: Expectations) -> tuple[Outcome, list[str]]:
    """Outcome of a valid run, and why it is not ``passed``."""
    tweaks = _merge_hypotheses(judged)
    unseen = [f"{tweak.what} at {tweak.sample} is not judged: {tweak.unseen}" for tweak in tweaks if tweak.unseen]
    if _fails_under_all_hypotheses(judged, expect):
        return "failed", [*judged[0].failures, *unseen]
    undecided = [_undecided_reason(tweak) for tweak in tweaks if tweak.result == "undecided"]
    counts = sorted(len(each.false_alarms) for each in judged)
    if counts[0] <= expect.false_alarms < counts[-1]:
        undecided.append(
            f"{counts[0]} or {number_of(counts[-1], 'false alarm')}, depending on when the changes came;"
            f" at most {expect.false_alarms} expected"
        )
    doubts = undecided if any(each.failures for each in judged) else []  # which then are some
    return ("inconclusive" if doubts or unseen else "passed"), [*doubts, *unseen]


def _fails_under_all_hypotheses(judged: Sequence[_HypothesisResult], expect: Expectations) -> bool:
    """Whether the same is wrong at every instant: one that is late for some and missed for others may be neither."""
    instants = list(zip(*(each.tweaks for each in judged), strict=True))
    missed = sum(all(tweak.missed and not tweak.unseen for tweak in each) for each in instants)
    late = any(all(tweak.late and not tweak.unseen for tweak in each) for each in instants)
    return late or missed > expect.missed or min(len(each.false_alarms) for each in judged) > expect.false_alarms


def _undecided_reason(tweak: TweakVerdict) -> str:
    """Why it is undecided."""
    low, high = tweak.between
    results = " or ".join(dict.fromkeys(_result_at_instant(each) for each in tweak.possible))
    return f"{tweak.what} between {low} and {high} was {results}, depending on when it came"


def _merge_hypotheses(judged: Sequence[_HypothesisResult]) -> tuple[TweakVerdict, ...]:
    """The changes at their likeliest instants, each with what is said of it at the others."""
    likeliest, *others = (each.tweaks for each in judged)
    return tuple(
        dataclasses.replace(tweak, alternatives=tuple(each[i] for each in others if each[i] != tweak))
        for i, tweak in enumerate(likeliest)
    )


def _attribute_alarms(run: Run, expect: Expectations, level: float) -> tuple[tuple[TweakVerdict, ...], tuple[int, ...]]:
    alarms = run.alarm_index.tolist()
    begun = {segment.start: segment for segment in run.conditions.segments}
    detected: set[int] = set()
    tweaks = []
    isolation_bounds = information.isolation_bounds(run) if len(run.diagnosis_index) else [None] * len(run.segments)
    for (_, _, before), (start, end, after), gathered, isolation_bound_n in zip(
        run.segments, run.segments[1:], information.change_information(run), isolation_bounds, strict=False
    ):
        if start in run.conditions.records:
            continue  # the device began afresh, and has seen no other plant before
        # The sample at which a pot jumps was taken before the jump could act: it still speaks for the old plant.
        mine = [index for index in alarms if start < index <= end]
        detection = mine[0] if mine else None
        detected |= _alarms_of_change(mine, start + begun[start].ramp_n)
        changed = before.changes_to(after)
        late = information.first_reaching(gathered, expect.late_information_ratio * level)
        tweaks.append(
            TweakVerdict(
                unseen=begun[start].unseen,
                sample=start,
                what=", ".join(changed),
                before={name: old for name, (old, _) in changed.items()},
                after={name: new for name, (_, new) in changed.items()},
                latency_n=None if detection is None else detection - start,
                bound_n=information.first_reaching(gathered, level),
                deadline_n=None if late is None else late + expect.late_slack_n,
                diagnosis=None
                if detection is None
                else _judge_diagnosis(run, start, (detection, end), changed, isolation_bound_n),
            )
        )
    return tuple(tweaks), tuple(sorted(set(alarms) - detected))


def _judge_diagnosis(
    run: Run, start: int, span: tuple[int, int], changed: Mapping[str, tuple[float, float]], bound_n: int | None
) -> DiagnosisVerdict | None:
    """The first that was said from the alarm to the end of the segment, both included in ``span``."""
    said = np.flatnonzero((run.diagnosis_index >= span[0]) & (run.diagnosis_index <= span[1]))
    if not len(said):
        return None
    first = said[0]
    named = DIAGNOSABLE[Change(run.diagnosis_change[first])]
    reported = float(run.diagnosis_extent[first])
    extent = reported if named in PARAMETERS and math.isfinite(reported) else None
    right = (named,) == tuple(changed) or (named == "several" and len(changed) > 1)
    error = extent * changed[named][0] / changed[named][1] - 1.0 if right and extent is not None else None
    return DiagnosisVerdict(
        named=named,
        right=right,
        delay_n=int(run.diagnosis_index[first]) - start,
        bound_n=bound_n,
        onset_error_n=int(run.diagnosis_onset[first]) - start,
        extent=extent,
        extent_error=error,
    )


def _alarms_of_change(alarms: Sequence[int], ramp_end: int) -> set[int]:
    """Of the alarms after a change those that are no false ones: all while it lasts, and the first when it is over.

    An alarm on a ramp makes the device learn a plant that goes on changing, which is to be noticed in its turn.
    """
    over = [index for index in alarms if index > ramp_end]
    return {index for index in alarms if index <= ramp_end} | set(over[:1])


def _invalid_reasons(run: Run, expect: Expectations) -> list[str]:
    reasons = list(run.conditions.faults)
    if run.samples < run.conditions.samples_asked:
        reasons.append(f"the run ended after {run.samples} of {number_of(run.conditions.samples_asked, 'sample')}")
    reasons += _loss_reasons(run)
    refused, missing = run.conditions.counters.get("refused", 0), int(run.missing.sum())
    return reasons + evidence_gaps(exposure(run), expect, refused=refused, missing=missing, words=missing_text(run))


def evidence_gaps(
    shown: Exposure, expect: Expectations, *, refused: int, missing: int, words: str = MISSING
) -> list[str]:
    """Why what a device made of its samples is no evidence, whatever else is known of the run; empty if it is.

    :param refused: so many it refused.
    :param missing: so many were missing; ``words`` say of what kind these are.
    """
    refusals = [f"the device refused {number_of(refused, 'sample')}"] if refused else []
    unarmed = [shown.lack_of_evidence] if shown.lack_of_evidence else []
    return [*refusals, *expect.gaps(shown.samples, missing, words), *unarmed]


def _loss_reasons(run: Run) -> list[str]:
    """Samples that never came to the device: more than its description allows, or not those that the harness knows."""
    most, lost = int(run.conditions.dut.get("most_lost_n", 0)), int(run.lost.sum())
    where = "not or only in part in the log" if is_captured(run) else "lost on the way to the device"
    reasons = [f"{number_of(lost, 'sample was', 'samples were')} {where}, more than {most}"] if lost > most else []
    after_n = int(np.argmin(run.lost[::-1])) if lost < run.samples else run.samples
    known = lost - after_n  # of those after the last one heard it cannot know
    missed = run.conditions.counters.get("samples_lost", known)
    if missed != known:
        reasons.append(f"the device never saw {number_of(missed, 'sample')}, where {known} are known to be lost")
    heard_of = int(((run.flags & (LOST | SteppedFlag.MISSING | SteppedFlag.REFUSED)) == 0).sum())
    taken_in = run.conditions.counters.get("updated", heard_of)
    if taken_in != heard_of:
        reasons.append(f"the device took in {number_of(taken_in, 'sample')}, where {heard_of} were heard of")
    return reasons


def _failure_reasons(
    tweaks: tuple[TweakVerdict, ...], false_alarms: tuple[int, ...], expect: Expectations
) -> list[str]:
    reasons = []
    judged = [tweak for tweak in tweaks if not tweak.unseen]
    missed = [tweak for tweak in judged if tweak.missed]
    if len(missed) > expect.missed:
        names = "; ".join(f"{tweak.what} at {tweak.sample}" for tweak in missed)
        of = number_of(len(judged), "change")
        reasons.append(f"missed {len(missed)} of {of} ({names}), at most {expect.missed} expected")
    reasons += [
        f"{tweak.what} at {tweak.sample} was noticed after {number_of(tweak.latency_n or 0, 'sample')},"
        f" later than {tweak.deadline_n} (bound {tweak.bound_n})"
        for tweak in judged
        if tweak.late
    ]
    if len(false_alarms) > expect.false_alarms:
        reasons.append(f"{number_of(len(false_alarms), 'false alarm')}, at most {expect.false_alarms} expected")
    return reasons


def _segment_estimates(run: Run) -> tuple[SegmentEstimate, ...]:
    unseen = {segment.start for segment in run.conditions.segments if segment.unseen}
    segments = [segment for segment in run.segments if segment[0] not in unseen]
    lasts = trajectory(run, [end - 1 for _, end, _ in segments])
    out = []
    for (start, end, plant), last in zip(segments, lasts, strict=True):
        estimate = None if np.isnan(last).any() else dict(zip(PARAMETERS, last.tolist(), strict=True))
        out.append(SegmentEstimate(start, end, plant.parameters(), estimate))
    return tuple(out)
