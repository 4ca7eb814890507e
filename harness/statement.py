"""What a test asserts of plays, by its name and limits, so that the file of a counterexample can say it again.

A statement is either about one play (the findings of ``harness.played``), or an experiment: plays as it needs them,
from a scenario and a seed on (``harness.properties.experiments``). Both say what they found, and by what they judged:
what stands in a file is judged by the very function by which it failed.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Protocol

from harness import config
from harness.errors import ConfigurationError

if TYPE_CHECKING:
    from harness.bench import Bench
    from harness.dut import Dut
    from harness.played import Played
    from harness.rigs.rig import Rig
    from harness.run import Run
    from harness.scenario import Scenario

Arguments = ParamSpec("Arguments")

Limit = bool | int | float | str


@dataclass(frozen=True)
class Statement:
    """The ``[statement]`` table of a scenario: what a test asserted of it, and did not find."""

    name: str
    limits: Mapping[str, Limit] = field(default_factory=dict)
    """By which it judged."""
    tries: int = 1
    """Seeds, one after the other, with one of which it must hold; an experiment has its own."""
    test: str = ""
    """That asserted it; for people."""

    def __post_init__(self) -> None:
        if self.tries < 1:
            raise ValueError(f"tries must be at least 1, not {self.tries}")


@dataclass(frozen=True)
class Finding:
    """Whether something holds, and why or why not. Its truth is that of the statement."""

    holds: bool
    why: str
    statement: Statement | None = None
    """What holds, or not; None: no file could say it."""
    run: Run | None = field(default=None, compare=False)
    """The play that shows it."""

    def __bool__(self) -> bool:
        return self.holds

    def __repr__(self) -> str:
        return f"<{'yes' if self.holds else 'no'}: {self.why}>"


class Play(Protocol):
    """The fixture ``play``."""

    @property
    def bench(self) -> Bench: ...

    def __call__(
        self, scenario: str | Scenario, seed: int | None = None, *, allow_inconclusive: bool = False
    ) -> Played:
        """Play a scenario, by default with the seed that it has."""

    def on(self, rig: Rig, dut: Dut) -> Play:
        """The same for another rig or device."""

    def note(self, finding: Finding, seed: int) -> None:
        """What was found of the plays from a seed on; the last that was noted is why a test fails, if it does."""


@dataclass(frozen=True)
class _Known:
    """A statement that a file can name."""

    judge: Callable[..., Finding]
    limits: type
    """A dataclass of them, by which those in a file are checked."""
    is_experiment: bool


_KNOWN: dict[str, _Known] = {}


def known() -> Mapping[str, _Known]:
    """By name."""
    import harness.played
    import harness.properties.experiments  # noqa: F401 - both make theirs known

    return _KNOWN


def said(judge: Callable[..., Finding], *arguments: Any, **limits: Any) -> Statement | None:
    """The statement of this call; None if no file can have its limits."""
    made_known = _KNOWN.get(judge.__name__)
    if made_known is None:
        return None
    bound = inspect.signature(judge).bind(*arguments, **limits)
    bound.apply_defaults()
    names = [each.name for each in dataclasses.fields(made_known.limits)]
    return Statement(
        judge.__name__, {name: bound.arguments[name] for name in names if bound.arguments[name] is not None}
    )


def make_known(judge: Callable[..., Finding], *, is_experiment: bool) -> None:
    """What comes after the play, or after play, scenario and seed, are its limits, if they are plain values."""
    hints = typing.get_type_hints(judge)
    parameters = list(inspect.signature(judge).parameters.values())[3 if is_experiment else 1 :]
    if any(not _is_plain(hints[each.name]) for each in parameters):
        return
    fields = [
        (each.name, hints[each.name])
        if each.default is inspect.Parameter.empty
        else (each.name, hints[each.name], field(default=each.default))
        for each in parameters
    ]
    limits = dataclasses.make_dataclass(judge.__name__, fields, frozen=True)
    _KNOWN[judge.__name__] = _Known(judge, limits, is_experiment)


def _is_plain(hint: Any) -> bool:
    return all(each in (bool, int, float, str, type(None)) for each in typing.get_args(hint) or (hint,))


def experiment(
    judge: Callable[Concatenate[Play, Scenario, int, Arguments], Finding],
) -> Callable[Concatenate[Play, Scenario, int, Arguments], Finding]:
    """A statement about as many plays of a scenario as it takes, from a seed on."""

    @functools.wraps(judge)
    def noted(
        play: Play, scenario: Scenario, seed: int, /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Finding:
        finding = judge(play, scenario, seed, *args, **kwargs)
        finding = dataclasses.replace(finding, statement=said(noted, play, scenario, seed, *args, **kwargs))
        play.note(finding, seed)
        return finding

    make_known(noted, is_experiment=True)
    return noted


def with_some_seed(
    play: Play, scenario: str | Scenario, seed: int, statement: Callable[[Played], Finding], tries: int
) -> Finding:
    """Whether a statement about a play holds with this seed, or the next, ...; if not, why it does not with this one.

    With a chance p of one play to fail a sound device, that of this to fail it is p to the power of ``tries``. A play
    that is INCONCLUSIVE is not left to chance: then it does not hold.
    """
    failed = []
    for number in range(tries):
        played = play(scenario, seed + number, allow_inconclusive=True)
        finding = statement(played)
        if finding or not played.verdict.valid:
            return finding
        failed.append(finding)
    statement_of_all = failed[0].statement and dataclasses.replace(failed[0].statement, tries=tries)
    why = failed[0].why if tries == 1 else f"{failed[0].why} (with seed {seed}; nor with the {tries - 1} after it)"
    finding = dataclasses.replace(failed[0], why=why, statement=statement_of_all)
    play.note(finding, seed)
    return finding


def judged(statement: Statement, play: Play, scenario: Scenario, seed: int, where: str) -> Finding:
    """Whether what stands in a file holds; ``where`` leads every error.

    :raises ConfigurationError: there is no such statement, or it has not such limits.
    """
    found = known().get(statement.name)
    if found is None:
        raise ConfigurationError(
            f"{where}: statement: name: there is none that is called {statement.name!r}: there are {', '.join(_KNOWN)}"
        )
    built: Any = config.build(found.limits, statement.limits, f"{where}: statement: limits")
    limits = {each.name: getattr(built, each.name) for each in dataclasses.fields(found.limits)}
    try:
        if found.is_experiment:
            return found.judge(play, scenario, seed, **limits)
        return with_some_seed(play, scenario, seed, lambda played: found.judge(played, **limits), statement.tries)
    except ValueError as error:
        raise ConfigurationError(f"{where}: statement: limits: {error}") from error
