"""``analogrig new``: a repository that tests an estimator of one's own."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from analogrig.cli import PASSED, add_command, show

_TEMPLATES = Path(__file__).parent / "templates"
"""Folders of files. A name that begins with ``dot-`` is written with a dot."""

_FOLDERS = {
    "c": ("all", "estimator_c", "c"),
    "lines": ("all", "estimator_c", "lines"),
    "can": ("all", "estimator_py", "can"),
    "python": ("all", "estimator_py", "python"),
}
"""Template folders of each kind; no two of them hold the same file."""

_KEPT = {".git"}
"""Entries that the folder may have: a repository without files."""


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "new",
        "write a repository that works: an estimator of your own, its tests, a scenario and CI jobs",
        "new my_estimator",
        "new my_estimator --kind python",
    )
    command.add_argument("folder", type=Path, metavar="DIR", help="folder to write; must be absent or empty")
    command.add_argument(
        "--kind",
        choices=_FOLDERS,
        default="c",
        help="C library, firmware with lines of text, ECU on a CAN bus, or Python class (default: %(default)s)",
    )
    command.set_defaults(command=_new)


def _new(arguments: argparse.Namespace) -> int:
    folder = arguments.folder
    written = write_repository(folder, arguments.kind)
    show("\n".join([*(f"  {name}" for name in written), f"next: cd {shlex.quote(str(folder))} && make test"]))
    return PASSED


def write_repository(folder: Path, kind: str) -> list[str]:
    """Write the files of a kind into ``folder``; return their names in it.

    :raises ConfigurationError: the folder holds something, or cannot be written to.
    """
    from analogrig import ConfigurationError

    files = {_name(path.relative_to(_TEMPLATES / part)): path for part in _FOLDERS[kind] for path in _files(part)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if found := sorted(path.name for path in folder.iterdir() if path.name not in _KEPT):
            raise ConfigurationError(f"{folder}: holds {found[0]}: name a folder that is absent or empty")
        for name, path in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(path.read_bytes())
    except OSError as error:
        raise ConfigurationError(f"{folder}: cannot be written to: {error.strerror or error}") from error
    return sorted(files)


def _files(part: str) -> list[Path]:
    return [path for path in (_TEMPLATES / part).rglob("*") if path.is_file() and "__pycache__" not in path.parts]


def _name(path: Path) -> str:
    """Name of a template in the repository."""
    return "/".join(f".{part.removeprefix('dot-')}" if part.startswith("dot-") else part for part in path.parts)
