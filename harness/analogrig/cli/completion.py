"""``analogrig completion``: completion of commands, options, names and files in a shell, by argcomplete."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any, cast

from analogrig.cli import listing
from analogrig.cli.options import CAMPAIGN, DUT, RIG, SCENARIO, add_command
from analogrig.cli.terminal import PASSED, show_plain

SHELLS = ("bash", "zsh", "fish")

VARIABLE = "_ARGCOMPLETE"
"""Set by the shell when it asks for completions instead of running the command."""

_KINDS = {SCENARIO: "scenarios", RIG: "rigs", DUT: "devices", CAMPAIGN: "campaigns"}


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "completion",
        "print the script that lets a shell complete analogrig's commands, options and names",
        "completion bash >> ~/.bashrc",
        "completion zsh >> ~/.zshrc",
        "completion fish > ~/.config/fish/completions/analogrig.fish",
    )
    command.add_argument("shell", choices=SHELLS, help="shell that reads the script")
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    show_plain(shellcode(["analogrig"], shell=arguments.shell).strip("\n"))
    return PASSED


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell, and end the process."""
    import argcomplete

    argcomplete.autocomplete(parser, default_completer=cast(Any, _names_and_files))


def _names_and_files(prefix: str, action: argparse.Action, **_: Any) -> Iterator[str]:
    """Complete the names that an option takes, and files, which stand for any of them."""
    from argcomplete.completers import FilesCompleter

    if kind := _KINDS.get(str(action.metavar)):
        yield from (name for name in listing.names(kind) if name.startswith(prefix))
    yield from FilesCompleter()(prefix)
