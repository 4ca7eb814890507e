"""The option --hil-allow: what a file may name. The command line and conftest.py give it, the ini file does not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from analogrig.trust import Trust

FLAG = "--hil-allow"


def add(group: pytest.OptionGroup) -> None:
    group.addoption(
        FLAG,
        action="append",
        default=[],
        metavar="THING",
        help="library, firmware, command, serial port, CAN bus or HOST:PORT that a file may name (repeatable; not from"
        " the ini file; in conftest.py: config.option.hil_allow)",
    )


def check(config: pytest.Config) -> None:
    """:raises pytest.UsageError: the ini file allows something."""
    if any(word.partition("=")[0] == FLAG for word in _addopts(config)):
        raise pytest.UsageError(f"{config.inipath}: addopts: {FLAG} is for the command line or conftest.py")


def trust_of(config: pytest.Config, dut: str | None) -> Trust:
    """Things that the command line, the environment or conftest.py allows.

    :param dut: device that the command line or the environment names.
    """
    from analogrig.devices.registry import named_things
    from analogrig.trust import Trust, file_of

    trust = Trust(config.getoption(FLAG), option=FLAG)
    return trust if not dut or file_of(dut) else trust.also(named_things(dut))


def from_command_line(config: pytest.Config, flag: str, value: str) -> str:
    """The value of an option; one that the ini file's addopts give is the file's."""
    words = _addopts(config)
    if value not in words and f"{flag}={value}" not in words:
        return value
    from analogrig.trust import FiledName

    return FiledName(value, str(config.inipath))


def from_ini(config: pytest.Config, value: str, *, is_name: bool) -> str:
    """The value of an ini option; the name of a rig or a device counts as one that a file holds."""
    if not value or not is_name or config.inipath is None:
        return value
    from analogrig.trust import beside

    return beside(config.inipath, value)


def _addopts(config: pytest.Config) -> list[str]:
    return list(map(str, config.getini("addopts")))
