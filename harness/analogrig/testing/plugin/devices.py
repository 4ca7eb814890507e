"""Devices of a session, and the assignment of single rigs and devices to one worker of pytest-xdist."""

from __future__ import annotations

import contextlib
import functools
import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from analogrig.testing.plugin.hil_options import DUT, RIG

if TYPE_CHECKING:
    from analogrig.devices.device import Device
    from analogrig.trust import Trust

_FOLDER = "analogrig_owned"
"""Key of a worker's input: the folder that lists the tests which need a single rig or device."""

_SPREADING = ("load", "worksteal")
"""Values of --dist with which pytest-xdist gives any test to any worker."""


@dataclass
class Devices:
    """Devices of a session. They stay open until the session ends, and are reopened after a test has hung them."""

    _open: dict[str, Device] = field(default_factory=dict)

    def lease(self, name: str, trust: Trust) -> Device:
        """Device that is reachable, reset and configured as described, in whatever state the last test left it.

        :raises AnalogrigError: it cannot be reached, or a file names it and it is not trusted.
        """
        from analogrig.devices.registry import describe, open_dut, trusted
        from analogrig.errors import AnalogrigError

        only_one = trusted(name, trust).only_one
        if name in self._open:
            dut = self._open[name]
            try:
                dut.recover()
                dut.configure()
            except AnalogrigError:
                self.release(name)
        if name not in self._open:
            for other in [each for each in self._open if only_one and describe(each).only_one == only_one]:
                self.release(other)
            self._open[name] = open_dut(name, allow=trust)
        return self._open[name]

    def release(self, name: str) -> None:
        """Close the device ``name``, if it is open."""
        if name in self._open:
            self._open.pop(name).close()

    def close(self) -> None:
        for name in list(self._open):
            self.release(name)


DEVICES = pytest.StashKey[Devices]()
"""Devices of the session."""


class OneOwner:
    """Scheduling of pytest-xdist that gives all tests of a single rig or device to one worker, and any other to any.

    Its own groups (--dist loadgroup) would do, but do not reach the scheduler with pytest 9.2 (pytest-xdist 1386).
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        node.workerinput[_FOLDER] = str(self._folder)

    @pytest.hookimpl(optionalhook=True, tryfirst=True)
    def pytest_xdist_make_scheduler(self, config: pytest.Config, log: Any) -> Any:
        from xdist.scheduler import LoadScopeScheduling

        folder = self._folder

        def scope(_: Any, nodeid: str) -> str:
            return _FOLDER if nodeid in _owned_tests(folder) else nodeid

        return type("OneOwnerScheduling", (LoadScopeScheduling,), {"_split_scope": scope})(config, log)

    def pytest_unconfigure(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)


@functools.cache
def _owned_tests(folder: Path) -> frozenset[str]:
    """Node ids of the tests that one worker owns. Call it after all workers have collected: each writes the same
    list."""
    lists = sorted(folder.iterdir())
    return frozenset(json.loads(lists[0].read_text(encoding="utf-8")) if lists else ())


def assign_owner(config: pytest.Config) -> None:
    """Have one worker of pytest-xdist run all tests of the session's rig and device, if there is only one of either.

    A name in the environment does not change how a session distributes its tests; see ``check_owner``.

    :raises pytest.UsageError: the command line names such a rig or device, and a --dist that does not go with it.
    """
    dist, workers = config.getoption("dist", "no"), config.getoption("tx", None) or []
    if dist == "no" or len(workers) < 2:
        return
    settings = [option.of_session(config) for option in (RIG, DUT)]

    def single(*sources: str) -> str:
        return _single_equipment(*(each.value if each.source in sources else "" for each in settings))

    if dist not in _SPREADING:
        if text := single("command line"):
            raise pytest.UsageError(f"{text}, and --dist {dist} may not: use --dist load, or leave out -n")
    elif single("command line", "ini file"):
        config.pluginmanager.register(OneOwner(Path(tempfile.mkdtemp(prefix="analogrig-"))))


def list_owned_tests(config: pytest.Config, items: Sequence[pytest.Item]) -> None:
    """In a worker: write down which tests belong together."""
    inputs = getattr(config, "workerinput", {})
    if _FOLDER in inputs:
        owned = [item.nodeid for item in items if single_equipment(item)]
        path = Path(inputs[_FOLDER]) / f"{inputs['workerid']}.json"
        try:
            path.write_text(json.dumps(owned), encoding="utf-8")
        except OSError:  # the folder of another machine
            del inputs[_FOLDER]


def check_owner(item: pytest.Item) -> None:
    """Fail a test whose rig or device another worker may have."""
    inputs = getattr(item.config, "workerinput", {})
    if inputs.get("workercount", 1) > 1 and _FOLDER not in inputs and (single := single_equipment(item)):
        pytest.fail(
            f"{single}: leave out -n, or use --dist load and name it for all tests with --hil-rig or --hil-dut",
            pytrace=False,
        )


def single_equipment(item: pytest.Item) -> str:
    """Description of the single rig or device that a test needs and one worker owns; empty if the test needs none."""
    if (equipment := getattr(item, "hil_equipment", None)) is not None:  # a scenario file
        return _single_equipment(*equipment())
    wanted = getattr(item, "fixturenames", ())
    rig, dut = (option.of(item).value if option.name in wanted else "" for option in (RIG, DUT))
    return _single_equipment(rig, dut)


def _single_equipment(rig: str, dut: str) -> str:
    """Description of the single one of a rig and a device; empty if neither is single.

    The code that opens them reports names that do not exist.
    """
    if not rig and not dut:
        return ""
    from analogrig.devices.registry import describe
    from analogrig.errors import AnalogrigError
    from analogrig.rigs.description import describe as describe_rig
    from analogrig_emulator import EmulatorError

    with contextlib.suppress(AnalogrigError, EmulatorError):
        if dut and describe(dut).only_one:
            return f"device {dut}: one worker owns it"
    with contextlib.suppress(AnalogrigError, EmulatorError):
        if rig and describe_rig(rig).only_one:
            return f"rig {rig}: one worker owns it"
    return ""
