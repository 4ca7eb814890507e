"""Statements: assertions about plays, by name and limits, so that the file of a counterexample can repeat them.

A statement is either about one play (the findings of ``analogrig.testing.played``), or an experiment
(``analogrig.testing.experiment``).
Both say what they found, and by what they judged: what stands in a file is judged by the very function by
which it failed.
"""

from __future__ import annotations

import dataclasses
import inspect
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from analogrig.scenario import Statement

if TYPE_CHECKING:
    from analogrig.run import Run


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


@dataclass(frozen=True)
class Known:
    """Statement that a file can name."""

    judge: Callable[..., Finding]
    limits: type
    """Dataclass of the limits, which checks the limits in a file."""
    is_experiment: bool


KNOWN: dict[str, Known] = {}
"""Known statements, by name. A module registers its own when it is imported."""


def said(judge: Callable[..., Finding], *arguments: Any, **limits: Any) -> Statement | None:
    """Statement of this call; None if no file can hold its limits."""
    made_known = KNOWN.get(judge.__name__)
    if made_known is None:
        return None
    bound = inspect.signature(judge).bind(*arguments, **limits)
    bound.apply_defaults()
    names = [each.name for each in dataclasses.fields(made_known.limits)]
    return Statement(
        judge.__name__, {name: bound.arguments[name] for name in names if bound.arguments[name] is not None}
    )


def make_known(judge: Callable[..., Finding], *, is_experiment: bool) -> None:
    """Register a statement that a file can name, if its limits are plain values.

    The limits are the parameters after ``play``, or for an experiment after ``play``, ``scenario`` and ``seed``.
    """
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
    KNOWN[judge.__name__] = Known(judge, limits, is_experiment)


def _is_plain(hint: Any) -> bool:
    return all(each in (bool, int, float, str, type(None)) for each in typing.get_args(hint) or (hint,))
