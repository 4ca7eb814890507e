"""Public names of a package, each loaded on first use."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping

__all__ = ["loader"]
"""Names for packages beside the core."""


def loader(package: str, modules: Mapping[str, str]) -> Callable[[str], object]:
    """Function for ``__getattr__`` of a package.

    :param modules: names that each module provides, separated by spaces.
    """

    def load(name: str) -> object:
        module = next((module for module, names in modules.items() if name in names.split()), None)
        if module is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}; public names: {package}.__all__")
        found: object = getattr(importlib.import_module(module), name)
        setattr(sys.modules[package], name, found)
        return found

    return load
