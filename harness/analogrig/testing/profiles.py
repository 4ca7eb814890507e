"""Test profiles: how many examples a property draws, and which profile a session uses.

The plugin names the profile of its session here, since hypothesis fixes the settings of a test where the test is
defined, before any fixture exists.
"""

from __future__ import annotations

import os
from collections.abc import Callable

EXAMPLES = {"ci": 15, "nightly": 300, "soak": 5000}
"""Examples per property, by profile."""

DEFAULT = "ci"
VARIABLE = "ANALOGRIG_HIL_PROFILE"

_sessions: list[Callable[[], str]] = []
"""One entry per running pytest session: a session may run another one in its process."""


def begin_session(profile: Callable[[], str]) -> None:
    """Make ``profile()`` the source of the profile until ``end_session(profile)``."""
    _sessions.append(profile)


def end_session(profile: Callable[[], str]) -> None:
    """Undo ``begin_session``; no effect if the session never began."""
    if profile in _sessions:
        _sessions.remove(profile)


def current() -> str:
    """Name of the profile in force: that of the pytest session, else of the environment, else the default."""
    if _sessions:
        return _sessions[-1]()
    return os.environ.get(VARIABLE) or DEFAULT
