"""The options of the plugin, each under one name everywhere, and where a value of one came from."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from analogrig.testing.plugin import trusting

if TYPE_CHECKING:
    from analogrig.trust import Trust

PROFILES = ("ci", "nightly", "soak")


@dataclass(frozen=True)
class Said:
    """The value of an option, and who said it: the start of every complaint about it."""

    value: str
    by: str


def _anything(_: str) -> str:
    return ""


@dataclass(frozen=True)
class Option:
    """One setting of the plugin."""

    name: str
    variable: str
    """Environment variable; the command line ``analogrig`` reads those of rig and device too."""
    default: str
    help: str
    complaint: Callable[[str], str] = _anything
    """What is wrong with a value; empty: nothing that can be told beforehand."""

    @property
    def ini(self) -> str:
        return self.name

    @property
    def flag(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    def given(self, config: pytest.Config) -> Said | None:
        """By the command line, or the environment."""
        on_command_line = config.getoption(self.flag)
        if on_command_line is not None and not str(on_command_line):
            raise pytest.UsageError(f"{self.flag}: is empty")
        if on_command_line is not None:
            return Said(trusting.from_command_line(config, self.flag, str(on_command_line)), self.flag)
        in_environment = os.environ.get(self.variable)
        return Said(in_environment, self.variable) if in_environment else None

    def otherwise(self, config: pytest.Config) -> Said:
        """By the ini file, or nobody."""
        in_file = trusting.from_ini(config, str(config.getini(self.ini)), is_name=self in (RIG, DUT))
        return Said(in_file, f"{config.inipath}: {self.ini}") if in_file else Said(self.default, self.flag)

    def said(self, config: pytest.Config) -> Said:
        """Checked.

        :raises pytest.UsageError: it cannot be that.
        """
        said = self.given(config) or self.otherwise(config)
        if complaint := self.complaint(said.value):
            raise pytest.UsageError(f"{said.by}: {complaint}")
        return said

    def asked(self, request: pytest.FixtureRequest) -> Said:
        """As ``said``, for a fixture, whose parameter comes first. What is wrong with that fails the test."""
        parameter = getattr(request, "param", None)
        if parameter is None:
            return self.said(request.config)
        said = Said(str(parameter), f"parameter {self.name} of {request.node.nodeid}")
        complaint = self.complaint(said.value)
        if not isinstance(parameter, str | os.PathLike):
            complaint = f"must be a text or a path, not {parameter!r}"
        if complaint:
            pytest.fail(f"{said.by}: {complaint}", pytrace=False)
        return said

    def of(self, item: pytest.Item) -> str:
        """As ``asked``, before or beside the fixture, and unchecked."""
        callspec = getattr(item, "callspec", None)
        parameter = callspec.params.get(self.name) if callspec is not None else None
        if isinstance(parameter, str | os.PathLike):
            return str(parameter)
        return (self.given(item.config) or self.otherwise(item.config)).value


def _no_folder(value: str) -> str:
    return "" if not value or Path(value).is_dir() else f"{value} is no folder"


def _not_to_be_a_folder(value: str) -> str:
    path = Path(value)
    there = next((each for each in (path, *path.parents) if each.exists()), path)
    return "" if there.is_dir() else f"{there} is no folder"


def _no_profile(value: str) -> str:
    return "" if value in PROFILES else f"must be one of {', '.join(PROFILES)}, not {value!r}"


def _seconds(value: str) -> float | None:
    """A time limit; None: it cannot be one."""
    try:
        seconds = float(value)
    except ValueError:
        return None
    return seconds if 1e-3 <= seconds <= 1e9 else None


def _no_seconds(value: str) -> str:
    return f"must be seconds from 0.001 to 1e9, not {value!r}" if value and _seconds(value) is None else ""


RIG = Option(
    "hil_rig", "ANALOGRIG_RIG", "emulator", "what plays the scenarios: a shipped name, a .toml file, recording:FILE"
)
DUT = Option(
    "hil_dut",
    "ANALOGRIG_DUT",
    "host",
    "the device under test: host, inproc[:LIBRARY], qemu-m4[:ELF], serial:URL, can:..., a .toml",
)
SCENARIO_DIR = Option(
    "hil_scenario_dir", "ANALOGRIG_SCENARIO_DIR", "", "a folder of scenario files, each of which is a test", _no_folder
)
RUNS_DIR = Option(
    "hil_runs_dir",
    "ANALOGRIG_RUNS_DIR",
    "build/runs",
    "where the recordings of tests that fail go",
    _not_to_be_a_folder,
)
HIL_PROFILE = Option(
    "hil_profile", "ANALOGRIG_HIL_PROFILE", "ci", f"how much the properties try: {', '.join(PROFILES)}", _no_profile
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
        told = f"{option.help} (also {option.variable}, ini {option.ini}; default: {option.default or 'none'})"
        group.addoption(option.flag, metavar=option.name.rpartition("_")[2].upper(), help=told)
        parser.addini(option.ini, option.help, default="")
    trusting.add(group)


def check(config: pytest.Config) -> None:
    """:raises pytest.UsageError: an option cannot be what it is."""
    trusting.check(config)
    for option in OPTIONS:
        option.said(config)


def trust_of(config: pytest.Config) -> Trust:
    """Things that a file may name in this session."""
    given = DUT.given(config)
    return trusting.trust_of(config, given.value if given else None)
