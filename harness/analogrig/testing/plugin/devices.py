"""The devices of a session, and what of rigs and devices there is only one, which one worker of pytest-xdist owns."""

from __future__ import annotations

import contextlib
import functools
import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import pytest

from analogrig.testing.plugin.options import DUT, RIG, Source

if TYPE_CHECKING:
    from analogrig.devices.dut import Dut
    from analogrig.trust import Trust

_TOLD = "analogrig_owned"
"""What a worker is told: the folder in which it says which tests need what there is one of."""

_SPREADING = ("load", "worksteal")
"""Those --dist of pytest-xdist that give any test to any worker."""


@runtime_checkable
class Equipped(Protocol):
    """An item that names its own rig and device; other plugins' items have no such method."""

    def hil_equipment(self) -> tuple[str, str]:
        """The names of rig and device; empty: unknown."""


@dataclass
class Devices:
    """They last as long as the session, and are reached anew when a test has hung them."""

    _open: dict[str, Dut] = field(default_factory=dict)
    _described: dict[str, Any] = field(default_factory=dict)

    def lease(self, name: str, trust: Trust) -> Dut:
        """A device that is there, reset and configured as described, whatever the test before has done to it.

        :raises AnalogrigError: it cannot be reached, or a file names it and it is not trusted.
        """
        from analogrig.devices.dut import open_dut
        from analogrig.devices.registry import trusted
        from analogrig.errors import AnalogrigError

        only_one = trusted(name, trust).only_one
        dut = self._open.pop(name, None)
        if dut is not None:
            try:
                dut.handshake()
                dut.configure(self._described[name])
            except AnalogrigError:
                dut.close()
                dut = None
        if dut is None:
            self._let_go(only_one)
            dut = open_dut(name, allow=trust)
            self._described[name] = dut.estimator
        self._open[name] = dut
        return dut

    def release(self, name: str) -> None:
        """It is not asked for again."""
        if (dut := self._open.pop(name, None)) is not None:
            dut.close()

    def _let_go(self, only_one: str) -> None:
        """Of what is open under another name, and cannot be opened twice."""
        from analogrig.devices.registry import describe

        for name in [name for name in self._open if only_one and describe(name).only_one == only_one]:
            self.release(name)

    def close(self) -> None:
        for name in list(self._open):
            self.release(name)


class OneOwner:
    """Has pytest-xdist give all tests that need the one rig or device to one worker, and any other to any.

    Its own groups (--dist loadgroup) would do, but do not reach the scheduler with pytest 9.2 (pytest-xdist 1386).
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        node.workerinput[_TOLD] = str(self._folder)

    @pytest.hookimpl(optionalhook=True, tryfirst=True)
    def pytest_xdist_make_scheduler(self, config: pytest.Config, log: Any) -> Any:
        from xdist.scheduler import LoadScopeScheduling

        folder = self._folder

        def scope(_: Any, nodeid: str) -> str:
            return _TOLD if nodeid in _owned(folder) else nodeid

        return type("OneOwnerScheduling", (LoadScopeScheduling,), {"_split_scope": scope})(config, log)

    def pytest_unconfigure(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)


@functools.cache
def _owned(folder: Path) -> frozenset[str]:
    """Asked when every worker has collected: each says the same."""
    told = sorted(folder.iterdir())
    return frozenset(json.loads(told[0].read_text(encoding="utf-8")) if told else ())


def keep_with_owner(config: pytest.Config) -> None:
    """Have one worker of pytest-xdist run all tests of the session's rig and device, if there is only one of either.

    A name in the environment does not change how a session distributes its tests; see ``check_owner``.

    :raises pytest.UsageError: the command line names such a rig or device, and a --dist that does not go with it.
    """
    dist, workers = config.getoption("dist", "no"), config.getoption("tx", None) or []
    if dist == "no" or len(workers) < 2:
        return
    said = [option.said(config) for option in (RIG, DUT)]

    def single(*sources: Source) -> str:
        return _single(*(each.value if each.source in sources else "" for each in said))

    if dist not in _SPREADING:
        if refused := single("command line"):
            raise pytest.UsageError(f"{refused}, and --dist {dist} may not: use --dist load, or leave out -n")
    elif single("command line", "ini file"):
        config.pluginmanager.register(OneOwner(Path(tempfile.mkdtemp(prefix="analogrig-"))))


def tell_owned(config: pytest.Config, items: Sequence[pytest.Item]) -> None:
    """In a worker: which tests belong together."""
    told = getattr(config, "workerinput", {})
    if _TOLD in told:
        owned = [item.nodeid for item in items if single_of(item)]
        path = Path(told[_TOLD]) / f"{told['workerid']}.json"
        try:
            path.write_text(json.dumps(owned), encoding="utf-8")
        except OSError:  # the folder of another machine
            del told[_TOLD]


def check_owner(item: pytest.Item) -> None:
    """Fail a test whose rig or device another worker may have."""
    told = getattr(item.config, "workerinput", {})
    if told.get("workercount", 1) > 1 and _TOLD not in told and (single := single_of(item)):
        pytest.fail(
            f"{single}: leave out -n, or use --dist load and name it for all tests with --hil-rig or --hil-dut",
            pytrace=False,
        )


def single_of(item: pytest.Item) -> str:
    """What a test needs of which there is one, and that one worker owns it; empty: nothing."""
    if isinstance(item, Equipped):
        return _single(*item.hil_equipment())
    wanted = getattr(item, "fixturenames", ())
    rig, dut = (option.of(item) if option.name in wanted else "" for option in (RIG, DUT))
    return _single(rig, dut)


def _single(rig: str, dut: str) -> str:
    """Which of a rig and a device there is only one of; whether they exist at all will be found out by who asks."""
    if not rig and not dut:
        return ""
    from analogrig.devices.registry import describe
    from analogrig.errors import AnalogrigError
    from analogrig.rigs.description import described
    from analogrig_emulator import EmulatorError

    with contextlib.suppress(AnalogrigError, EmulatorError):
        if dut and describe(dut).only_one:
            return f"device {dut}: one worker owns it"
    with contextlib.suppress(AnalogrigError, EmulatorError):
        if rig and not rig.startswith("recording:") and described(rig)[0].get("kind") == "real":
            return f"rig {rig}: one worker owns it"
    return ""
