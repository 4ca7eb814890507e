"""Decide what a file may order: the one place for all commands, the pytest plugin and the Python API.

A description of a rig or a device states its *things*: the libraries, programs and addresses that opening it would
load, run or connect to. A thing is trusted if

* the command line, the environment or the calling code names it,
* ``--allow`` names it, or
* a file that analogrig ships names it.

Everything else that a file names is refused before anything is loaded, started, resolved or opened.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from analogrig import config
from analogrig.errors import ConfigurationError

__all__ = ["Thing", "absolute_path", "absolute_port"]
"""Names for packages beside the core."""

OPTION = "--allow"

MOST_NAME = 4096
"""Characters of a name: the longest path that Linux accepts."""

_MOST_SHOWN = 200


@dataclass(frozen=True)
class Thing:
    """Something outside analogrig that opening a rig or a device would load, run or connect to."""

    kind: Literal["library", "firmware", "command", "address", "serial port", "CAN bus", "Python module"]
    name: str
    """Value of ``--allow``: an absolute path, HOST:PORT, a URL, ``can:INTERFACE/CHANNEL``, a command without a path."""
    order: str
    """Effect, with subject and verb: ``the device loads the library``."""
    arguments: tuple[str, ...] = ()
    """Arguments of a command, for the message."""

    @property
    def is_path(self) -> bool:
        return self.kind in ("library", "firmware", "command", "serial port") and Path(self.name).is_absolute()

    def display_name(self) -> str:
        """Its name as a user would type it here."""
        if not self.is_path:
            return self.name
        relative = os.path.relpath(self.name)
        return self.name if relative.startswith("..") else f"./{relative}"

    def sentence(self) -> str:
        name = self.display_name()
        text = f"{self.order} {shlex.join((name, *self.arguments)) if self.arguments else name}"
        return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."


def absolute_path(path: str, folder: Path) -> str:
    """A path that a file in ``folder`` names, as an absolute one; an empty one stays empty."""
    return str(folder.absolute() / path) if path else ""


def absolute_port(url: str, folder: Path) -> str:
    """Serial port as an absolute path, like ``absolute_path``; a URL stays as it is."""
    return url if "://" in url else absolute_path(url, folder)


class FiledName(str):
    """A name of a device that a file holds; relative paths in it are relative to the file's folder."""

    __slots__ = ("file",)
    file: str

    def __new__(cls, name: str, file: str) -> Self:
        new = super().__new__(cls, name)
        new.file = file
        return new

    def __reduce__(self) -> tuple[type[FiledName], tuple[str, str]]:
        return FiledName, (str(self), self.file)


def resolve_name(file: Path, name: str) -> str:
    """The name of a rig, device or scenario that ``file`` holds, for use in the working directory.

    A relative path is relative to the folder of the file, also behind ``recording:`` and in FILE.toml:TABLE.
    """
    if name.startswith("recording:"):
        return f"recording:{file.parent / name.removeprefix('recording:')}"
    is_path = name.endswith(".toml") or name.rpartition(":")[0].endswith(".toml") or ("/" in name and ":" not in name)
    return FiledName(str(file.parent / name) if is_path else name, str(file))


def file_of(name: str) -> str:
    """The file that holds a name; empty for one of the command line, the environment or the code."""
    return name.file if isinstance(name, FiledName) else ""


def folder_of(name: str) -> Path:
    """The folder to which paths in a name are relative."""
    return Path(file_of(name)).parent if file_of(name) else Path()


class Trust:
    """Things that the user allows."""

    def __init__(self, allowed: Iterable[str] = (), *, option: str = "") -> None:
        """``option`` is how the user passes a name: ``--allow``; empty: as the argument ``allow`` of a function."""
        self._option = option
        self._names = frozenset((allowed,) if isinstance(allowed, str) else allowed)
        self._paths = frozenset(map(os.path.realpath, self._names))

    @classmethod
    def of(cls, allow: Trust | Iterable[str]) -> Trust:
        return allow if isinstance(allow, Trust) else cls(allow)

    def also(self, things: Iterable[Thing]) -> Trust:
        """Trust extended by things that the user names otherwise, as with ``--dut``."""
        return Trust((*self._names, *(thing.name for thing in things)), option=self._option)

    def check(self, things: Iterable[Thing], file: str, where: str = "") -> None:
        """Refuse what ``file`` names unless it is trusted; an empty ``file`` is the command line or the code.

        :param where: file and table, for the message; by default the file.
        :raises ConfigurationError: names the file, what it orders, and the option that allows it.
        """
        if not file or Path(file).resolve().is_relative_to(config.fixtures().resolve()):  # a shipped one
            return
        refused = [thing for thing in things if not self._allows(thing)]
        if not refused:
            return
        what = f"{where or file}: {' and '.join(thing.sentence() for thing in refused)}"
        names = [thing.display_name() for thing in refused]
        if all(name.isprintable() and len(name) <= MOST_NAME for name in names):
            raise ConfigurationError(f"{what}, which no file may order: pass {self._cure(names)}")
        raise ConfigurationError(f"{what}, which no file may order, and no option can name")

    def _allows(self, thing: Thing) -> bool:
        if not thing.name.isprintable() or len(thing.name) > MOST_NAME:
            return False
        return os.path.realpath(thing.name) in self._paths if thing.is_path else thing.name in self._names

    def _cure(self, names: list[str]) -> str:
        if not self._option:
            return f"allow={names!r}"
        return " ".join(f"{self._option} {shlex.quote(name)}" for name in names)
