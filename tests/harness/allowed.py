"""Rigs of a test's own files, with all that these name allowed."""

from __future__ import annotations

from analogrig.errors import ConfigurationError
from analogrig.rigs.description import describe, open_rig
from analogrig.rigs.rig import Rig


def named_by(rig: str) -> tuple[str, ...]:
    """Names of the things that the file of a rig names; none if it is wrong."""
    try:
        things = describe(rig).things
    except ConfigurationError:
        return ()
    return tuple(thing.name for thing in things)


def allowing(rig: str) -> list[str]:
    """The same as words of the command line."""
    return [word for name in named_by(rig) for word in ("--allow", name)]


def open_allowed(rig: str) -> Rig:
    """Rig as from ``open_rig``, with all that its file names allowed."""
    return open_rig(rig, allow=named_by(rig))
