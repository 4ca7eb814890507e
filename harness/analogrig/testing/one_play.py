"""Statements about one play, for use in tests.

``played.detects(within=1.5)`` and its like give a Finding: true or false, and a sentence that pytest shows when an
assertion about it fails.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Concatenate

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analogrig.errors import LimitError
from analogrig.judging.advice import misfits
from analogrig.judging.betting import BettingSequence
from analogrig.judging.bursts import Design, bound_rate
from analogrig.judging.exposure import exposure
from analogrig.judging.response import step_responses
from analogrig.judging.verdict import DIAGNOSES, ESTIMATES, ChangeVerdict, Verdict, judge
from analogrig.reporting.run_summary import bound_text, response_text
from analogrig.run import Run
from analogrig.scenario import Statement
from analogrig.testing.statement import Arguments, Finding, check_limits, check_share, register, statement_of
from analogrig.wording import number_of


def _statement(
    judge: Callable[Concatenate[Played, Arguments], Finding],
) -> Callable[Concatenate[Played, Arguments], Finding]:
    """Declare a statement about a play. It does not hold for a play that is not valid."""

    @functools.wraps(judge)
    def judge_and_note(played: Played, /, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Finding:
        call = check_limits(judge, played, *args, **kwargs)
        if played.verdict.valid:
            finding = judge(*call.args, **call.kwargs)
            if not finding:
                finding = dataclasses.replace(finding, why="; ".join([finding.why, *misfits(played.verdict)]))
        else:
            finding = Finding(holds=False, why=f"{played.verdict.outcome.upper()}: {played.verdict.reasons[0]}")
        statement = statement_of(judge_and_note, *call.args, **call.kwargs)
        finding = dataclasses.replace(finding, statement=statement, run=played.run)
        played.note(finding)
        return finding

    register(judge_and_note, is_experiment=False)
    return judge_and_note


@dataclass(frozen=True, repr=False)
class Played:
    """One play of a scenario, its verdict, and statements about it, each of which returns a Finding.

    No statement holds for a play that is INCONCLUSIVE or UNJUDGED. ``hil_play`` fails the test instead of returning
    such a play, unless called with ``allow_inconclusive=True``. LimitError: a limit of a statement is
    no number, not finite or negative.
    """

    run: Run
    repeat: str = ""
    """Command that repeats the play; empty if no names or files describe what was played."""
    note: Callable[[Finding], None] = field(default=lambda _: None, compare=False)
    """Callback that receives every finding about the play."""

    def __repr__(self) -> str:
        conditions = self.run.conditions
        words = f"{conditions.played.name}, seed {conditions.seed}"
        return f"<{words}: {self.run.samples} samples on {conditions.source.name}, device {conditions.device.name}>"

    def __bool__(self) -> bool:
        raise TypeError("a play is neither true nor false: assert a finding, such as hil_play(...).passes()")

    @functools.cached_property
    def verdict(self) -> Verdict:
        return judge(self.run)

    @_statement
    def passes(self) -> Finding:
        """Finding: the scenario's ``[expect]`` is met: no change missed or late, no false alarm."""
        return Finding(self.verdict.outcome == "passed", "; ".join(self.verdict.reasons) or "all that is expected")

    @_statement
    def detects(self, within: float | None = None) -> Finding:
        """Finding: every detectable change raised an alarm before the next change.

        :param within: and not later than ``within`` times its information bound, rounded, plus one sample (for the
            sample of the bound itself); None: not later than the scenario's ``[expect]`` allows.
        """
        if not self.verdict.changes:
            return Finding(holds=False, why="nothing has changed, so nothing could be detected")
        seeable = [
            change
            for change in self.verdict.changes
            if (change.bound_n is not None or not change.is_bounded) and not change.unseen
        ]
        if not seeable:
            return Finding(holds=False, why="no change could be seen: none carried enough information before the next")
        wrong = [why for change in seeable if (why := _detection_failure(change, within))]
        latencies = ", ".join(
            f"{change.what} after {change.latency_text} (bound {bound_text(change)})" for change in seeable
        )
        return Finding(not wrong, "; ".join(wrong) or latencies)

    @_statement
    def stays_quiet(self) -> Finding:
        """Finding: no alarm except one for each change, and none while the trigger was not armed."""
        alarms, doubtful = self.verdict.false_alarms, self.verdict.doubtful_alarms
        if unarmed := self.verdict.unarmed_alarms:
            return Finding(holds=False, why=f"{number_of(len(unarmed), 'alarm')} while unarmed, first at {unarmed[0]}")
        if doubtful and not alarms:
            return Finding(holds=False, why=f"INCONCLUSIVE: the alarm at {doubtful[0]} is false, or not: {_UNKNOWN}")
        where = ", ".join(map(str, alarms[:5])) + (", ..." if len(alarms) > 5 else "")
        of = number_of(self.run.samples, "sample")
        return Finding(not alarms, f"{number_of(len(alarms), 'false alarm')} in {of}: {where}".rstrip(": "))

    @_statement
    def isolates(self) -> Finding:
        """Finding: every parameter diagnosed as changed has changed. A missing diagnosis is allowed."""
        if DIAGNOSES in self.verdict.not_judged:
            return Finding(holds=False, why="not judged: no diagnoses of the program's parameters")
        judged = [change for change in self.verdict.changes if not change.unseen]
        said = [(change, change.diagnosis) for change in judged if change.diagnosis is not None]
        wrong = [f"{change.what} at {change.sample} was called {diagnosis.named}" for change, diagnosis in said
                 if not diagnosis.right]  # fmt: skip
        return Finding(
            not wrong, "; ".join(wrong) or f"{len(said)} of {len(self.verdict.changes)} changes named, rightly"
        )

    @_statement
    def estimates(self, within: float) -> Finding:
        """Finding: estimates at the end of every stretch have a relative error of at most ``within``."""
        if ESTIMATES in self.verdict.not_judged:
            return Finding(holds=False, why="not judged: no estimates of the program's parameters")
        off = []
        for segment in self.verdict.estimates:
            if segment.estimate is None:
                off.append(f"samples {segment.start} to {segment.end}: no plant of the program")
            off += [
                f"{name} is off by {error:+.2%} at sample {segment.end}"
                for name, error in segment.error.items()
                if not abs(error) <= within
            ]
        return Finding(not off, "; ".join(off) or f"{len(self.verdict.estimates)} stretches within {within:.2%}")

    @_statement
    def responds(self, within: float) -> Finding:
        """Finding: the step response of the estimate at the end of every stretch is that of the circuit.

        :param within: largest difference, in parts of the circuit's static gain.
        """
        found = step_responses(self.run)
        if not found:
            return Finding(
                holds=False,
                why="not judged: the program is not linear, its input reaches its output at once, or the device reports"
                " no model",
            )
        off = [
            f"{response_text(each)} at sample {each.end}"
            for each in found
            if each.error is None or not each.error <= within
        ]
        return Finding(
            not off, "; ".join(off) or f"{number_of(len(found), 'stretch', 'stretches')} within {within:.2%}"
        )

    @_statement
    def follows(self, reference: ArrayLike, tolerance: ArrayLike, time_tolerance: int = 0) -> Finding:
        """Finding: the estimate stays in a tube around a reference estimate.

        :param reference: (n, p) what theta should be after each sample; NaN: any.
        :param tolerance: how far it may be off; of a shape that broadcasts to (n, p).
        :param time_tolerance: so many samples earlier or later it may have been so.
        """
        theta = self.run.theta.astype(np.float64)
        wanted, allowed = _numbers(reference, "reference"), _numbers(tolerance, "tolerance")
        if wanted.shape != theta.shape:
            raise LimitError(f"follows: reference has the shape {wanted.shape}, theta {theta.shape}")
        if not (allowed >= 0.0).all():
            raise LimitError("follows: tolerance: must be 0 or more everywhere, and not nan")
        try:
            allowed = np.broadcast_to(allowed, theta.shape)
        except ValueError:
            raise LimitError(f"follows: tolerance has the shape {allowed.shape}, theta {theta.shape}") from None
        inside = np.zeros(theta.shape, dtype=bool)
        for shift in range(-min(time_tolerance, len(theta)), min(time_tolerance, len(theta)) + 1):
            at = np.clip(np.arange(len(theta)) + shift, 0, len(theta) - 1)
            inside |= (np.abs(theta - wanted[at]) <= allowed[at]) | np.isnan(wanted[at])
        outside = np.argwhere(~inside)
        if not len(outside):
            return Finding(holds=True, why=f"{len(theta)} samples within the tolerance")
        sample, element = (int(i) for i in outside[0])
        why = f"theta[{element}] leaves the tube at sample {sample}: {theta[sample, element]:g}"
        return Finding(holds=False, why=f"{why}, not {wanted[sample, element]:g} +- {allowed[sample, element]:g}")


