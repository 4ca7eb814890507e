"""Help of every command: its examples are commands that work."""

from __future__ import annotations

import argparse
import re
import shlex
from pathlib import Path

import pytest

from analogrig.cli import main
from analogrig.cli.command_line import _COMMANDS, make_parser
from analogrig.entry_points import COMMANDS, of_group
from analogrig_imports.column_reader import FORMATS

QUICK = {
    "list",
    "list rigs",
    "list devices --json",
    "completion bash >> ~/.bashrc",
    "include",
    "netlist --program two-mass --seed 7",
}
"""Examples that are run; the README's commands run in tests/test_readme_commands.py."""


def commands() -> dict[str, argparse.ArgumentParser]:
    (choices,) = [each.choices for each in make_parser()._actions if isinstance(each, argparse._SubParsersAction)]
    return dict(choices)


def examples(command: argparse.ArgumentParser) -> list[str]:
    lines = (command.epilog or "").splitlines()
    return [line.strip().removeprefix("analogrig ") for line in lines if line.startswith("  analogrig ")]


EXAMPLES = [example for command in commands().values() for example in examples(command)]


def test_every_module_adds_its_command() -> None:
    assert len(commands()) == len(_COMMANDS) + len(of_group(COMMANDS))


@pytest.mark.parametrize("name", commands())
def test_every_command_has_examples_and_a_description(name: str) -> None:
    command = commands()[name]
    takes_arguments = any(action.dest != "help" for action in command._actions)
    assert 1 + takes_arguments <= len(examples(command)) <= 4
    assert all(example.split()[0] == name for example in examples(command))
    assert command.description is not None and command.description.endswith(".")


def without_redirection(example: str) -> list[str]:
    words = shlex.split(example)
    return words[: next((i for i, word in enumerate(words) if word.startswith(">")), len(words))]


@pytest.mark.parametrize("example", [*EXAMPLES, *examples(make_parser())])
def test_every_example_is_understood(example: str) -> None:
    if example.endswith("--help"):
        with pytest.raises(SystemExit, match="0"):
            make_parser().parse_args(without_redirection(example))
        return
    assert callable(make_parser().parse_args(without_redirection(example)).command)


@pytest.mark.parametrize("example", sorted(QUICK))
def test_quick_example_runs(example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert example in EXAMPLES
    monkeypatch.chdir(tmp_path)
    assert main(without_redirection(example)) == 0


@pytest.mark.parametrize("name", commands())
def test_every_option_of_a_command_has_a_help_text_of_one_phrase(name: str) -> None:
    for action in commands()[name]._actions:
        assert action.help, action.option_strings
        assert not action.help.startswith(("of ", "what ", "which ", "how ", "whether ", "who ")), action.help
        assert not action.help.endswith("."), action.help


def test_device_is_explained_by_the_list_of_all_kinds() -> None:
    (dut,) = (action for action in commands()["run"]._actions if action.dest == "dut")
    assert "`analogrig list devices` shows the kinds" in str(dut.help)


def test_import_names_every_format_that_it_reads() -> None:
    """The help is written out, as the table of formats is in a module that loads numpy."""
    command = commands()["import"]
    (file,) = (action for action in command._actions if action.dest == "file")
    assert re.findall(r"\.\w+", str(file.help)) == list(FORMATS)
    assert all(name in str(command.description) for name, _ in FORMATS.values())


def test_examples_are_shown_as_written(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["run", "--help"])
    assert "\nexamples:\n  analogrig run --seed 7\n" in capsys.readouterr().out
