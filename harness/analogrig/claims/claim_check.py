"""Comparison of a device's answers with those of the bundled library, and the search for the cause of differences."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from analogrig.bench import Bench
from analogrig.catalogue import SteppedFlag
from analogrig.claims.answered import ULP, DeviceAnswers
from analogrig.claims.events import find_events
from analogrig.claims.feed import INNOVATION, Feed, Library, Matrix, library_of
from analogrig.claims.outputs import explain_outputs
from analogrig.claims.sample_faults import Suspect, code_hypotheses, input_hypotheses, unit_hypotheses
from analogrig.claims.wrong_settings import fitted, setting_hypotheses
from analogrig.devices.catalogue_device import has_our_estimator
from analogrig.devices.library import REPORTED, InprocDevice
from analogrig.devices.registry import recorded
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.estimator_config import EstimatorConfig
from analogrig.rigs.recording import RecordingRig
from analogrig.run import INPUT, LOST, OUTPUT, UNREPORTED, Channel, Run
from analogrig.scenario import Scenario

NO_CLAIM = (
    "the device file has no [estimator]: add the table with the configuration of est.c that the device runs"
    " (an empty one states the defaults)"
)

_PREFIX_N = 400
"""Samples after the first difference that decide whether a hypothesis is tried on the whole run."""

_FIRST_N = 1500
"""Samples with which a hypothesis is tried at first: most are wrong in these."""

_MOST_LEFT = 0.02
"""Largest part of the differences that a hypothesis may leave and still be named as the cause."""

_PAIRED = 2
"""Best hypotheses that are tried together with every other."""

_SHOWN = 8
"""Rows of the table of hypotheses."""

_JITTER, _JITTERS, _MARGIN, _WIDTH_N = 2.0**-23, 8, 8.0, 16
"""Relative change of the samples that stands for rounding, number of replays with it, margin over their spread, and
number of samples whose largest spread counts."""

_EXACT_N = 20
"""A device that agrees for so many equations computes the same bits. What differs later is no rounding."""

_OTHER_BUILD = "was est.c compiled with other EST_ macros? The bundled library has the usual ones"

_ROUNDING = "from sample {} on up to rounding: compiled with other options than -ffp-contract=off, or in double"

_EVENT_N = 50
"""A first difference after so many samples is rather that of one sample than of a number to be fitted."""

_NO_LINK = "none"
"""Link of a run without messages, which lacks what they alone carry."""

_REPORTS: Mapping[str, tuple[str, ...]] = {
    "alarm": ("kind", "statistic"),
    "diagnosis": ("change", "onset", "extent"),
    "misfit": ("cause", "frequency", "strength"),
}
"""Reports that the messages of our catalogue carry, with their values."""

_REPORT_ROUNDING = 0.02
"""Largest relative deviation of such a value by rounding."""

_REFRESH = SteppedFlag.RESTARTED | SteppedFlag.GATHERING
"""Flags after a refresh of the prefilter, of which rounding may decide when it comes."""

_SURE_COUNTERS = ("missing", "refused", "saturated", "stuck", "alarms")
"""Counters that do not depend on rounding."""


@dataclass(frozen=True)
class Tried:
    """A hypothesis that has been replayed."""

    cause: str
    agrees_n: int
    """Samples before the first difference."""
    unexplained: float
    """Part of the differences that it leaves."""


@dataclass(frozen=True)
class ClaimCheck:
    """Result of a comparison."""

    samples: int
    compared: tuple[str, ...]
    """Fields that the device reports."""
    first: int
    """First sample that differs; ``samples`` if none does."""
    fields: tuple[str, ...] = ()
    """Fields that differ there: name, value of the device, expected value."""
    cause: str = ""
    """Cause that reproduces the answers; empty if none does."""
    tried: tuple[Tried, ...] = ()
    """Best hypotheses first."""
    tried_n: int = 0
    note: str = ""

    @property
    def agrees(self) -> bool:
        return self.first == self.samples

    @property
    def summary(self) -> str:
        """One line."""
        if self.agrees:
            note = f" ({self.note})" if self.note else ""
            return f"{self.samples} samples as the bundled library answers: {', '.join(self.compared)}{note}"
        where = f"first differing sample {self.first}: {'; '.join(self.fields)}"
        if not self.tried_n or self.cause:
            return f"{where}; cause: {self.cause}" if self.cause else where
        near = [f"; nearest, up to sample {each.agrees_n}: {each.cause}" for each in self.tried[:1]
                if each.agrees_n > self.first]  # fmt: skip
        return f"{where}; cause: none of {self.tried_n} hypotheses{''.join(near)}; {_OTHER_BUILD}"

    def text(self) -> str:
        """Lines for people: the first difference, the cause, and the table of hypotheses."""
        lines = [self.summary.replace("; cause: ", "\ncause: ")]
        if self.tried:
            width = max(len(each.cause) for each in self.tried)
            lines += ["", f"{'hypothesis':{width}}  agrees until  explains"]
            for each in self.tried:
                explained = max(0.0, 1.0 - each.unexplained)
                lines.append(f"{each.cause:{width}}  {each.agrees_n:12}  {explained:7.0%}")
            lines.append(f"{self.tried_n} hypotheses tried")
        return "\n".join(lines)

    def as_table(self) -> dict[str, Any]:
        return {"agrees": self.agrees, **dataclasses.asdict(self), "summary": self.summary}


def claimed_estimator(run: Run) -> EstimatorConfig:
    """Configuration of est.c that the device of a run claims to run.

    :raises ConfigurationError: it claims none.
    """
    description = recorded(run.conditions.dut)
    config: EstimatorConfig | None = getattr(description, "estimator", None)
    if config is None:
        raise ConfigurationError(f"device {description.name}: {NO_CLAIM}")
    if getattr(description, "computes", "est") != "est":
        raise ConfigurationError(f"device {description.name}: computes an estimator of its own (computes = 'own')")
    scenario = Scenario.from_table(run.conditions.scenario, "the recorded scenario")
    conditions = run.conditions
    poles = scenario.program.poles(scenario.plant.values, conditions.sample_period_s * conditions.time_scale)
    try:
        return config.suited(poles)
    except ValueError as error:
        raise ConfigurationError(f"device {description.name}: [estimator]: {error}") from error


def compare_with_library(run: Run, before: Run | None = None, *, explain: bool = True) -> ClaimCheck:
    """Compare the answers in a run with those of the bundled library, and name the cause of differences.

    Of a device of our catalogue, flags, diagnoses, misfits and counters are compared too.

    :param before: run that the device played directly before, if it is known.
    :param explain: False: do not search for the cause, which takes seconds to minutes.
    :raises ConfigurationError: the device claims no such estimator, or reports other elements of theta.
    :raises RecordingError: the run holds no samples.
    """
    if not run.samples:
        raise RecordingError(f"no samples to compare: {next(iter(run.conditions.faults), 'none was answered')}")
    library, conditions = Library(claimed_estimator(run)), run.conditions
    description = recorded(conditions.dut)
    form = getattr(description, "form", None)
    answered = DeviceAnswers.of(run, library, () if form is None else form().theta)
    feed = Feed.of(run)
    claimed = library.replay(feed)
    compared = tuple(np.array(answered.columns)[answered.compared.any(axis=0)].tolist())
    if not compared:
        raise ConfigurationError(f"device {conditions.device.name}: reports nothing that can be compared")
    first, note = answered.first_difference(claimed), answered.coarse
    equations_n = np.count_nonzero(claimed[:first, answered.columns.index(INNOVATION)])
    is_rounded = first < run.samples and bool(equations_n < _EXACT_N)
    wide = answered.widened(_rounding(library, feed, claimed)) if is_rounded else answered
    if wide.first_difference(claimed) < run.samples:
        channels = {
            name: conditions.channels[conditions.program.channels[i]] for name, i in (("u", INPUT), ("y", OUTPUT))
        }
        past = None if before is None else Feed.of(before)
        for tolerant in (answered, wide) if is_rounded and explain else (answered,):
            search = _Search(tolerant, library, feed, claimed, past, channels)
            found = ClaimCheck(
                run.samples, compared, search.first, search.fields(), *(search.cause() if explain else ())
            )
            if found.cause:
                break
        return found
    if is_rounded:
        note = _ROUNDING.format(first)
    if has_our_estimator(description) and conditions.link != _NO_LINK:
        compared = tuple(dict.fromkeys((*compared, "flags", *_REPORTS, "counters")))
        if wrong := min(_other_reports(run, library.config, is_rounded=is_rounded), default=None):
            return ClaimCheck(run.samples, compared, wrong[0], (wrong[1],))
    return ClaimCheck(run.samples, compared, run.samples, note=note)


def _other_reports(run: Run, config: EstimatorConfig, *, is_rounded: bool) -> Iterator[tuple[int, str]]:
    """Samples and texts of differences of what only the messages of our catalogue carry.

    The expected messages are those of the bundled device in this process on the same samples, to which lost ones are
    missing.

    :param is_rounded: the device rounds otherwise: values may differ a little, a diagnosis or a refresh of the
        prefilter may come at another sample. Its alarms have been compared with the estimates.
    """
    clipped = run.clipped | run.lost[:, np.newaxis]
    rig = RecordingRig.of(dataclasses.replace(run, clipped=clipped), Path("claimed"))
    with InprocDevice(name="bundled", exchange="block", estimator=config).connect() as device:
        expected = Bench(rig, device).play(rig.scenario(), run.conditions.seed)
    is_reported = (run.flags & (LOST | UNREPORTED)) == 0
    compared = np.uint8(0xFF & ~_REFRESH if is_rounded else 0xFF)
    other = (((run.flags ^ expected.flags) & compared) != 0) & is_reported
    if other.any():
        at = int(np.argmax(other))
        yield at, f"flags is {run.flags[at]:#04x}, expected {expected.flags[at]:#04x}"
    for report, values in _REPORTS.items():
        if report == "alarm" and is_rounded:
            continue
        found, due = (
            list(zip(*(getattr(each, f"{report}_{name}").tolist() for name in ("index", *values)), strict=True))
            for each in (run, expected)
        )
        for pair in itertools.zip_longest(found, due):
            if not _are_near(*pair, is_rounded=is_rounded):
                texts = ["none" if each is None else f"({', '.join(f'{x:.6g}' for x in each)})" for each in pair]
                names = f"{report} ({', '.join(('sample', *values))})"
                yield min(each[0] for each in pair if each), f"{names} is {texts[0]}, expected {texts[1]}"
                break
    if not run.lost.any() and not run.conditions.faults:
        for name in _SURE_COUNTERS if is_rounded else REPORTED:
            counted, due_n = (each.conditions.counters.get(name, 0) for each in (run, expected))
            if counted != due_n:
                yield run.samples - 1, f"counter {name} is {counted}, expected {due_n}"


def _are_near(one: tuple[float, ...] | None, other: tuple[float, ...] | None, *, is_rounded: bool) -> bool:
    """True if all values are equal; of a device that rounds otherwise, reals nearly, and the sample does not count."""
    if one is None or other is None or not is_rounded:
        return one == other
    pairs = zip(one[1:], other[1:], strict=True)
    return all(a == b or (not float(a).is_integer() and math.isclose(a, b, rel_tol=_REPORT_ROUNDING)) for a, b in pairs)


def _rounding(library: Library, feed: Feed, claimed: Matrix) -> NDArray[np.float64]:
    """(n, c): largest deviation that rounding may cause, from replays whose samples differ by rounding."""
    random = np.random.default_rng(1)
    spread = np.broadcast_to(ULP * np.abs(claimed).max(axis=0), claimed.shape)
    for _ in range(_JITTERS):
        u, y = (x * (1.0 + _JITTER * random.uniform(-1.0, 1.0, len(x))) for x in (feed.u, feed.y))
        other = library.replay(feed.altered(u=u, y=y))
        spread = np.maximum(spread, np.abs(other.astype(np.float64) - claimed))
    return np.asarray(
        sliding_window_view(np.pad(spread, ((_WIDTH_N - 1, 0), (0, 0))), _WIDTH_N, axis=0).max(axis=2) * _MARGIN
    )


@dataclass
class _Search:
    """Search for the hypothesis that reproduces the answers."""

    answered: DeviceAnswers
    library: Library
    feed: Feed
    claimed: Matrix
    before: Feed | None
    channels: Mapping[str, Channel]
    tried: list[Tried] = field(default_factory=list)
    suspects: list[tuple[Suspect, Tried]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.first = self.answered.first_difference(self.claimed)

    def fields(self) -> tuple[str, ...]:
        """Fields that differ at the first sample that does."""
        found, expected = self.answered, self.claimed
        return tuple(
            f"{found.columns[i]} is {found.values[self.first, i]:.6g}, expected {expected[self.first, i]:.6g}"
            for i in np.flatnonzero(found.wrong(expected)[self.first]).tolist()
        )

    def cause(self) -> tuple[str, tuple[Tried, ...], int]:
        """Cause, best hypotheses, and number of those tried: one family after the other, until one reproduces the
        answers."""
        last: list[Callable[[], None]] = [
            self._events,
            lambda: self._each(fitted(self.answered, self.library, self.feed)),
        ]
        if self.first < _EVENT_N:
            last.reverse()
        alarms = np.flatnonzero(self.answered.values[:, -1])
        for family in (
            self._outputs,
            lambda: self._each(input_hypotheses(self.feed, self.before, alarms)),
            lambda: self._each(code_hypotheses()),
            lambda: self._each(unit_hypotheses(self.channels)),
            lambda: self._each(setting_hypotheses(self.library.config)),
            *last,
            self._pairs,
        ):
            family()
            ranked = sorted(self.tried, key=lambda each: (-each.agrees_n, each.unexplained))
            if named := self._named(ranked):
                break
        return named, tuple(ranked[:_SHOWN]), len(self.tried)

    def _named(self, ranked: Sequence[Tried]) -> str:
        """Cause of the hypothesis that reproduces the answers; empty if none does."""
        if ranked and ranked[0].agrees_n == len(self.claimed):
            return ranked[0].cause
        nearly = min(self.tried, key=lambda each: each.unexplained, default=None)
        is_near = nearly is not None and nearly.unexplained <= _MOST_LEFT
        return f"{nearly.cause} (nearly)" if nearly is not None and is_near else ""

    def _outputs(self) -> None:
        if outputs := explain_outputs(self.answered, self.claimed):
            self.tried.append(Tried(outputs, len(self.claimed), 0.0))

    def _events(self) -> None:
        edits, feed = find_events(self.answered, self.library, self.feed)
        kinds: dict[str, list[int]] = {}
        for edit in edits:
            kinds.setdefault(edit.kind, []).append(edit.at)
        if edits:
            text = "; ".join(f"{kind} at {_places(at)}" for kind, at in kinds.items())
            self._enter(text, self.library.replay(feed))

    def _each(self, family: Iterator[Suspect]) -> None:
        for suspect in family:
            self._try(suspect, self.first)

    def _pairs(self) -> None:
        """Try each of the best hypotheses together with every other."""
        helpful = [each for each in self.suspects if each[1].agrees_n > self.first]
        best = sorted(helpful, key=lambda each: (-each[1].agrees_n, each[1].unexplained))[:_PAIRED]
        others = [suspect for suspect, _ in self.suspects]
        for (suspect, tried), other in itertools.product(best, others):
            self._try(suspect.with_other(other), tried.agrees_n)
            if self.tried[-1].agrees_n == len(self.claimed):
                return

    def _try(self, suspect: Suspect, least_n: int) -> None:
        """Replay a hypothesis: the first samples, then up to shortly after the first difference, then all.

        :param least_n: samples that it must explain to be replayed on.
        """
        library = library_of(self.library.config, **suspect.settings) if suspect.settings else self.library
        if library is None:
            return
        for samples in (_FIRST_N, least_n + _PREFIX_N):
            n = min(len(self.claimed), samples)
            agrees_n = self.answered.upto(n).first_difference(self._answers(library, suspect, n))
            if agrees_n < n and agrees_n <= least_n:
                self.tried.append(Tried(suspect.cause, agrees_n, 1.0))
                break
        else:
            self._enter(suspect.cause, self._answers(library, suspect, len(self.claimed)))
        self.suspects.append((suspect, self.tried[-1]))

    def _answers(self, library: Library, suspect: Suspect, samples: int) -> Matrix:
        feed = suspect.alter(self.feed.upto(samples))
        answers = library.replay(feed)
        if library.columns == self.library.columns:
            if samples and feed.answer[0] < 0:
                answers[0] = self.answered.values[0]  # nothing is known of an answer before the first step
            return answers
        aligned = np.zeros((samples, len(self.library.columns)), np.float32)
        for i, name in enumerate(self.library.columns):
            if name in library.columns:
                aligned[:, i] = answers[:, library.columns.index(name)]
        return aligned

    def _enter(self, cause: str, answers: Matrix) -> None:
        agrees_n = self.answered.first_difference(answers)
        self.tried.append(Tried(cause, agrees_n, self.answered.unexplained(answers, self.claimed)))


def _places(at: Sequence[int]) -> str:
    steps = set(np.diff(at).tolist())
    if len(at) > 2 and len(steps) == 1:
        return f"sample {at[0]}, then each {steps.pop()}"
    wraps = [f" (2^{bits}: a counter wraps)" for bits in (16, 15, 8) if abs(at[0] - (1 << bits)) <= 1]
    return ("sample " if len(at) == 1 else "samples ") + ", ".join(map(str, at[:6])) + "".join(wraps[:1])
