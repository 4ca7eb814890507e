"""The option --hil-allow: what a file may name. The command line and conftest.py give it, the ini file does not."""

from __future__ import annotations

import itertools
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
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


def check(config: pytest.Config, given: Sequence[str]) -> None:
    """Refuse values of --hil-allow that nobody typed, before conftest.py may add its own.

    :raises pytest.UsageError: the ini file allows something.
    """
    untyped = [value for value in given if not _is_typed(config, FLAG, value)]
    if untyped:
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
    """The value of an option; one that nobody typed is the ini file's, whatever way addopts gave it."""
    if _is_typed(config, flag, value):
        return value
    from analogrig.trust import FiledName

    return FiledName(value, str(config.inipath))


def from_ini(config: pytest.Config, value: str, *, is_name: bool) -> str:
    """The value of an ini option; the name of a rig or a device counts as one that a file holds."""
    if not value or not is_name or config.inipath is None:
        return value
    from analogrig.trust import beside

    return beside(config.inipath, value)


def _is_typed(config: pytest.Config, flag: str, value: str) -> bool:
    """True if the command line or PYTEST_ADDOPTS holds the flag with this value, also in a file named by @FILE."""
    words = _typed_words(config)
    return f"{flag}={value}" in words or (flag, value) in itertools.pairwise(words)


def _typed_words(config: pytest.Config) -> list[str]:
    in_worker = getattr(config, "workerinput", {}).get("mainargv")  # of pytest-xdist: the words of its main process
    words = [str(word) for word in (in_worker or config.invocation_params.args)]
    words += shlex.split(os.environ.get("PYTEST_ADDOPTS", ""))
    return [each for word in words for each in (_lines_of(word[1:]) if word.startswith("@") else [word])]


def _lines_of(file: str) -> list[str]:
    try:
        return Path(file).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []
