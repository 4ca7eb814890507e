"""Identity of a session of pytest, for the recordings of its plays; and the properties of plays in JUnit."""

from __future__ import annotations

import functools
import shlex
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from analogrig.identity import DeviceFile, Identity
    from analogrig.judging.verdict import ChangeVerdict
    from analogrig.testing.one_play import Played

_STARTED = pytest.StashKey[str]()

_PLAYED = "analogrig_commit"
"""Property that a test has once it has played."""


def begin(config: pytest.Config) -> None:
    """Note when the session has started, and have its test suite named in JUnit."""
    config.stash[_STARTED] = time.strftime("%Y-%m-%dT%H:%M:%S+00:00", time.gmtime())
    config.pluginmanager.register(_Suite())


def session_identity(config: pytest.Config, devices: Sequence[DeviceFile] = ()) -> Identity:
    """Identity of what the session makes."""
    from analogrig.identity import Identity

    arguments = getattr(config, "workerinput", {}).get("mainargv")  # pytest-xdist: the command of the controller
    words = list(arguments)[1:] if arguments else config.invocation_params.args
    return Identity.here(shlex.join(["pytest", *map(str, words)]), config.stash[_STARTED], devices)


def play_properties(played: Played) -> Iterator[tuple[str, Any]]:
    """Properties of one play."""
    conditions, verdict = played.run.conditions, played.verdict
    device = conditions.device.identity
    yield "seed", conditions.seed
    for key in ("scenario", "rig", "dut"):
        yield key, str(getattr(conditions, key)["name"])  # a plain str: pytest-xdist passes on no subclass
    yield "firmware", device.get("firmware", "")
    yield "catalogue_hash", f"{device.get('catalogue_hash', 0):08x}"
    yield "commit", _commit()
    yield "outcome", verdict.outcome
    yield "theta_hash", verdict.theta_hash
    yield "alarm_hash", verdict.alarm_hash
    yield "not_judged", ", ".join(verdict.not_judged)
    yield "latency_n", " ".join(map(latency_property, verdict.changes))
    yield "bound_n", " ".join(str(change.bound_n) for change in verdict.changes)
    yield "false_alarms", len(verdict.false_alarms)
    yield "unarmed_alarms", len(verdict.unarmed_alarms)
    yield "armed_n", verdict.armed_n
    yield "after_warm_up_n", verdict.after_warm_up_n
    yield "channel_faults", ", ".join(f"{fault.name} at {fault.sample}" for fault in verdict.channel_faults)
    yield "overruns", conditions.counters.get("receive_overruns", 0)
    if conditions.identity is not None:
        yield from dict(_identity_properties(conditions.identity)).items()


def latency_property(change: ChangeVerdict) -> str:
    """``4``, or ``1..9`` where the instant of the change is not known better; ``None`` without an alarm."""
    if change.latencies_n is None or not change.alternatives:
        return str(change.latency_n)
    return "{}..{}".format(*change.latencies_n)


@functools.cache
def _commit() -> str:
    """Commit of the repository in which pytest runs; empty outside a repository."""
    from analogrig.identity import git

    return git(Path.cwd(), "rev-parse", "--short=12", "HEAD")


def _identity_properties(identity: Identity) -> Iterator[tuple[str, str]]:
    yield "analogrig", identity.analogrig
    yield _PLAYED, identity.commit
    yield "command", identity.command
    yield "started", identity.started
    yield "host", identity.host
    yield "python", identity.python
    for each in identity.devices:
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
                for name, value in _identity_properties(session_identity(session.config)):
                    add(name, value)
