"""Provenance of a session of pytest: for the recordings of its plays, and for JUnit."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from analogrig.identity import DeviceFile, Identity

_STARTED = pytest.StashKey[str]()

_PLAYED = "analogrig_commit"
"""Property that a test has once it has played."""


def begin(config: pytest.Config) -> None:
    """Note when the session has started, and have its test suite named in JUnit."""
    config.stash[_STARTED] = time.strftime("%Y-%m-%dT%H:%M:%S+00:00", time.gmtime())
    config.pluginmanager.register(_Suite())


def identity(config: pytest.Config, devices: Sequence[DeviceFile] = ()) -> Identity:
    """Identity of what the session makes."""
    from analogrig.identity import Identity

    told = getattr(config, "workerinput", {}).get("mainargv")  # pytest-xdist: the command of the controller
    words = list(told)[1:] if told else config.invocation_params.args
    return Identity.here(shlex.join(["pytest", *map(str, words)]), config.stash[_STARTED], devices)


def properties(made_by: Identity | None) -> Iterator[tuple[str, str]]:
    """Properties for JUnit of one play."""
    if made_by is None:
        return
    yield "analogrig", made_by.analogrig
    yield _PLAYED, made_by.commit
    yield "command", made_by.command
    yield "started", made_by.started
    yield "host", made_by.host
    yield "python", made_by.python
    for each in made_by.devices:
        yield "device_file", each.path
        yield "device_sha256", each.sha256


class _Suite:
    """Give the test suite of JUnit the identity of the session, if anything was played: other suites stay as they are.

    Under pytest-xdist it hears of the plays of all workers.
    """

    def __init__(self) -> None:
        self._has_played = False

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._has_played = self._has_played or any(name == _PLAYED for name, _ in report.user_properties)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if not self._has_played:
            return
        for plugin in session.config.pluginmanager.get_plugins():
            add: Any = getattr(plugin, "add_global_property", None)  # that of pytest's own JUnit writer
            if callable(add):
                for name, value in properties(identity(session.config)):
                    add(name, value)
