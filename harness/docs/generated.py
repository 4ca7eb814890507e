"""Reference pages written from the code: commands, TOML keys, Python names, C interface, messages, errors."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import functools
import inspect
import itertools
import re
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import cantools

import analogrig
import analogrig_emulator
from analogrig import errors
from analogrig.campaigns.spec import CampaignSpec
from analogrig.cli import command_line
from analogrig.devices.registry import KINDS
from analogrig.estimator_config import EstimatorConfig
from analogrig.rigs.emulator import EmulatorDescription
from analogrig.scenario import Scenario
from analogrig_instruments.rig_wiring import RealDescription

ROOT = Path(__file__).parents[2]
CATALOGUE = ROOT / "estimator_c" / "catalogue" / "analogrig.dbc"
HEADER = ROOT / "estimator_c" / "core" / "est.h"
PACKAGES = (ROOT / "harness" / "analogrig", ROOT / "emulator" / "analogrig_emulator")

FILES: Mapping[str, tuple[str, type]] = {
    "scenario-files": ("Scenario files", Scenario),
    "emulated-rig-files": ("Emulated rig files", EmulatorDescription),
    "real-rig-files": ("Real rig files", RealDescription),
    "campaign-files": ("Campaign files", CampaignSpec),
}
"""Page name to title and to the dataclass that the TOML file fills."""

EXIT_STATUSES = (
    (0, "passed"),
    (1, "failed verdict"),
    (2, "usage or configuration"),
    (3, "inconclusive"),
    (130, "interrupted"),
)

OPTION = re.compile(r"(?<![\w`-])(--[a-z][a-z-]*)")

_CHOICES_MAX = 8


def write_reference(folder: Path) -> None:
    """Write every reference page into ``folder`` and remove others. Unchanged pages keep their time stamp."""
    pages: dict[str, Callable[[], Iterable[str]]] = {
        "commands": _commands,
        "python": functools.partial(_python, analogrig, "Python interface"),
        "emulator": functools.partial(_python, analogrig_emulator, "Python interface of the emulator"),
        "c": _c_interface,
        "messages": _messages,
        "errors": _errors,
        "device-files": _device_files,
        **{page: functools.partial(_file, *described) for page, described in FILES.items()},
    }
    folder.mkdir(exist_ok=True)
    for path in folder.glob("*.md"):
        if path.stem not in pages:  # written by another version
            path.unlink(missing_ok=True)
    for name, lines in pages.items():
        path, text = folder / f"{name}.md", "\n".join(lines()) + "\n"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


# ------------------------------------------------------------------------------------------------------------- commands


def _commands() -> Iterator[str]:
    parser = command_line.make_parser()
    yield "# Commands"
    yield ""
    yield "Generated from the command line's own parser. Every command takes `--help`."
    yield ""
    yield "| exit status | meaning |"
    yield "|---|---|"
    yield from (f"| {status} | {meaning} |" for status, meaning in EXIT_STATUSES)
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))  # noqa: SLF001
    summaries = {action.dest: action.help for action in commands._get_subactions()}  # noqa: SLF001
    for name, command in commands.choices.items():
        yield from ("", f"## analogrig {name}", "", _sentence(summaries.get(name) or ""), "")
        yield from ("```text", command.format_usage().strip(), "```", "")
        yield from _options(command)
        if command.epilog:
            yield from ("", "```text", command.epilog.strip(), "```")


def _options(command: argparse.ArgumentParser) -> Iterator[str]:
    yield "| option | meaning |"
    yield "|---|---|"
    formatter = command._get_formatter()  # noqa: SLF001
    for action in command._actions:  # noqa: SLF001
        if isinstance(action, argparse._HelpAction) or action.help == argparse.SUPPRESS:  # noqa: SLF001
            continue
        names = ", ".join(f"`{option}`" for option in action.option_strings) or f"`{action.metavar or action.dest}`"
        text = _cell(formatter._expand_help(action) if action.help else "")  # noqa: SLF001
        yield "| {} | {} |".format(names, OPTION.sub(r"`\1`", text))


# ----------------------------------------------------------------------------------------------------------- TOML files


def _file(title: str, described: type) -> Iterator[str]:
    yield f"# {title}"
    yield ""
    yield "Generated from the typed description that reads the file. An unknown key is an error that names it."
    yield from _tables(described, "")


def _tables(described: type, path: str) -> Iterator[str]:
    yield from ("", f"## {f'[{path}]' if path else 'Top level'}", "")
    if (text := inspect.getdoc(described)) and not text.startswith(f"{described.__name__}("):
        yield from (_first_paragraph(text), "")
    yield from _keys(described, _fields(described))
    hints = typing.get_type_hints(described)
    for field in _fields(described):
        for each in _dataclasses_in(hints[field.name]):
            yield from _tables(each, f"{path}.{field.name}" if path else field.name)


def _keys(described: type, fields: Iterable[dataclasses.Field[Any]]) -> Iterator[str]:
    hints, texts = typing.get_type_hints(described), _field_texts(described)
    yield "| key | type | default | meaning |"
    yield "|---|---|---|---|"
    for field in fields:
        cells = (_type_name(hints[field.name]), _default(field), texts.get(field.name, ""))
        yield f"| `{field.name}` | {' | '.join(map(_cell, cells))} |"


def _fields(described: type) -> list[dataclasses.Field[Any]]:
    return [field for field in dataclasses.fields(described) if field.init and field.name != "name"]


def _device_files() -> Iterator[str]:
    yield from ("# Device files", "", "Generated from the typed descriptions that read the file. `kind` chooses one.")
    common = set.intersection(*({field.name for field in _fields(described)} for described in KINDS.values()))
    first = next(iter(KINDS.values()))
    yield from ("", "## Keys of every kind", "")
    yield from _keys(first, (field for field in _fields(first) if field.name in common))
    for kind, described in KINDS.items():
        own = [field for field in _fields(described) if field.name not in common]
        yield from ("", f"## Kind {kind}", "")
        yield from _keys(described, own) if own else ("No further keys.",)
    yield from _tables(EstimatorConfig, "estimator")


def _field_texts(described: type) -> dict[str, str]:
    """Return the docstring under each field, those of base classes included."""
    out: dict[str, str] = {}
    for cls in reversed(described.__mro__):
        if "__dataclass_params__" not in vars(cls):
            continue
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
                and isinstance(text.value.value, str)
            ):
                out[field.target.id] = inspect.cleandoc(text.value.value)
    return out


def _dataclasses_in(hint: Any) -> list[type]:
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return [hint]
    return [each for argument in typing.get_args(hint) for each in _dataclasses_in(argument)]


def _type_name(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_type_name(each) for each in arguments if each is not types.NoneType)
    if origin is Literal:
        shown = [f"`{value!r}`".replace("'", '"') for value in arguments[:_CHOICES_MAX]]
        return ", ".join(shown) + (", ..." if len(arguments) > _CHOICES_MAX else "")
    if origin is tuple:
        return f"array of {_type_name(arguments[0])}" if Ellipsis in arguments else f"array of {len(arguments)}"
    if origin is not None and arguments and issubclass(origin, Mapping):
        return f"table of {_type_name(arguments[1])}"
    if dataclasses.is_dataclass(hint):
        return "table"
    names = {float: "number", int: "whole number", str: "text", bool: "true or false"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
        return "required"
    value = field.default if field.default is not dataclasses.MISSING else None
    if value is None or value == "":
        return ""
    shown = str(value).lower() if isinstance(value, bool) else repr(value)
    return f"`{shown}`".replace("'", '"')


# --------------------------------------------------------------------------------------------------------------- Python


def _python(package: types.ModuleType, title: str) -> Iterator[str]:
    yield f"# {title}"
    yield ""
    yield f"`import {package.__name__}` offers these names and no others. Everything else is private and may move."
    constants = _constant_texts(Path(str(package.__file__)).parent)
    for name in sorted(package.__all__, key=str.lower):
        thing = getattr(package, name)
        is_value = not callable(thing) and not inspect.ismodule(thing)
        text = constants.get(name, "") if is_value else inspect.getdoc(thing) or ""
        if not text:
            continue
        yield from ("", f"## {name}", "")
        yield from _signature(name, thing)
        yield _documentation(text)
        if inspect.isclass(thing):
            yield from _members(thing)


def _constant_texts(folder: Path) -> dict[str, str]:
    """Return the docstring under each constant of the modules of a package."""
    out: dict[str, str] = {}
    for path in folder.rglob("*.py"):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        for statement, text in itertools.pairwise(body):
            targets = statement.targets if isinstance(statement, ast.Assign) else []
            targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
            if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                names = (each.id for each in ast.walk(ast.List(targets)) if isinstance(each, ast.Name))
                out.update(dict.fromkeys(names, inspect.cleandoc(str(text.value.value))))
    return out


def _signature(name: str, thing: Any) -> Iterator[str]:
    if callable(thing) and not (inspect.isclass(thing) and issubclass(thing, BaseException)):
        try:
            yield from ("```python", f"{name}{inspect.signature(thing)}", "```", "")
        except (TypeError, ValueError):
            return


def _members(cls: type) -> Iterator[str]:
    texts = _field_texts(cls) if dataclasses.is_dataclass(cls) else {}
    rows = [(f"`{name}`", text) for name, text in texts.items() if not name.startswith("_")]
    for name, member in vars(cls).items():
        text = inspect.getdoc(member) if callable(member) or isinstance(member, property | classmethod) else None
        if not name.startswith("_") and text:
            rows.append((f"`{name}`" if isinstance(member, property) else f"`{name}()`", _first_paragraph(text)))
    if rows:
        yield from ("", "| member | meaning |", "|---|---|", *(f"| {name} | {_cell(text)} |" for name, text in rows))


# -------------------------------------------------------------------------------------------------------------------- C


def _c_interface() -> Iterator[str]:
    yield "# C interface: est.h"
    yield ""
    yield "The header is the manual. This page shows it as it is compiled."
    yield from ("", "```c", HEADER.read_text(encoding="utf-8").rstrip(), "```")


def _messages() -> Iterator[str]:
    database = cantools.database.load_file(CATALOGUE)
    assert isinstance(database, cantools.database.can.Database)
    yield "# Messages"
    yield ""
    yield "Generated from `estimator_c/catalogue/analogrig.dbc`, the only description of the protocol."
    for message in database.messages:
        yield from ("", f"## {message.name} (identifier {message.frame_id:#04x}, {message.length} bytes)", "")
        yield f"Sent by {', '.join(message.senders)}. {message.comment or ''}"
        yield from ("", "| signal | bits | type | unit | meaning |", "|---|---|---|---|---|")
        for signal in message.signals:
            kind = "float32" if signal.is_float else "signed" if signal.is_signed else "unsigned"
            bits = f"{signal.start} to {signal.start + signal.length - 1}"
            yield f"| `{signal.name}` | {bits} | {kind} | {signal.unit or ''} | {_cell(_signal_text(signal))} |"


def _signal_text(signal: Any) -> str:
    choices = ", ".join(f"{value} {name}" for value, name in (signal.choices or {}).items())
    return " ".join(part for part in (signal.comment or "", choices) if part)


# --------------------------------------------------------------------------------------------------------------- errors


def _errors() -> Iterator[str]:
    yield "# Errors"
    yield ""
    yield "Every error is one line that names cause, place and cure. `...` stands for a value of the moment."
    yield from ("", "```text", *(errors.__doc__ or "").strip().splitlines()[2:-2], "```")
    found: dict[str, set[str]] = {}
    for package in PACKAGES:
        for path in sorted(package.rglob("*.py")):
            for kind, message in _raised(ast.parse(path.read_text(encoding="utf-8"))):
                found.setdefault(kind, set()).add(message)
    for kind in sorted(found):
        meaning = _first_paragraph(inspect.getdoc(getattr(errors, kind, None)) or "")
        yield from ("", f"## {kind}", "", meaning, "", *(f"- `{message}`" for message in sorted(found[kind])))


def _raised(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield error class and message template of every ``raise`` with a literal message."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            kind, arguments = node.exc.func.id, node.exc.args
            if (
                kind.endswith(("Error", "Timeout", "Closed", "Refused", "Mismatch", "Stale", "Incomplete"))
                and arguments
            ):
                message = _template(arguments[0])
                if len(message.replace("...", "").strip(" :,")) > len("..."):
                    yield kind, message


def _template(node: ast.expr) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value.replace("`", "'").replace("\n", " ")
    if isinstance(node, ast.JoinedStr):
        return "".join(_template(part) if isinstance(part, ast.Constant) else "..." for part in node.values)
    return "..."


# ----------------------------------------------------------------------------------------------------------------- text


def _documentation(text: str) -> str:
    """Return a docstring as Markdown: field lists become a list."""
    text = re.sub(r"``([^`]+)``", r"`\1`", text)
    text = re.sub(r"^:param (\w+): ", r"- `\1`: ", text, flags=re.MULTILINE)
    return re.sub(r"^:raises ([\w, ]+): ", r"- raises `\1`: ", text, flags=re.MULTILINE)


def _first_paragraph(text: str) -> str:
    return _documentation(" ".join(text.split("\n\n", maxsplit=1)[0].split()))


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}" if text else ""


def _cell(text: str) -> str:
    return _documentation(" ".join(text.split())).replace("|", "\\|")
