"""Kinds of rigs and devices by name: ours, and those of other installed packages."""

from __future__ import annotations

import functools
import importlib.metadata
import pkgutil
from collections.abc import Iterator, Mapping
from typing import Generic, TypeVar

from analogrig.errors import ConfigurationError

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

    @functools.cached_property
    def _added(self) -> Mapping[str, importlib.metadata.EntryPoint]:
        """Entry points of other packages by kind."""
        found = sorted(importlib.metadata.entry_points(group=self._group), key=lambda point: (point.name, point.value))
        return {point.name: point for point in reversed(found) if point.name not in self._own}

    def _load(self, point: importlib.metadata.EntryPoint) -> type[T]:
        package = f"the package {point.dist.name if point.dist else point.module} ({self._group}: {point.value})"
        try:
            loaded = point.load()
        except Exception as error:
            raise ConfigurationError(f"kind {point.name!r}: {package} cannot be imported: {error}") from error
        if not (isinstance(loaded, type) and issubclass(loaded, self._base)):
            raise ConfigurationError(f"kind {point.name!r}: {package} is no subclass of {self._base.__name__}")
        return loaded
