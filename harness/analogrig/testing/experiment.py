"""Experiments: statements about as many plays of a scenario as they take; and statements of a file, judged again.

The file of a counterexample names the statement, its limits, the scenario and the seed
(``analogrig.testing.statement``).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Protocol

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.scenario import Scenario, Statement
from analogrig.testing.statement import KNOWN, Finding, make_known, said

if TYPE_CHECKING:
    from analogrig.bench import Bench
    from analogrig.devices.dut import Dut
    from analogrig.rigs.rig import Rig
    from analogrig.testing.played import Played

Arguments = ParamSpec("Arguments")


class Play(Protocol):
    """Callable of the fixture ``hil_play``: play a scenario on the rig and device of the session, return a Played."""

    @property
    def bench(self) -> Bench: ...

    def __call__(
        self, scenario: str | Scenario, seed: int | None = None, *, allow_inconclusive: bool = False
    ) -> Played:
        """Play a scenario, by default with the seed that it has."""

    def on(self, rig: Rig, dut: Dut) -> Play:
        """Return the same fixture for another rig or device."""

    def note(self, finding: Finding, seed: int) -> None:
        """Note a finding about the plays from a seed on. The last finding noted is the reason why a test fails."""


def experiment(
    judge: Callable[Concatenate[Play, Scenario, int, Arguments], Finding],
) -> Callable[Concatenate[Play, Scenario, int, Arguments], Finding]:
    """Declare a statement about as many plays of a scenario as it takes, from a seed on."""

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
    """Finding: a statement about a play holds with this seed, or with one of the ``tries - 1`` seeds after it.

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
    """Judge the statement of a file again; ``where`` leads every error.

    :raises ConfigurationError: there is no such statement, or it has not such limits.
    """
    found = KNOWN.get(statement.name)
    if found is None:
        raise ConfigurationError(
            f"{where}: statement: name: there is none that is called {statement.name!r}: there are {', '.join(KNOWN)}"
        )
    built: Any = config.build(found.limits, statement.limits, f"{where}: statement: limits")
    limits = {each.name: getattr(built, each.name) for each in dataclasses.fields(found.limits)}
    try:
        if found.is_experiment:
            return found.judge(play, scenario, seed, **limits)
        return with_some_seed(play, scenario, seed, lambda played: found.judge(played, **limits), statement.tries)
    except ValueError as error:
        raise ConfigurationError(f"{where}: statement: limits: {error}") from error
