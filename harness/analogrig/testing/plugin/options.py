"""The options of the plugin, and the source of each value.

An option has one name: as a fixture, on the command line (``--hil-rig``) and in the ini file (``hil_rig``).
Only a wrong value on the command line ends a session. The environment and the ini file may serve other programs, or
other tests, than those that run: a wrong value there fails the tests that use it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import pytest

from analogrig.testing import profiles
from analogrig.testing.plugin import trusting

if TYPE_CHECKING:
    from analogrig.trust import Trust

Source = Literal["parameter", "command line", "environment", "ini file", "default"]


@dataclass(frozen=True)
class Said:
    """Value of an option and its source, which begins every error message about it."""

    value: str
    by: str
    source: Source


def _accept(_: str) -> str:
    return ""


@dataclass(frozen=True)
class Option:
    """One setting of the plugin."""

    name: str
    variable: str
    """Environment variable, empty for none; the command ``analogrig`` reads those of rig and device too."""
    default: str
    help: str
    complaint: Callable[[str], str] = _accept
    """Return the reason why a value is wrong; empty if none is known."""

    @property
    def ini(self) -> str:
        return self.name

    @property
    def flag(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    def given(self, config: pytest.Config) -> Said | None:
        """The value on the command line or in the environment; None without one."""
        return self._on_command_line(config) or self._in_environment()

    def otherwise(self, config: pytest.Config) -> Said:
        """The value in the ini file, else the default."""
        in_file = trusting.from_ini(config, str(config.getini(self.ini)), is_name=self in (RIG, DUT))
        if in_file:
            return Said(in_file, f"{config.inipath}: {self.ini}", "ini file")
        return Said(self.default, self.flag, "default")

    def said(self, config: pytest.Config) -> Said:
        """The value for the session, unchecked."""
        return self.given(config) or self.otherwise(config)

    def check_command_line(self, config: pytest.Config) -> None:
        """:raises pytest.UsageError: the value on the command line is empty or wrong."""
        said = self._on_command_line(config)
        if said is None:
            return
        complaint = self.complaint(said.value) if said.value else "is empty"
        if complaint:
            raise pytest.UsageError(f"{said.by}: {complaint}")

    def asked(self, request: pytest.FixtureRequest) -> Said:
        """The value for a fixture: its indirect parameter, else that of the session. A wrong value fails the test."""
        parameter = getattr(request, "param", None)
        if parameter is None:
            said = self.said(request.config)
        else:
            said = Said(str(parameter), f"parameter {self.name} of {request.node.nodeid}", "parameter")
        complaint = self.complaint(said.value)
        if parameter is not None and not isinstance(parameter, str | os.PathLike):
            complaint = f"must be a text or a path, not {parameter!r}"
        if complaint:
            pytest.fail(f"{said.by}: {complaint}", pytrace=False)
        return said

    def of(self, item: pytest.Item) -> str:
        """The value for an item, unchecked: its indirect parameter, else that of the session."""
        parameter = self._parameter(item)
        return self.said(item.config).value if parameter is None else parameter

    def is_named(self, item: pytest.Item) -> bool:
        """True if a parameter, the command line or the environment names the value for an item."""
        return self._parameter(item) is not None or self.given(item.config) is not None

    def _parameter(self, item: pytest.Item) -> str | None:
        callspec = getattr(item, "callspec", None)
        parameter = callspec.params.get(self.name) if callspec is not None else None
        return str(parameter) if isinstance(parameter, str | os.PathLike) else None

    def _on_command_line(self, config: pytest.Config) -> Said | None:
        value = config.getoption(self.flag)
        if value is None:
            return None
        return Said(trusting.from_command_line(config, self.flag, str(value)), self.flag, "command line")

    def _in_environment(self) -> Said | None:
        value = os.environ.get(self.variable) if self.variable else None
        return Said(value, self.variable, "environment") if value else None


def _no_folder(value: str) -> str:
    return "" if not value or Path(value).is_dir() else f"{value} is no folder"


def _not_to_be_a_folder(value: str) -> str:
    path = Path(value)
    there = next((each for each in (path, *path.parents) if each.exists()), path)
    return "" if there.is_dir() else f"{there} is no folder"


def _no_profile(value: str) -> str:
    return "" if value in profiles.EXAMPLES else f"must be one of {', '.join(profiles.EXAMPLES)}, not {value!r}"


def _seconds(value: str) -> float | None:
    """Time limit in seconds; None if the value cannot be one."""
    try:
        seconds = float(value)
    except ValueError:
        return None
    return seconds if 1e-3 <= seconds <= 1e9 else None


def _no_seconds(value: str) -> str:
    return f"must be seconds from 0.001 to 1e9, not {value!r}" if value and _seconds(value) is None else ""


RIG = Option("hil_rig", "ANALOGRIG_RIG", "emulator", "rig: a shipped name, a .toml file, recording:FILE")
DUT = Option(
    "hil_dut",
    "ANALOGRIG_DUT",
    "host",
    "device under test: host, inproc[:LIBRARY], qemu-m4[:ELF], serial:URL, can:..., a .toml file",
)
SCENARIO_DIR = Option("hil_scenario_dir", "", "", "folder of scenario files; each of them is a test", _no_folder)
RUNS_DIR = Option(
    "hil_runs_dir", "ANALOGRIG_RUNS_DIR", "build/runs", "folder for recordings of failed tests", _not_to_be_a_folder
)
HIL_PROFILE = Option(
    "hil_profile",
    profiles.VARIABLE,
    profiles.DEFAULT,
    f"number of examples per property: {', '.join(f'{name} ({n})' for name, n in profiles.EXAMPLES.items())}",
    _no_profile,
)

TIME_LIMIT = Option(
    "hil_time_limit",
    "ANALOGRIG_TIME_LIMIT",
    "",
    "longest time of one play in seconds; a play that takes longer is INCONCLUSIVE",
    _no_seconds,
)

OPTIONS = (RIG, DUT, SCENARIO_DIR, RUNS_DIR, HIL_PROFILE, TIME_LIMIT)


def time_limit_s(config: pytest.Config) -> float | None:
    """Longest time of one play; None: there is no limit."""
    return _seconds(TIME_LIMIT.said(config).value)


def add(parser: pytest.Parser) -> None:
    group = parser.getgroup("analogrig", "hardware in the loop (analogrig)")
    for option in OPTIONS:
        also = f"also {option.variable}, ini {option.ini}" if option.variable else f"also ini {option.ini}"
        told = f"{option.help} ({also}; default: {option.default or 'none'})"
        group.addoption(option.flag, metavar=option.name.rpartition("_")[2].upper(), help=told)
        parser.addini(option.ini, option.help, default="")
    trusting.add(group)


def check_command_line(config: pytest.Config) -> None:
    """:raises pytest.UsageError: a value on the command line is empty or wrong."""
    for option in OPTIONS:
        option.check_command_line(config)


def trust_of(config: pytest.Config) -> Trust:
    """Things that a file may name in this session."""
    given = DUT.given(config)
    return trusting.trust_of(config, given.value if given else None)
