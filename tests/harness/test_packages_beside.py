"""The core imports no package beside it; those import only public names of the core and of each other."""

from __future__ import annotations

import ast
import functools
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest

HARNESS = Path(__file__).parents[2] / "harness"
CORE = "analogrig"
BESIDE = sorted(folder.name for folder in HARNESS.glob("analogrig_*") if folder.is_dir())


@functools.cache
def imports(package: str) -> list[tuple[str, str, str]]:
    """File, module and name of every import of a package; the name is empty for ``import module``."""
    return list(_imports(package))


def _imports(package: str) -> Iterator[tuple[str, str, str]]:
    for path in sorted((HARNESS / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Import | ast.ImportFrom):
                continue
            where = f"{path.relative_to(HARNESS)}:{node.lineno}"
            if isinstance(node, ast.Import):
                yield from ((where, alias.name, "") for alias in node.names)
            else:
                assert node.level == 0, where
                yield from ((where, str(node.module), alias.name) for alias in node.names)


def test_there_are_packages_beside_the_core() -> None:
    assert BESIDE == [
        "analogrig_circuits",
        "analogrig_ecu",
        "analogrig_imports",
        "analogrig_instruments",
        "analogrig_lines",
        "analogrig_live",
        "analogrig_lucidac",
        "analogrig_new",
        "analogrig_session",
        "analogrig_thesis",
    ]


def test_core_names_no_package_beside_it() -> None:
    """Not even in text: it finds them by entry points, as it finds those of other people."""
    found = [
        f"{path.relative_to(HARNESS)}: {package}"
        for path in sorted((HARNESS / CORE).rglob("*.py"))
        for package in BESIDE
        if package in path.read_text(encoding="utf-8")
    ]
    assert found == []


@pytest.mark.parametrize("package", BESIDE)
def test_package_imports_public_names_alone(package: str) -> None:
    private = [
        f"{where}: {module}.{name}"
        for where, module, name in imports(package)
        if module.partition(".")[0] in (CORE, *BESIDE) and module.partition(".")[0] != package
        if name not in getattr(importlib.import_module(module), "__all__", ())
    ]
    assert private == []


@pytest.mark.parametrize(
    "module", sorted({module for package in BESIDE for _, module, _ in imports(package) if module.startswith(CORE)})
)
def test_public_names_are_there(module: str) -> None:
    loaded = importlib.import_module(module)
    for name in getattr(loaded, "__all__", ()):
        assert getattr(loaded, name) is not None
