"""Kinds of rigs, devices and instruments by name: ours, and those of other installed packages."""

from __future__ import annotations

import functools
import pkgutil
from collections.abc import Iterator, Mapping
from typing import Generic, TypeVar

from analogrig.entry_points import EntryPoint, of_group
from analogrig.errors import ConfigurationError

__all__ = ["Kinds"]
"""Names for packages beside the core."""

T = TypeVar("T")


class Kinds(Mapping[str, type[T]], Generic[T]):
    """Subclasses of ``base`` by kind, each imported when it is asked for.

    A package adds kinds as entry points of ``group``. It cannot replace one of ours. Whoever installs the package
    trusts it: a file may then name the kind.
    """

    def __init__(self, base: type[T], group: str, own: Mapping[str, str] | None = None) -> None:
        """``own`` are our kinds as ``module:class``."""
        self._base = base
        self._group = group
        self._own = own or {}

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
        """Kinds that packages add."""
        return tuple(self._added)

    @property
    def ignored(self) -> Mapping[str, str]:
        """Kinds that packages add in vain, with the reason."""
        return {
            point.name: f"ignored: {point} cannot replace a kind that there is"
            for point in self._points
            if point.name in self._own or self._added[point.name] is not point
        }

    @functools.cached_property
    def _points(self) -> list[EntryPoint]:
        return of_group(self._group)

    @functools.cached_property
    def _added(self) -> Mapping[str, EntryPoint]:
        """Entry points by kind; the first of each is used."""
        return {point.name: point for point in reversed(self._points) if point.name not in self._own}

    def _load(self, point: EntryPoint) -> type[T]:
        loaded = point.load("kind")
        where = f"kind {point.name!r}: {point}"
        if not (isinstance(loaded, type) and issubclass(loaded, self._base)):
            raise ConfigurationError(f"{where} is no subclass of {self._base.__name__}")
        if (kind := getattr(loaded, "kind", point.name)) != point.name:
            raise ConfigurationError(f"{where} states the kind {kind!r}")
        for name, hint in self._base.__annotations__.items():
            if str(hint).startswith("ClassVar") and not hasattr(loaded, name):
                raise ConfigurationError(f"{where} has no {name}")
        return loaded
