"""Statements: assertions about plays, with names and limits, so that the file of a counterexample can repeat them.

A statement about one play is a method of ``analogrig.testing.one_play.Played``. An experiment makes as many plays of a
scenario as it takes. Both return a Finding. A statement in a file is judged by the function that found it violated.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Protocol

import numpy as np

from analogrig import config
from analogrig.errors import ConfigurationError, LimitError
from analogrig.scenario import MAX_TRIES, Scenario, Statement

if TYPE_CHECKING:
    from analogrig.bench import Bench
    from analogrig.devices.device import Device
    from analogrig.rigs.rig import Rig
    from analogrig.run import Run
    from analogrig.testing.one_play import Played

Arguments = ParamSpec("Arguments")

TRIES = 5
"""Number of consecutive seeds with which a statement subject to chance must fail before its test fails."""


@dataclass(frozen=True)
class Finding:
    """Result of a statement about plays: true or false in an ``if`` or ``assert``, and the reason in ``why``."""

    holds: bool
    why: str
    statement: Statement | None = None
    """Statement that was judged; None if no file can express it."""
    run: Run | None = field(default=None, compare=False)
    """Play that shows the finding."""

    def __bool__(self) -> bool:
        return self.holds

    def __repr__(self) -> str:
        return f"<{'yes' if self.holds else 'no'}: {self.why}>"


class Play(Protocol):
    """Callable of the fixture ``hil_play``: play a scenario on the rig and device of the session, return a Played."""

    @property
    def bench(self) -> Bench: ...

    def __call__(
        self, scenario: str | Scenario | None = None, seed: int | None = None, *, allow_inconclusive: bool = False
    ) -> Played:
        """Play a scenario, by default that of the recording and with its seed, or with the seed that it has."""

    def on(self, rig: Rig, dut: Device) -> Play:
        """Return the same fixture for another rig or device."""

    def note(self, finding: Finding, seed: int) -> None:
        """Note a finding about the plays from a seed on. The last finding noted is the reason why a test fails."""


class Inconclusive(Exception):  # noqa: N818 - an outcome, not an error
    """Ends an experiment that can decide nothing, such as with a play that is not valid."""

    def __init__(self, why: str, run: Run | None = None) -> None:
        super().__init__(why)
        self.finding = Finding(holds=False, why=f"INCONCLUSIVE: {why}", run=run)


@dataclass(frozen=True)
class Known:
    """Statement that a file can name."""

    judge: Callable[..., Finding]
    limits: type
    """Dataclass of the limits, which checks the limits in a file."""
    is_experiment: bool


KNOWN: dict[str, Known] = {}
"""Known statements, by name. A module registers its own when it is imported."""


def register(judge: Callable[..., Finding], *, is_experiment: bool) -> None:
    """Register a statement that a file can name, if its limits are plain values.

    The limits are the parameters after ``play``, or for an experiment after ``play``, ``scenario`` and ``seed``.
    """
    hints = typing.get_type_hints(judge)
    limits = list(inspect.signature(judge).parameters.values())[3 if is_experiment else 1 :]
    if not all(_is_plain(hints[each.name]) for each in limits):
        return
    defaults = (dataclasses.MISSING if each.default is each.empty else each.default for each in limits)
    fields = [
        (each.name, hints[each.name], field(default=default)) for each, default in zip(limits, defaults, strict=True)
    ]
    KNOWN[judge.__name__] = Known(judge, dataclasses.make_dataclass(judge.__name__, fields, frozen=True), is_experiment)


def _is_plain(hint: Any) -> bool:
    return all(each in (bool, int, float, str, type(None)) for each in typing.get_args(hint) or (hint,))


@functools.cache
def _plain_hints(judge: Callable[..., Any]) -> dict[str, Any]:
    """Types of the parameters that take plain values, by name."""
    hints = typing.get_type_hints(judge)
    return {name: hints[name] for name in inspect.signature(judge).parameters if _is_plain(hints.get(name))}


def check_limits(judge: Callable[..., Any], *arguments: Any, **limits: Any) -> inspect.BoundArguments:
    """Arguments of a call of ``judge`` with its limits as their types; no number may be negative.

    :raises LimitError: a limit is of another type, out of range or not finite.
    """
    bound = inspect.signature(judge).bind(*arguments, **limits)
    bound.apply_defaults()
    for name, hint in _plain_hints(judge).items():
        value = bound.arguments[name]
        if value is not None or type(None) not in typing.get_args(hint):
            bound.arguments[name] = _as_limit(hint, value, f"{judge.__name__}: {name}")
    return bound


def _as_limit(hint: Any, value: Any, where: str) -> Any:
    try:
        limit = config.convert(hint, value.item() if isinstance(value, np.generic) else value, where)
    except ConfigurationError as error:
        raise LimitError(str(error)) from None
    if isinstance(limit, int | float) and limit < 0:
        raise LimitError(f"{where}: must be 0 or more, not {limit:g}")
    return limit


def check_share(limit: float, where: str) -> None:
    """:raises LimitError: ``limit`` is not between 0 and 1."""
    if not 0.0 < limit < 1.0:
        raise LimitError(f"{where}: must be between 0 and 1, both excluded, not {limit:g}")


def statement_of(judge: Callable[..., Finding], *arguments: Any, **limits: Any) -> Statement | None:
    """Statement that a call of ``judge`` judges; None if no file can hold its limits."""
    known = KNOWN.get(judge.__name__)
    if known is None:
        return None
    bound = inspect.signature(judge).bind(*arguments, **limits)
    bound.apply_defaults()
    values = {each.name: bound.arguments[each.name] for each in dataclasses.fields(known.limits)}
    return Statement(judge.__name__, {name: value for name, value in values.items() if value is not None})


def experiment(
    judge: Callable[Concatenate[Play, Scenario, int, Arguments], Finding],
) -> Callable[Concatenate[Play, Scenario, int, Arguments], Finding]:
    """Declare a statement about as many plays of a scenario as it takes, from a seed on. It may raise Inconclusive."""

    @functools.wraps(judge)
    def judge_and_note(
        play: Play, scenario: Scenario, seed: int, /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Finding:
        call = check_limits(judge, play, scenario, seed, *args, **kwargs)
        try:
            finding = judge(*call.args, **call.kwargs)
        except Inconclusive as outcome:
            finding = outcome.finding
        statement = statement_of(judge_and_note, *call.args, **call.kwargs)
        finding = dataclasses.replace(finding, statement=statement)
        play.note(finding, seed)
        return finding

    register(judge_and_note, is_experiment=True)
    return judge_and_note


def with_some_seed(
    play: Play, scenario: str | Scenario, seed: int, judge: Callable[[Played], Finding], tries: int = TRIES
) -> Finding:
    """Finding: a statement holds for a play with ``seed``, or with one of the ``tries - 1`` seeds after it.

    If one play fails a sound device with probability p, this fails it with probability p ** ``tries``. A play that is
    INCONCLUSIVE ends the search; then the finding does not hold.

    :param play: the fixture ``hil_play``.
    :param scenario: a shipped name, a .toml file or a Scenario.
    :param judge: the statement, such as ``Played.stays_quiet``.
    :raises LimitError: ``tries`` is out of range.
    """
    if not 1 <= _as_limit(int, tries, "with_some_seed: tries") <= MAX_TRIES:
        raise LimitError(f"with_some_seed: tries: must be 1 to {MAX_TRIES}, not {tries}")
    failed: list[Finding] = []
    for number in range(tries):
        played = play(scenario, seed + number, allow_inconclusive=True)
        finding = judge(played)
        if finding or not played.verdict.valid:
            return finding
        failed.append(finding)
    first = failed[0]
    why = first.why if tries == 1 else f"{first.why} (with seed {seed}; nor with the {tries - 1} after it)"
    statement = first.statement and dataclasses.replace(first.statement, tries=tries)
    finding = dataclasses.replace(first, why=why, statement=statement)
    play.note(finding, seed)
    return finding


def judge_statement(statement: Statement, play: Play, scenario: Scenario, seed: int, where: str) -> Finding:
    """Judge the statement of a file again; ``where`` leads every error.

    :raises ConfigurationError: there is no such statement, or it has not such limits.
    """
    known = KNOWN.get(statement.name)
    if known is None:
        raise ConfigurationError(
            f"{where}: statement: name: there is none that is called {statement.name!r}: there are {', '.join(KNOWN)}"
        )
    built: Any = config.build(known.limits, statement.limits, f"{where}: statement: limits")
    limits = {each.name: getattr(built, each.name) for each in dataclasses.fields(known.limits)}
    try:
        if known.is_experiment:
            return known.judge(play, scenario, seed, **limits)
        return with_some_seed(play, scenario, seed, functools.partial(known.judge, **limits), statement.tries)
    except ValueError as error:
        raise ConfigurationError(f"{where}: statement: limits: {error}") from error
