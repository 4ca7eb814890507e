"""``analogrig list``, ``completion`` and ``include``: names and places, for people, shells and compilers."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

from analogrig.cli.options import CAMPAIGN, DUT, PROGRAM, RIG, SCENARIO, add_command, add_json
from analogrig.cli.terminal import PASSED, show, show_json, show_plain

KINDS = ("scenarios", "rigs", "devices", "campaigns", "programs")
SHELLS = ("bash", "zsh", "fish")

COMPLETION_VARIABLE = "_ARGCOMPLETE"
"""Set by the shell when it asks for completions instead of running the command."""

INCLUDE = Path(__file__).parents[1] / "include"
"""Folder of the headers that the package brings."""

_KIND_OF_METAVAR = {SCENARIO: "scenarios", RIG: "rigs", DUT: "devices", CAMPAIGN: "campaigns", PROGRAM: "programs"}

_PLACEHOLDER = re.compile(r"\[|[A-Z]+")
"""Beginning of what a user fills in, in the usage of a kind of device."""

_RST_MARK = re.compile(r"(?::\w+:)?`{1,2}([^`]+)`{1,2}")
"""Literal or role in a docstring."""


def add_list(commands: Any) -> None:
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
    command.set_defaults(command=_list)


def add_completion(commands: Any) -> None:
    command = add_command(
        commands,
        "completion",
        "print the script that lets a shell complete analogrig's commands, options and names",
        "completion bash >> ~/.bashrc",
        "completion zsh >> ~/.zshrc",
        "completion fish > ~/.config/fish/completions/analogrig.fish",
    )
    command.add_argument("shell", choices=SHELLS, help="shell that reads the script")
    command.set_defaults(command=_completion)


def add_include(commands: Any) -> None:
    command = add_command(
        commands,
        "include",
        "print the folder of analogrig_estimator.h, the C header for an estimator of your own",
        "include",
    )
    command.set_defaults(command=_include)


def _list(arguments: argparse.Namespace) -> int:
    found = {kind: _entries(kind) for kind in ([arguments.kind] if arguments.kind else KINDS)}
    if arguments.json:
        show_json(found)
    else:
        show("\n\n".join(_text(kind, entries) for kind, entries in found.items()))
    return PASSED


def _text(kind: str, entries: list[dict[str, str]]) -> str:
    width = max(len(each["name"]) for each in entries)
    return "\n".join([f"{kind}:", *(f"  {each['name']:{width}}  {each['description']}".rstrip() for each in entries)])


def _entries(kind: str) -> list[dict[str, str]]:
    """Name, description and file of each; file is "" where there is none.

    :raises ConfigurationError: a file cannot be read.
    """
    from analogrig import config

    found: dict[str, dict[str, str]] = {}
    if kind == "rigs":
        from analogrig.rigs.description import own_rigs

        file, rigs = own_rigs()
        found = {name: _entry(name, table.get("description", ""), file) for name, table in rigs.items()}
    shipped = cast("config.Kind", kind)
    for path in (config.locate(shipped, name) for name in config.names(shipped)):
        found.setdefault(path.stem, _entry(path.stem, config.read_toml(path).get("description", ""), str(path)))
    return [*found.values(), *_kinds(kind)]


def _kinds(of: str) -> Iterator[dict[str, str]]:
    """Kinds of devices, and added kinds of rigs that need no key; a broken one with its error."""
    from analogrig.devices.registry import KINDS as DEVICE_KINDS
    from analogrig.errors import ConfigurationError
    from analogrig.rigs.description import KINDS as RIG_KINDS

    if of not in ("devices", "rigs"):
        return
    kinds, names = (DEVICE_KINDS, [*DEVICE_KINDS]) if of == "devices" else (RIG_KINDS, RIG_KINDS.added)
    for name in names:
        try:
            described = kinds[name]
        except ConfigurationError as error:
            yield _entry(name, error)
            continue
        if of == "rigs" and not _opens_with_defaults(name):
            continue
        summary = getattr(described, "summary", "") or (described.__doc__ or "").partition("\n")[0]
        yield _entry(getattr(described, "usage", name), _RST_MARK.sub(r"`\1`", summary))
    for name, reason in kinds.ignored.items():
        yield _entry(name, reason)


def _opens_with_defaults(kind: str) -> bool:
    """True if the name of a kind of rig alone describes a rig: no key is required."""
    from analogrig.errors import ConfigurationError
    from analogrig.rigs.description import from_table

    try:
        from_table({"kind": kind, "name": kind}, kind)
    except ConfigurationError:
        return False
    return True


def _entry(name: str, description: Any, file: str = "") -> dict[str, str]:
    return {"name": _one_line(name), "description": _one_line(str(description)), "file": file}


def _one_line(text: str) -> str:
    """Text of a file, which may hold control characters, in one line."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())


def _completion(arguments: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    show_plain(shellcode(["analogrig"], shell=arguments.shell).strip("\n"))
    return PASSED


def _include(_: argparse.Namespace) -> int:
    show_plain(str(INCLUDE))
    return PASSED


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell, and end the process."""
    import argcomplete

    argcomplete.autocomplete(parser, default_completer=cast(Any, _names_and_files))


def _names_and_files(prefix: str, action: argparse.Action, **_: Any) -> Iterator[str]:
    """Completions: the names that an option takes, and files, which stand for any of them."""
    from argcomplete.completers import FilesCompleter

    if kind := _KIND_OF_METAVAR.get(str(action.metavar)):
        entries = _entries(kind)
        names = [each["name"] if each["file"] else _PLACEHOLDER.split(each["name"])[0] for each in entries]
        yield from (name for name in dict.fromkeys(names) if name.startswith(prefix))
    yield from FilesCompleter()(prefix)
