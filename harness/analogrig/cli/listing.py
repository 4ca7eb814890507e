"""``analogrig list``: the names that commands take, with a line on each."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING, Any, get_args

from analogrig.cli.options import PROGRAMS, add_command, add_json
from analogrig.cli.terminal import PASSED, show, show_json

if TYPE_CHECKING:
    from analogrig.config import Kind

KINDS = ("scenarios", "rigs", "devices", "campaigns", "programs")


_FILLED_IN = re.compile(r"\[|[A-Z]+")
"""Beginning of what a user fills in, in the usage of a kind of device."""


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "list",
        "list scenarios, rigs, devices, campaigns and programs, with a line on each",
        "list",
        "list rigs",
        "list devices --json",
    )
    command.add_argument("kind", nargs="?", choices=KINDS, help="kind to list (default: all)")
    add_json(command)
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    listed = {kind: entries(kind) for kind in ([arguments.kind] if arguments.kind else KINDS)}
    if arguments.json:
        show_json(listed)
    else:
        show("\n\n".join(_text(kind, found) for kind, found in listed.items()))
    return PASSED


def _text(kind: str, found: list[dict[str, str]]) -> str:
    width = max(len(each["name"]) for each in found)
    return "\n".join([f"{kind}:", *(f"  {each['name']:{width}}  {each['description']}".rstrip() for each in found)])


def entries(kind: str) -> list[dict[str, str]]:
    """Name, description and file of each; file is "" where there is none.

    :raises ConfigurationError: a file cannot be read.
    """
    if kind == "programs":
        return [_entry(name, does) for name, does in PROGRAMS.items()]
    own = _own_rigs() if kind == "rigs" else []
    taken = {each["name"] for each in own}
    shipped = [each for each in _shipped(kind) if each["name"] not in taken]
    return [*own, *shipped, *(_device_kinds() if kind == "devices" else ())]


def names(kind: str) -> list[str]:
    """Names for completion. Of a kind of device, the part before what a user fills in."""
    return list(
        dict.fromkeys(each["name"] if each["file"] else _FILLED_IN.split(each["name"])[0] for each in entries(kind))
    )


def _shipped(kind: str) -> list[dict[str, str]]:
    from analogrig import config

    shipped: Kind = next(each for each in get_args(config.Kind) if each == kind)
    paths = [config.locate(shipped, name) for name in config.names(shipped)]
    return [_entry(path.stem, config.read_toml(path).get("description", ""), str(path)) for path in paths]


def _own_rigs() -> list[dict[str, str]]:
    from analogrig.rigs.description import own_rigs

    file, rigs = own_rigs()
    return [_entry(name, table.get("description", ""), file) for name, table in rigs.items()]


def _device_kinds() -> list[dict[str, str]]:
    from analogrig.devices.registry import KINDS as DEVICE_KINDS

    return [_entry(kind.usage, kind.summary) for kind in DEVICE_KINDS.values()]


def _entry(name: str, description: Any, file: str = "") -> dict[str, str]:
    return {"name": _one_line(name), "description": _one_line(str(description)), "file": file}


def _one_line(text: str) -> str:
    """Text of a file, which may hold control characters, in one line."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())
