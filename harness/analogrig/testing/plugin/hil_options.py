"""The options of the plugin, and the source of each value.

An option has one name: as a fixture, on the command line (``--hil-rig``) and in the ini file (``hil_rig``).
Only a wrong value on the command line ends a session. The environment and the ini file may serve other programs, or
other tests, than those that run: a wrong value there fails the tests that use it. ``--hil-allow`` is for the command
line and conftest.py: no file may allow what it names.
"""

from __future__ import annotations

import itertools
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import pytest

if TYPE_CHECKING:
    from analogrig.trust import Trust

ALLOW = "--hil-allow"

EXAMPLES = {"ci": 15, "nightly": 300, "soak": 5000}
"""Examples per property, by profile."""

Source = Literal["parameter", "command line", "environment", "ini file", "default"]


@dataclass(frozen=True)
class Setting:
    """Value of an option."""

    value: str
    by: str
    """Place that gave the value; it begins every error message about it."""
    source: Source

    @property
    def is_explicit(self) -> bool:
        """True if a parameter, the command line or the environment gave the value."""
        return self.source in ("parameter", "command line", "environment")


@dataclass(frozen=True)
class Option:
    """One option of the plugin."""

    name: str
    variable: str
    """Environment variable, empty for none; the command ``analogrig`` reads those of rig and device too."""
    default: str
    help: str
    complaint: Callable[[str], str] = lambda _: ""
    """Return the reason why a value is wrong; empty if none is known."""

    @property
    def flag(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    def of_session(self, config: pytest.Config) -> Setting:
        """The value for the session, unchecked."""
        value = config.getoption(self.flag)
        if value is not None:
            if not _is_on_command_line(config, self.flag, str(value)):  # addopts of the ini file gave it
                from analogrig.trust import FiledName

                value = FiledName(str(value), str(config.inipath))
            return Setting(value, self.flag, "command line")
        if self.variable and (value := os.environ.get(self.variable)):
            return Setting(value, self.variable, "environment")
        value = str(config.getini(self.name))
        if not value:
            return Setting(self.default, self.flag, "default")
        if self in (RIG, DUT) and config.inipath is not None:  # the name counts as one that a file holds
            from analogrig.trust import resolve_name

            value = resolve_name(config.inipath, value)
        return Setting(value, f"{config.inipath}: {self.name}", "ini file")

    def of(self, item: pytest.Item) -> Setting:
        """The value for an item, unchecked: its indirect parameter, else that of the session."""
        parameter = self._parameter(item)
        if parameter is None:
            return self.of_session(item.config)
        name = parameter if isinstance(parameter, str) else str(parameter)  # a FiledName stays one
        return Setting(name, f"parameter {self.name} of {item.nodeid}", "parameter")

    def of_fixture(self, request: pytest.FixtureRequest) -> Setting:
        """The value for a fixture: its parameter, else that of the session. A wrong value fails the test."""
        setting, parameter = self.of(request.node), self._parameter(request.node)
        complaint = self.complaint(setting.value)
        if parameter is not None and not isinstance(parameter, str | os.PathLike):
            complaint = f"must be a text or a path, not {parameter!r}"
        if complaint:
            pytest.fail(f"{setting.by}: {complaint}", pytrace=False)
        return setting

    def _parameter(self, item: pytest.Item) -> object:
        callspec = getattr(item, "callspec", None)
        return None if callspec is None else callspec.params.get(self.name)


def _place_complaint(value: str) -> str:
    """Reason why a folder cannot be made; empty if it can."""
    path = Path(value)
    there = next((each for each in (path, *path.parents) if each.exists()), path)
    return "" if there.is_dir() else f"{there} is no folder"


def _seconds(value: str) -> float | None:
    """Time limit in seconds; None if the value cannot be one."""
    try:
        seconds = float(value)
    except ValueError:
        return None
    return seconds if 1e-3 <= seconds <= 1e9 else None


RIG = Option("hil_rig", "ANALOGRIG_RIG", "emulator", "rig: a shipped name, a .toml file, recording:FILE")
DUT = Option(
    "hil_dut",
    "ANALOGRIG_DUT",
    "host",
    "device under test: host, inproc[:LIBRARY], qemu-m4[:ELF], serial:URL, can:..., a .toml file",
)
SCENARIO_DIR = Option(
    "hil_scenario_dir",
    "",
    "",
    "folder of scenario files; each of them is a test",
    lambda value: "" if not value or Path(value).is_dir() else f"{value} is no folder",
)
RUNS_DIR = Option(
    "hil_runs_dir", "ANALOGRIG_RUNS_DIR", "build/runs", "folder for recordings of failed tests", _place_complaint
)
HIL_PROFILE = Option(
    "hil_profile",
    "ANALOGRIG_HIL_PROFILE",
    "ci",
    f"number of examples per property: {', '.join(f'{name} ({n})' for name, n in EXAMPLES.items())}",
    lambda value: "" if value in EXAMPLES else f"must be one of {', '.join(EXAMPLES)}, not {value!r}",
)
TIME_LIMIT = Option(
    "hil_time_limit",
    "ANALOGRIG_TIME_LIMIT",
    "",
    "longest time of one play in seconds; a play that takes longer is INCONCLUSIVE",
    lambda value: f"must be seconds from 0.001 to 1e9, not {value!r}" if value and _seconds(value) is None else "",
)

OPTIONS = (RIG, DUT, SCENARIO_DIR, RUNS_DIR, HIL_PROFILE, TIME_LIMIT)


def time_limit_s(config: pytest.Config) -> float | None:
    """Longest time of one play; None: there is no limit."""
    return _seconds(TIME_LIMIT.of_session(config).value)


def add_options(parser: pytest.Parser) -> None:
    group = parser.getgroup("analogrig", "hardware in the loop (analogrig)")
    for option in OPTIONS:
        also = f"also {option.variable}, ini {option.name}" if option.variable else f"also ini {option.name}"
        text = f"{option.help} ({also}; default: {option.default or 'none'})"
        group.addoption(option.flag, metavar=option.name.rpartition("_")[2].upper(), help=text)
        parser.addini(option.name, option.help, default="")
    group.addoption(
        ALLOW,
        action="append",
        default=[],
        metavar="THING",
        help="library, firmware, command, Python module, serial port, CAN bus or HOST:PORT that a file may name"
        " (repeatable; not from the ini file; in conftest.py: config.option.hil_allow)",
    )


def check_command_line(config: pytest.Config) -> None:
    """:raises pytest.UsageError: a value on the command line is empty or wrong."""
    for option in OPTIONS:
        setting = option.of_session(config)
        if setting.source != "command line":
            continue
        if complaint := option.complaint(setting.value) if setting.value else "is empty":
            raise pytest.UsageError(f"{setting.by}: {complaint}")


def check_allow(config: pytest.Config, values: Sequence[str]) -> None:
    """Refuse values of --hil-allow that nobody typed, before conftest.py may add its own.

    :raises pytest.UsageError: the ini file allows something.
    """
    if not all(_is_on_command_line(config, ALLOW, value) for value in values):
        raise pytest.UsageError(f"{config.inipath}: addopts: {ALLOW} is for the command line or conftest.py")


def trust_of(config: pytest.Config) -> Trust:
    """Things that a file may name in this session: the command line, the environment or conftest.py allows them."""
    from analogrig.devices.registry import named_things
    from analogrig.trust import Trust, file_of

    trust, dut = Trust(config.getoption(ALLOW), option=ALLOW), DUT.of_session(config)
    return trust.also(named_things(dut.value)) if dut.is_explicit and not file_of(dut.value) else trust


def _is_on_command_line(config: pytest.Config, flag: str, value: str) -> bool:
    """True if the command line or PYTEST_ADDOPTS holds the flag with this value, also in a file named by @FILE."""
    in_worker = getattr(config, "workerinput", {}).get("mainargv")  # of pytest-xdist: the words of its main process
    words = [str(word) for word in (in_worker or config.invocation_params.args)]
    words += shlex.split(os.environ.get("PYTEST_ADDOPTS", ""))
    words = [each for word in words for each in (_lines_of(word[1:]) if word.startswith("@") else [word])]
    return f"{flag}={value}" in words or (flag, value) in itertools.pairwise(words)


def _lines_of(file: str) -> list[str]:
    try:
        return Path(file).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []


sessions: list[pytest.Config] = []
"""Running pytest sessions: one may run another in its process. hypothesis fixes the settings of a test where the test
is defined, before any fixture exists."""


def current_profile() -> str:
    """Name of the profile in force: that of the pytest session, else of the environment, else the default.

    :raises pytest.Collector.CollectError: the value is wrong; the test file that asks is not collected.
    """
    if not sessions:
        return os.environ.get(HIL_PROFILE.variable) or HIL_PROFILE.default
    setting = HIL_PROFILE.of_session(sessions[-1])
    if complaint := HIL_PROFILE.complaint(setting.value):
        raise pytest.Collector.CollectError(f"{setting.by}: {complaint}")
    return setting.value
