"""Causes of unused frames and lost samples: how often each occurred, and where first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from analogrig.wording import number_of

__all__ = ["Causes"]
"""Names for packages beside the core."""

_MOST = 200
"""Causes that are kept; a hostile sender must not fill the memory."""


@dataclass
class _Cause:
    noun: str
    loses: bool
    place: str
    detail: str
    n: int = 0


class Causes:
    """Tally of causes in the order of their first occurrence.

    Each text names a cause without the values that vary: those of its first occurrence are its detail.
    """

    def __init__(self) -> None:
        self.place: Callable[[], str] = str
        """Function that returns the place of the current frame: ``frame 12 at 3.500000 s``, ``sample 12``."""
        self._found: dict[str, _Cause] = {}
        self._facts: dict[str, tuple[str, bool]] = {}

    def add(
        self, text: str, *, noun: str = "frame", place: str = "", detail: str = "", loses: bool = False, n: int = 1
    ) -> None:
        """Count occurrences of a cause; ``loses`` if frames or samples were lost by it."""
        if text not in self._found:
            if len(self._found) >= _MOST:
                return
            self._found[text] = _Cause(noun, loses, place or self.place(), detail)
        self._found[text].n += n

    def state(self, key: str, text: str, *, loses: bool) -> None:
        """Set the sentence of a finding on the whole traffic, which replaces an earlier one with this key."""
        self._facts[key] = text, loses

    @property
    def losses(self) -> tuple[str, ...]:
        """Sentences on causes that lost frames or samples; findings on the whole traffic come first."""
        return self._sentences(loses=True)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on the others."""
        return self._sentences(loses=False)

    def _sentences(self, *, loses: bool) -> tuple[str, ...]:
        facts = [text for text, it_loses in self._facts.values() if it_loses == loses]
        found = [_sentence(text, cause) for text, cause in self._found.items() if cause.loses == loses]
        return (*facts, *found)


def _sentence(text: str, cause: _Cause) -> str:
    detail = f": {cause.detail}" if cause.detail else ""
    if cause.n == 1:
        return f"{text} ({cause.place}{detail})"
    return f"{text} ({number_of(cause.n, cause.noun)} from {cause.place} on{detail})"