def _numbers(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """:raises LimitError: ``values`` are no array of numbers."""
    try:
        array = np.asarray(values)
        if array.dtype.kind in "iuf":
            return array.astype(np.float64)
    except ValueError:  # rows of different lengths
        pass
    raise LimitError(f"follows: {name}: must be an array of numbers, not {str(values)[:40]!r}")


_UNKNOWN = "it depends on when the change came, which is not known better"


def _detection_failure(change: ChangeVerdict, within: float | None) -> str:
    """Reason why a detectable change was not detected in time under any hypothesis of its instant; empty if it was."""
    reasons = [_failure_at_instant(each, within) for each in change.hypotheses]
    if all(reasons):
        return _failure_at_instant(change, within)
    low, high = change.between
    return f"INCONCLUSIVE: {change.what} between {low} and {high}: {_UNKNOWN}" if any(reasons) else ""


def _failure_at_instant(change: ChangeVerdict, within: float | None) -> str:
    """Reason why a change at a known instant was missed or late; empty if it was detected in time."""
    if change.latency_n is None and not change.missed:
        return ""
    if change.latency_n is None:
        return f"{change.what} at {change.sample} was missed (bound {bound_text(change)})"
    if within is None or not change.is_bounded:
        late, allowed = change.late, f"{change.deadline_n}"
    else:
        bound_n = change.bound_n or 0
        limit_n = round(within * bound_n) + 1
        late, allowed = change.latency_n > limit_n, f"{limit_n} ({within:g} x bound {bound_n} + 1)"
    latency = number_of(change.latency_n or 0, "sample")
    return f"{change.what} at {change.sample}: {latency}, allowed {allowed}" if late else ""


def rate_below(
    rate: float, played: Iterable[Played], *, confidence: float, burst: float | None = None, or_misfit: bool = False
) -> Finding:
    """Finding: with ``confidence`` (0 to 1) the false-alarm rate is below ``rate`` alarms per sample.

    The finding does not hold if one of the plays is not valid. A play counts once, with the samples in which its
    trigger was armed (``analogrig.judging.exposure``). By default the bound holds whatever the dependence within a play
    (``analogrig.judging.betting``), and plays may be added until it holds.

    :param burst: assume bursts of so many alarms on average, 1: independent alarms. This takes fewer samples. The
        number of plays must then be fixed beforehand.
    :param or_misfit: leave out the plays in which the device reports a misfit; the finding names the causes.
    :raises LimitError: ``rate``, ``confidence`` or ``burst`` is out of range.
    """
    check_limits(rate_below, rate, played, confidence=confidence, burst=burst, or_misfit=or_misfit)
    check_share(rate, "rate_below: rate")
    check_share(confidence, "rate_below: confidence")
    if burst is not None and burst < 1.0:
        raise LimitError(f"rate_below: burst: must be 1 or more, not {burst:g}")
    distinct = {
        (each.run.conditions.dut["name"], hashlib.sha256(each.run.codes.tobytes()).digest()): each for each in played
    }
    plays = list(distinct.values())
    explained = [each for each in plays if or_misfit and each.verdict.fit]
    finding = _rate_below(rate, [each for each in plays if each not in explained], confidence, burst)
    if explained:
        finding = _with_misfits(finding, explained, len(plays))
    if plays:
        statement = _of_all(plays, rate, confidence, burst, or_misfit=or_misfit)
        finding = dataclasses.replace(finding, statement=statement, run=plays[0].run)
        plays[0].note(finding)
    return finding


def _with_misfits(finding: Finding, explained: Sequence[Played], plays_n: int) -> Finding:
    """Finding about the plays without a misfit, which may be none, with the causes of the others."""
    periods = {period.cause: period for each in explained for period in each.verdict.fit or ()}
    why = f"misfit in {len(explained)} of {number_of(plays_n, 'play')}: "
    why += "; ".join(f"{period.text}: {period.cure}" for period in periods.values())
    if len(explained) == plays_n:
        return Finding(holds=True, why=why)
    return dataclasses.replace(finding, why=f"{finding.why}; {why}")


def _rate_below(rate: float, plays: Sequence[Played], confidence: float, burst: float | None) -> Finding:
    invalid = [each.verdict.reasons[0] for each in plays if not each.verdict.valid]
    if invalid:
        of = number_of(len(plays), "play")
        return Finding(holds=False, why=f"INCONCLUSIVE: {len(invalid)} of {of}, such as: {invalid[0]}")
    alarms = [len(each.verdict.false_alarms) for each in plays]
    shown = [exposure(each.run) for each in plays]
    armed = [each.armed for each in shown]
    if unarmed := next((each.contradiction for each in shown if each.contradiction), ""):
        return Finding(holds=False, why=unarmed)
    if not any(armed):
        why = shown[0].lack_of_evidence if plays else "there is none"
        return Finding(holds=False, why=f"no alarm could be raised in any of {number_of(len(plays), 'play')}: {why}")
    why = f"{number_of(sum(alarms), 'false alarm')} in {number_of(sum(armed), 'sample')}"
    if burst is None:
        bets = _bets(plays, alarms, armed, confidence)
        high, basis, needed = bets.bounds[1], bets.basis, bets.needed(rate)
        how = bets.broken or f"takes {needed:.0f} plays like these"
        cure = ", or the hold-off of the device in its data sheet, or an assumption, such as burst=5"
    else:
        bounds = bound_rate(alarms, armed, confidence, burst)
        high, basis, cure = bounds.high, bounds.basis, ""
        how = f"takes {number_of(Design(rate, confidence, sum(alarms), bounds.burst).trials, 'sample')}"
    why += f": the rate is below {high:.3g} per sample with {100.0 * confidence:g}% confidence, for {basis}"
    if sum(alarms) > rate * sum(armed):
        why += f"; {rate:g} was asked, which is less than observed"
    elif high > rate:
        why += f"; to show {rate:g} with so many alarms {how}{cure}"
    return Finding(high <= rate, why)


def _bets(plays: Sequence[Played], alarms: Sequence[int], armed: Sequence[int], confidence: float) -> BettingSequence:
    runs = [each.run for each in plays]
    most = max(sum(run.datasheet.most_alarms(end - start) for start, end in run.records) for run in runs)
    bets = BettingSequence(confidence, most, max(run.samples for run in runs))
    for events, exposure_n in zip(alarms, armed, strict=True):
        bets.add(events, exposure_n)
    return bets


def _of_all(
    plays: Sequence[Played], rate: float, confidence: float, burst: float | None, *, or_misfit: bool
) -> Statement | None:
    """Statement about all plays; None if a scenario and its first seed do not describe them all."""
    conditions = [each.run.conditions for each in plays]
    first = conditions[0]
    if any(
        each.seed != first.seed + number or each.scenario != first.scenario for number, each in enumerate(conditions)
    ):
        return None
    arguments = {"rate": rate, "confidence": confidence, "plays": len(plays)}
    arguments |= {} if burst is None else {"burst": burst}
    return Statement("rate_of_plays_below", arguments | ({"or_misfit": True} if or_misfit else {}))
