"""Kinds of rigs and devices by name: ours, and those of other installed packages."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import pkgutil
from collections.abc import Iterable, Iterator, Mapping
from typing import Generic, TypeVar

from analogrig.errors import ConfigurationError
from analogrig.wording import error_text

T = TypeVar("T")


class Kinds(Mapping[str, type[T]], Generic[T]):
    """Subclasses of ``base`` by kind, each imported when it is asked for.

    A package adds kinds as entry points of ``group``. It cannot replace one of ours. Whoever installs the package
    trusts it: a file may then name the kind.
    """

    def __init__(self, base: type[T], group: str, own: Mapping[str, str]) -> None:
        """``own`` are our kinds as ``module:class``."""
        self._base = base
        self._group = group
        self._own = own

    def __getitem__(self, kind: str) -> type[T]:
        """Class of a kind.

        :raises KeyError: there is none.
        :raises ConfigurationError: the package that adds the kind cannot be imported, or names no subclass.
        """
        if kind in self._own:
            own: type[T] = pkgutil.resolve_name(self._own[kind])
            return own
        return self._load(self._added[kind])

    def __contains__(self, kind: object) -> bool:
        return kind in self._own or kind in self._added

    def __iter__(self) -> Iterator[str]:
        return iter((*self._own, *self._added))

    def __len__(self) -> int:
        return len(self._own) + len(self._added)

    @property
    def added(self) -> tuple[str, ...]:
        """Kinds that other packages add."""
        return tuple(self._added)

    @property
    def ignored(self) -> Mapping[str, str]:
        """Kinds that other packages add in vain, with the reason."""
        return {
            point.name: f"ignored: {self._package(point)} cannot replace a kind that there is"
            for point in self._points
            if point.name in self._own or self._added[point.name] is not point
        }

    def package_of(self, modules: Iterable[str]) -> str:
        """Package that adds kinds from one of these modules; empty if there is none."""
        packages = {module.partition(".")[0] for module in modules}
        found = (point for point in self._points if point.module.partition(".")[0] in packages)
        return next(map(self._package, found), "")

    @functools.cached_property
    def _points(self) -> tuple[importlib.metadata.EntryPoint, ...]:
        """Entry points of other packages in a fixed order."""
        return tuple(sorted(_entry_points(self._group), key=lambda point: (point.name, point.value)))

    @functools.cached_property
    def _added(self) -> Mapping[str, importlib.metadata.EntryPoint]:
        """Entry points of other packages by kind; the first of each is used."""
        return {point.name: point for point in reversed(self._points) if point.name not in self._own}

    def _package(self, point: importlib.metadata.EntryPoint) -> str:
        return f"the package {point.dist.name if point.dist else point.module} ({self._group}: {point.value})"

    def _load(self, point: importlib.metadata.EntryPoint) -> type[T]:
        where = f"kind {point.name!r}: {self._package(point)}"
        try:
            loaded = point.load()
        except (Exception, SystemExit) as error:  # foreign code raises what it likes
            raise ConfigurationError(f"{where} cannot be imported: {error_text(error)}") from error
        if not (isinstance(loaded, type) and issubclass(loaded, self._base)):
            raise ConfigurationError(f"{where} is no subclass of {self._base.__name__}")
        if (kind := getattr(loaded, "kind", point.name)) != point.name:
            raise ConfigurationError(f"{where} states the kind {kind!r}")
        for name, hint in self._base.__annotations__.items():
            if str(hint).startswith("ClassVar") and not hasattr(loaded, name):
                raise ConfigurationError(f"{where} has no {name}")
        return loaded


def _entry_points(group: str) -> Iterable[importlib.metadata.EntryPoint]:
    """Entry points of all packages but those that state them wrongly."""
    with contextlib.suppress(Exception):
        return importlib.metadata.entry_points(group=group)
    found: list[importlib.metadata.EntryPoint] = []
    for package in importlib.metadata.distributions():
        with contextlib.suppress(Exception):
            found += package.entry_points.select(group=group)
    return found
