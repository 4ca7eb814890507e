"""Scenario files as tests: those of --hil-scenario-dir."""

from __future__ import annotations

import contextlib
import fnmatch
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from analogrig.testing.plugin.devices import Devices, check_owner
from analogrig.testing.plugin.options import DUT, RIG, SCENARIO_DIR, time_limit_s, trust_of
from analogrig.testing.plugin.playing import Player

if TYPE_CHECKING:
    from analogrig.scenario import Scenario
    from analogrig.testing.statement import Finding

RIG_KINDS = ("emulator", "real")

DEVICES = pytest.StashKey[Devices]()
"""Of the session."""


def add_folder(config: pytest.Config) -> None:
    """The scenarios come on top of all tests; of those that are named if the command line asks for them.

    :raises pytest.UsageError: pytest does not look into that folder of itself.
    """
    folder = SCENARIO_DIR.said(config)
    named = config.args_source is pytest.Config.ArgsSource.ARGS
    if not folder.value or (named and folder.by != SCENARIO_DIR.flag):
        return
    path = Path(folder.value).resolve()
    passed_over = config.getini("norecursedirs")
    if not named and any(fnmatch.fnmatch(each, pattern) for each in _below(path, config) for pattern in passed_over):
        raise pytest.UsageError(
            f"{folder.by}: pytest does not look into {folder.value} of itself: say pytest {folder.value}"
            f" {SCENARIO_DIR.flag} {folder.value}"
        )
    if all(Path(each).resolve() != path for each in config.args):
        config.args.append(folder.value)


def _below(path: Path, config: pytest.Config) -> tuple[str, ...]:
    root = config.rootpath.resolve()
    return path.relative_to(root).parts if path.is_relative_to(root) else ()


def collected(path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    folder = SCENARIO_DIR.said(parent.config).value
    if not folder or path.suffix != ".toml" or not path.is_relative_to(Path(folder).resolve()):
        return None
    return ScenarioFile.from_parent(parent, path=path) if _is_scenario(path) else None


def _is_scenario(path: Path) -> bool:
    """A rig or a device beside it is none."""
    from analogrig import config
    from analogrig.devices.devices import KINDS
    from analogrig.errors import AnalogrigError

    with contextlib.suppress(AnalogrigError):
        return config.read_toml(path).get("kind", "scenario") not in {*KINDS, *RIG_KINDS}
    return True


class ScenarioFile(pytest.File):
    """A file of --hil-scenario-dir."""

    def collect(self) -> Iterator[pytest.Item]:
        from analogrig.testing.counterexample import SCENARIO_FILE

        is_left = self.path.name == SCENARIO_FILE  # by a test, after which its folder is called
        yield ScenarioItem.from_parent(self, name=self.path.parent.name if is_left else self.path.stem)


class ScenarioItem(pytest.Item):
    """One scenario: what a test asserted of it holds, or what it expects of the device."""

    def runtest(self) -> None:
        from analogrig.bench import Bench
        from analogrig.rigs.description import open_rig
        from analogrig.scenario import Scenario

        check_owner(self)
        scenario = Scenario.load(str(self.path))
        devices, name, trust = self.config.stash[DEVICES], self._device(scenario), trust_of(self.config)
        with open_rig(self._rig(scenario), allow=trust) as rig:
            try:
                bench = Bench(rig, devices.lease(name, trust), time_limit_s=time_limit_s(self.config))
                finding = self._found(Player(self, bench), scenario)
            finally:
                if name == scenario.dut:
                    devices.release(name)
        if not finding:
            raise ScenarioFailed(finding.why)

    def _found(self, play: Player, scenario: Scenario) -> Finding:
        import analogrig.testing.played
        import analogrig.testing.properties.experiments  # noqa: F401 - each makes known what a file can state
        from analogrig.scenario import DEFAULT_SEED
        from analogrig.testing.experiment import judged

        if scenario.statement is None:
            return play(scenario).passes()
        seed = DEFAULT_SEED if scenario.seed is None else scenario.seed
        return judged(scenario.statement, play, scenario, seed, str(self.path))

    def equipment(self) -> tuple[str, str]:
        """Names of rig and device; empty where the file cannot be read."""
        from analogrig.errors import AnalogrigError
        from analogrig.scenario import Scenario

        with contextlib.suppress(AnalogrigError):
            scenario = Scenario.load(str(self.path))
            return self._rig(scenario), self._device(scenario)
        return "", ""

    def _rig(self, scenario: Scenario) -> str:
        given = RIG.given(self.config)
        return given.value if given else scenario.rig or RIG.otherwise(self.config).value

    def _device(self, scenario: Scenario) -> str:
        given = DUT.given(self.config)
        return given.value if given else scenario.dut or DUT.otherwise(self.config).value

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        from analogrig.errors import AnalogrigError
        from analogrig_emulator.errors import EmulatorError

        if isinstance(excinfo.value, ScenarioFailed | AnalogrigError | EmulatorError):
            return f"{self.path}: {str(excinfo.value).removeprefix(f'{self.path}: ')}"
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int, str]:
        return self.path, 0, f"scenario {self.name}"


class ScenarioFailed(Exception):  # noqa: N818 - a verdict, not an error
    """The device did not do what the scenario asks."""
