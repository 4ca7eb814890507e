"""Entry points of installed packages: commands, rigs, devices and instruments that they add.

One scan serves all groups. It reads the files itself: ``importlib.metadata`` takes 0.1 s, as long as ``--help`` may.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import operator
import os
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from analogrig.errors import ConfigurationError
from analogrig.wording import error_text

__all__ = ["INSTRUMENTS"]
"""Names for packages beside the core."""

COMMANDS, DEVICES, INSTRUMENTS, RIGS = (
    f"analogrig.{group}" for group in ("commands", "devices", "instruments", "rigs")
)
"""Groups of entry points."""

OURS = "analogrig"
"""Name of this distribution, as folders of metadata spell it."""

_LINE = re.compile(r"([^\s=:\[#;][^=:]*?)\s*[=:]\s*([\w.]+:[\w.]+)")
"""Line ``name = module:attribute``."""


class EntryPoint(NamedTuple):
    """One name that a package adds to a group."""

    name: str
    group: str
    value: str
    """``module:attribute``."""
    distribution: str

    @property
    def package(self) -> str:
        """Top-level package of the module."""
        return self.value.partition(":")[0].partition(".")[0]

    def __str__(self) -> str:
        return f"the package {self.distribution} ({self.group}: {self.value})"

    def load(self, what: str) -> object:
        """Import the object.

        :param what: "command" or "kind", for the message.
        :raises ConfigurationError: it cannot be imported.
        """
        try:
            module, _, name = self.value.partition(":")
            return operator.attrgetter(name)(importlib.import_module(module))
        except (Exception, SystemExit) as error:  # foreign code raises what it likes
            raise ConfigurationError(f"{what} {self.name!r}: {self} cannot be imported: {error_text(error)}") from error


def of_group(group: str) -> list[EntryPoint]:
    """Entry points of a group, sorted by name; those of this distribution come first among equals."""
    points = (point for point in _scan(tuple(sys.path)) if point.group == group)
    return sorted(points, key=lambda point: (point.name, point.distribution != OURS, point.value))


def package_of(modules: Iterable[str]) -> str:
    """Another package that adds something from one of these modules, for messages; empty if there is none."""
    packages = {module.partition(".")[0] for module in modules}
    found = (str(p) for p in _scan(tuple(sys.path)) if p.distribution != OURS and p.package in packages)
    return next(found, "")


@functools.lru_cache(maxsize=1)
def _scan(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """All entry points whose group begins with ``analogrig.``; the first of two copies of a distribution is read."""
    distributions: dict[str, tuple[str, Path]] = {}
    for folder in path:
        with contextlib.suppress(OSError), os.scandir(folder or ".") as entries:
            for entry in entries:
                name, _, kind = entry.name.rpartition(".")
                if kind in ("dist-info", "egg-info"):
                    name = name.partition("-")[0]
                    key = re.sub(r"[-_.]+", "-", name).lower()
                    distributions.setdefault(key, (name, Path(entry.path, "entry_points.txt")))
    points: list[EntryPoint] = []
    for distribution, file in distributions.values():
        with contextlib.suppress(OSError, UnicodeDecodeError):
            text = file.read_text(encoding="utf-8")
            if f"[{OURS}." in text:
                points += _read(text.splitlines(), distribution)
    return tuple(points)


def _read(lines: Iterable[str], distribution: str) -> Iterator[EntryPoint]:
    group = ""
    for line in map(str.strip, lines):
        if line.startswith("["):
            group = line.strip("[] ")
        elif group.startswith(f"{OURS}.") and (found := _LINE.match(line)):
            yield EntryPoint(found[1], group, found[2], distribution)
