"""Scenario files as tests: those of --hil-scenario-dir."""

from __future__ import annotations

import contextlib
import fnmatch
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from analogrig.testing.plugin.devices import DEVICES, check_owner
from analogrig.testing.plugin.hil_options import DUT, RIG, SCENARIO_DIR, Option, time_limit_s, trust_of
from analogrig.testing.plugin.player import Player

if TYPE_CHECKING:
    from analogrig.testing.statement import Finding

_FOLDER = pytest.StashKey[Path]()
"""Folder whose scenario files are tests; absent without one."""

_COMPLAINT = pytest.StashKey[str]()
"""Reason why the folder of the ini file cannot be collected."""


def add_folder(config: pytest.Config) -> None:
    """Collect the scenarios on top of all tests; on top of tests that are named only if the command line asks for both.

    A folder of the ini file that cannot be collected fails as a test of its own (``add_complaint``).

    :raises pytest.UsageError: the folder of the command line cannot be collected.
    """
    folder = SCENARIO_DIR.of_session(config)
    if not folder.value:
        return
    config.stash[_FOLDER] = path = Path(folder.value).resolve()
    named = config.args_source is pytest.Config.ArgsSource.ARGS
    if named and folder.source != "command line":
        return
    complaint = SCENARIO_DIR.complaint(folder.value) or ("" if named else _recursion_complaint(folder.value, config))
    if complaint and folder.source == "command line":
        raise pytest.UsageError(f"{folder.by}: {complaint}")
    if complaint:
        config.stash[_COMPLAINT] = f"{folder.by}: {complaint}"
    elif all(Path(each).resolve() != path for each in config.args):
        config.args.append(folder.value)


def _recursion_complaint(folder: str, config: pytest.Config) -> str:
    """Reason why pytest does not enter a folder that is not named; empty if pytest enters it."""
    path, root = Path(folder).resolve(), config.rootpath.resolve()
    parts = path.relative_to(root).parts if path.is_relative_to(root) else ()
    if not any(fnmatch.fnmatch(part, pattern) for part in parts for pattern in config.getini("norecursedirs")):
        return ""
    return f"pytest does not look into {folder} of itself: use pytest {folder} {SCENARIO_DIR.flag} {folder}"


def collect_file(path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Scenario of a file in the folder; None for any other file, such as the file of a rig or a device beside it."""
    folder = parent.config.stash.get(_FOLDER, None)
    if folder is None or path.suffix != ".toml" or not path.is_relative_to(folder):
        return None
    from analogrig import config
    from analogrig.devices.registry import KINDS
    from analogrig.errors import AnalogrigError
    from analogrig.rigs.description import KINDS as RIG_KINDS

    with contextlib.suppress(AnalogrigError):
        if config.read_toml(path).get("kind", "scenario") in {*KINDS, *RIG_KINDS}:
            return None
    return ScenarioFile.from_parent(parent, path=path)


def add_complaint(session: pytest.Session, items: list[pytest.Item]) -> None:
    """Add a failing test if the folder of the ini file cannot be collected: its scenarios must not go unnoticed."""
    if complaint := session.config.stash.get(_COMPLAINT, ""):
        items.append(NoFolder.from_parent(session, name=SCENARIO_DIR.name, nodeid=SCENARIO_DIR.name, why=complaint))


class NoFolder(pytest.Item):
    """Stands for the scenarios of a folder that cannot be collected, and fails."""

    def __init__(self, *, why: str, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._why = why

    def runtest(self) -> None:
        pytest.fail(self._why, pytrace=False)

    def reportinfo(self) -> tuple[Path, None, str]:
        return self.path, None, self.name


class ScenarioFile(pytest.File):
    """A file of --hil-scenario-dir."""

    def collect(self) -> Iterator[pytest.Item]:
        from analogrig.testing.counterexample import SCENARIO_FILE

        is_counterexample = self.path.name == SCENARIO_FILE  # its folder is named after the test
        yield ScenarioItem.from_parent(self, name=self.path.parent.name if is_counterexample else self.path.stem)


class ScenarioItem(pytest.Item):
    """One scenario: what a test asserted of it holds, or what it expects of the device."""

    def runtest(self) -> None:
        from analogrig.errors import AnalogrigError
        from analogrig.testing.statement import Finding
        from analogrig_emulator import EmulatorError

        check_owner(self)
        try:
            finding = self._judge()
        except (AnalogrigError, EmulatorError) as error:
            finding = Finding(holds=False, why=str(error).removeprefix(f"{self.path}: "))
        if not finding:
            pytest.fail(f"{self.path}: {finding.why}", pytrace=False)

    def _judge(self) -> Finding:
        import analogrig.testing.one_play
        import analogrig.testing.properties.claimed
        import analogrig.testing.properties.conversed
        import analogrig.testing.properties.experiments
        import analogrig.testing.properties.switches  # noqa: F401 - each registers what a file can state
        from analogrig.bench import Bench
        from analogrig.rigs.description import open_rig
        from analogrig.scenario import DEFAULT_SEED, Scenario
        from analogrig.testing.statement import judge_statement

        scenario = Scenario.load(str(self.path))
        seed = DEFAULT_SEED if scenario.seed is None else scenario.seed
        devices, name, trust = self.config.stash[DEVICES], self._name(DUT, scenario.dut), trust_of(self.config)
        with open_rig(self._name(RIG, scenario.rig), allow=trust) as rig:
            try:
                play = Player(self, Bench(rig, devices.lease(name, trust), time_limit_s=time_limit_s(self.config)))
                if scenario.statement is None:
                    return play(scenario).passes()
                return judge_statement(scenario.statement, play, scenario, seed, str(self.path))
            finally:
                if name == scenario.dut:
                    devices.release(name)

    def hil_equipment(self) -> tuple[str, str]:
        """Names of rig and device; empty where the file cannot be read."""
        from analogrig.errors import AnalogrigError
        from analogrig.scenario import Scenario

        with contextlib.suppress(AnalogrigError):
            scenario = Scenario.load(str(self.path))
            return self._name(RIG, scenario.rig), self._name(DUT, scenario.dut)
        return "", ""

    def _name(self, option: Option, own: str) -> str:
        """Name of rig or device: explicit, else the scenario's ``own``, else that of the session."""
        setting = option.of_session(self.config)
        return setting.value if setting.is_explicit else own or setting.value

    def reportinfo(self) -> tuple[Path, int, str]:
        return self.path, 0, f"scenario {self.name}"
