"""The plugin for pytest: rigs, devices and plays as fixtures, scenario files as tests, and a file for what fails.

Loaded by every pytest in whose environment analogrig is installed, so nothing heavy is imported before a test asks.
An option is taken from, in this order: indirect parametrization of its fixture, the command line, the environment
(ANALOGRIG_RIG, ...), the ini file (analogrig_rig, ...), its default.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from harness.bench import Bench
    from harness.dut import Dut
    from harness.played import Played
    from harness.rigs.rig import Rig
    from harness.scenario import Scenario
    from harness.verdict import TweakVerdict

PROFILES = ("ci", "nightly", "soak")


@dataclass(frozen=True)
class _Option:
    """One setting of the plugin, under one name everywhere."""

    name: str
    default: str
    help: str
    choices: tuple[str, ...] | None = None

    @property
    def variable(self) -> str:
        return f"ANALOGRIG_{self.name.upper()}"

    @property
    def ini(self) -> str:
        return f"analogrig_{self.name}"

    @property
    def flag(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    def value(self, config: pytest.Config) -> str:
        """:raises pytest.UsageError: it is none of the choices."""
        given = config.getoption(self.flag) or os.environ.get(self.variable) or config.getini(self.ini) or self.default
        value = str(given)
        if self.choices and value not in self.choices:
            raise pytest.UsageError(f"{self.flag}: must be one of {', '.join(self.choices)}, not {value!r}")
        return value


_OPTIONS = {
    option.name: option
    for option in (
        _Option("rig", "emulator", "what plays the scenarios: a shipped name, a .toml file, recording:FILE"),
        _Option("dut", "host", "the device under test: host, inproc, qemu-m4[:ELF], serial:URL, can:..., a .toml file"),
        _Option("scenario_dir", "", "a folder of scenario files, each of which is a test"),
        _Option("runs_dir", "build/runs", "where the recordings of tests that fail go"),
        _Option("hil_profile", "ci", "how much the properties try", PROFILES),
    )
}


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("analogrig", "hardware in the loop (analogrig)")
    for option in _OPTIONS.values():
        told = f"{option.help} (also {option.variable}, ini {option.ini}; default: {option.default or 'none'})"
        group.addoption(option.flag, metavar=option.name.rpartition("_")[2].upper(), help=told)
        parser.addini(option.ini, option.help, default="")


_DEVICES = pytest.StashKey["_Devices"]()
_PLAYS = pytest.StashKey[list["Played"]]()


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "needs(*capabilities): skip where the rig cannot do that: tweak, excite")
    os.environ[_OPTIONS["hil_profile"].variable] = _OPTIONS["hil_profile"].value(config)
    config.stash[_DEVICES] = _Devices()
    folder = _OPTIONS["scenario_dir"].value(config)
    if folder:
        if not Path(folder).is_dir():
            raise pytest.UsageError(f"--scenario-dir: {folder} is no folder")
        if folder not in config.args:
            config.args.append(folder)


def pytest_unconfigure(config: pytest.Config) -> None:
    devices = config.stash.get(_DEVICES, None)
    if devices is not None:
        devices.close()


# ------------------------------------------------------------------------------------------------------------ devices


@dataclass
class _Devices:
    """The devices of this process. They last as long as the session, and are reached anew when a test has hung them."""

    _open: dict[str, Dut] = field(default_factory=dict)
    _described: dict[str, Any] = field(default_factory=dict)

    def lease(self, name: str) -> Dut:
        """A device that is there, reset and configured as described, whatever the test before has done to it.

        :raises AnalogrigError: it cannot be reached.
        """
        from harness.dut import open_dut
        from harness.errors import AnalogrigError

        _check_owner(name)
        dut = self._open.pop(name, None)
        if dut is not None:
            try:
                dut.handshake()
                dut.configure(self._described[name])
            except AnalogrigError:
                dut.close()
                dut = None
        if dut is None:
            dut = open_dut(name)
            self._described[name] = dut.estimator
        self._open[name] = dut
        return dut

    def close(self) -> None:
        for dut in self._open.values():
            dut.close()
        self._open.clear()


def _check_owner(name: str) -> None:
    """A device of which there is only one belongs to one worker of pytest-xdist.

    :raises pytest.UsageError: this is another one.
    """
    from harness.devices import describe

    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0")
    if worker != "gw0" and describe(name).only_one:
        raise pytest.UsageError(f"device {name}: one worker owns it; run pytest with -n 1, or without -n")


def _check_rig_owner(name: str, rig: Rig) -> None:
    """A real rig likewise.

    :raises pytest.UsageError: this worker is another one.
    """
    from harness.rigs.real import RealRig

    if isinstance(rig, RealRig) and os.environ.get("PYTEST_XDIST_WORKER", "gw0") != "gw0":
        raise pytest.UsageError(f"rig {name}: one worker owns it; run pytest with -n 1, or without -n")


# ----------------------------------------------------------------------------------------------------------- fixtures


@contextlib.contextmanager
def _in_one_line() -> Iterator[None]:
    """What went wrong with rig, link or device is told without the way through our code."""
    from emulator.errors import EmulatorError
    from harness.errors import AnalogrigError

    failure = ""
    try:
        yield
    except (AnalogrigError, EmulatorError) as error:
        failure = str(error)
    if failure:  # not where it was caught, or pytest would tell of all that led to it
        pytest.fail(failure, pytrace=False)


def _chosen(request: pytest.FixtureRequest, name: str) -> str:
    return str(getattr(request, "param", None) or _OPTIONS[name].value(request.config))


def _said(item: pytest.Item, name: str) -> str:
    """As ``_chosen``, for the fixture of that name."""
    callspec = getattr(item, "callspec", None)
    given = callspec.params.get(name) if callspec is not None else None
    return given if isinstance(given, str) else _OPTIONS[name].value(item.config)


@pytest.fixture
def scenario_dir(request: pytest.FixtureRequest) -> Path | None:
    """The folder of --scenario-dir."""
    value = _chosen(request, "scenario_dir")
    return Path(value) if value else None


@pytest.fixture
def runs_dir(request: pytest.FixtureRequest) -> Path:
    """The folder of --runs-dir."""
    return Path(_chosen(request, "runs_dir"))


@pytest.fixture
def hil_profile(request: pytest.FixtureRequest) -> str:
    """``ci``, ``nightly`` or ``soak``."""
    return _chosen(request, "hil_profile")


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """The rig of --rig, opened; the test is skipped if it lacks what the mark ``needs`` asks."""
    from harness.rigs.description import open_rig

    name = _chosen(request, "rig")
    with _in_one_line():
        opened = open_rig(name)
    with opened:
        _check_rig_owner(name, opened)
        _skip_unless_able(request.node, opened, name)
        yield opened


def _skip_unless_able(item: pytest.Item, rig: Rig, name: str) -> None:
    for mark in item.iter_markers("needs"):
        lacking = sorted(set(mark.args) - rig.capabilities)
        if lacking:
            able = ", ".join(sorted(rig.capabilities)) or "nothing but play"
            pytest.skip(f"rig {name} cannot {' and '.join(lacking)} (it can {able}): choose another with --rig")


@pytest.fixture
def dut(request: pytest.FixtureRequest) -> Dut:
    """The device of --dut, reset and configured as described."""
    with _in_one_line():
        return request.config.stash[_DEVICES].lease(_chosen(request, "dut"))


@pytest.fixture
def bench(rig: Rig, dut: Dut) -> Bench:
    """Both on one table."""
    from harness.bench import Bench

    return Bench(rig, dut)


@pytest.fixture
def play(request: pytest.FixtureRequest, bench: Bench) -> Callable[..., Played]:
    """``play(scenario, seed=None) -> Played``: a name, a .toml file or a Scenario; by default the seed that it has.

    A play that is INCONCLUSIVE fails the test with its reason; ``allow_inconclusive=True`` hands it on.
    """
    return _Player(request.node, bench).play


@dataclass
class _Player:
    """Plays for one test, and keeps what it has played."""

    item: pytest.Item
    bench: Bench

    def play(
        self, scenario: str | Path | Scenario, seed: int | None = None, *, allow_inconclusive: bool = False
    ) -> Played:
        from harness.counterexample import command_of
        from harness.errors import AnalogrigError
        from harness.played import Played
        from harness.scenario import DEFAULT_SEED, Scenario

        with _in_one_line():
            chosen = scenario if isinstance(scenario, Scenario) else Scenario.load(str(scenario))
            drawn = seed if seed is not None else DEFAULT_SEED if chosen.seed is None else chosen.seed
            run = self.bench.play(chosen, drawn)
        if run.conditions.faults:  # nothing of it may reach the next play of this test
            with contextlib.suppress(AnalogrigError):
                self.bench.dut.handshake()
        said = "" if isinstance(scenario, Scenario) else str(scenario)
        played = Played(run, command_of(run, said, _said(self.item, "rig"), _said(self.item, "dut")))
        self.item.stash.setdefault(_PLAYS, []).append(played)
        _note(self.item, played)
        if not played.verdict.valid and not allow_inconclusive:
            pytest.fail(f"INCONCLUSIVE: {played.verdict.reasons[0]}", pytrace=False)
        return played


def _note(item: pytest.Item, played: Played) -> None:
    """What JUnit shall know of a play."""
    conditions, verdict = played.run.conditions, played.verdict
    identity = conditions.dut.get("identity", {})
    properties: Mapping[str, Any] = {
        "seed": conditions.seed,
        "scenario": conditions.scenario["name"],
        "rig": conditions.rig["name"],
        "dut": conditions.dut["name"],
        "firmware": identity.get("firmware", ""),
        "catalogue_hash": f"{identity.get('catalogue_hash', 0):08x}",
        "commit": _commit(),
        "outcome": verdict.outcome,
        "theta_hash": verdict.theta_hash,
        "latency_n": " ".join(_latency(tweak) for tweak in verdict.tweaks),
        "bound_n": " ".join(str(tweak.bound_n) for tweak in verdict.tweaks),
        "false_alarms": len(verdict.false_alarms),
        "overruns": conditions.counters.get("receive_overruns", 0),
    }
    item.user_properties.extend(properties.items())


def _latency(tweak: TweakVerdict) -> str:
    """``4``, or ``1..9`` where the instant of the change is not known better; ``None`` without an alarm."""
    if tweak.latencies_n is None or not tweak.others:
        return str(tweak.latency_n)
    return "{}..{}".format(*tweak.latencies_n)


def _commit() -> str:
    """Of the repository in which pytest runs; empty where there is none."""
    if "commit" not in _KNOWN:
        try:
            command = ["git", "rev-parse", "--short=12", "HEAD"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
        except (OSError, subprocess.SubprocessError):
            done = None
        _KNOWN["commit"] = done.stdout.strip() if done is not None and done.returncode == 0 else ""
    return _KNOWN["commit"]


_KNOWN: dict[str, str] = {}


# ---------------------------------------------------------------------------------------------------- what has failed


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    plays = item.stash.get(_PLAYS, [])
    if report.when == "call" and report.failed and plays:
        report.sections.append(("analogrig", _kept(item, plays[-1])))
    return report


def _kept(item: pytest.Item, played: Played) -> str:
    """Writes the last play of a test that failed; says where, and how to repeat it."""
    from harness.counterexample import write
    from harness.errors import AnalogrigError

    folder = Path(_OPTIONS["runs_dir"].value(item.config)) / re.sub(r"[^\w.-]+", "_", item.nodeid).strip("_")
    try:
        command = write(played.run, folder)
    except (AnalogrigError, OSError) as error:
        return f"its recording could not be written to {folder}: {error}"
    return f"recording and scenario: {folder}\nrepeat it with: {command}"


# ----------------------------------------------------------------------------------------------------- scenario files


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    folder = _OPTIONS["scenario_dir"].value(parent.config)
    if not folder or file_path.suffix != ".toml" or not file_path.is_relative_to(Path(folder).resolve()):
        return None
    return ScenarioFile.from_parent(parent, path=file_path) if _is_scenario(file_path) else None


def _is_scenario(path: Path) -> bool:
    """A rig or a device beside it is none."""
    from harness import config
    from harness.errors import AnalogrigError

    with contextlib.suppress(AnalogrigError):
        return "kind" not in config.read_toml(path)
    return True


class ScenarioFile(pytest.File):
    """A file of --scenario-dir."""

    def collect(self) -> Iterator[pytest.Item]:
        yield ScenarioItem.from_parent(self, name=self.path.stem)


class ScenarioItem(pytest.Item):
    """One scenario, played on the session's rig and device; passed if its verdict is."""

    def runtest(self) -> None:
        from harness.bench import Bench
        from harness.rigs.description import open_rig
        from harness.scenario import Scenario

        scenario = Scenario.load(str(self.path))
        option = _OPTIONS["rig"]
        given = self.config.getoption(option.flag) or os.environ.get(option.variable)
        name = str(given or scenario.rig or option.value(self.config))
        dut = self.config.stash[_DEVICES].lease(_OPTIONS["dut"].value(self.config))
        with open_rig(name) as rig:
            played = _Player(self, Bench(rig, dut)).play(scenario)
        if played.verdict.outcome != "passed":
            raise ScenarioFailed("; ".join(played.verdict.reasons))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        from harness.errors import AnalogrigError

        if isinstance(excinfo.value, ScenarioFailed | AnalogrigError):
            return f"{self.path}: {excinfo.value}"
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int, str]:
        return self.path, 0, f"scenario {self.name}"


class ScenarioFailed(Exception):  # noqa: N818 - a verdict, not an error
    """The device did not do what the scenario asks."""
