"""The text of a SPICE deck: lines to cards, cards to subcircuit definitions. What the cards mean is for deck.py."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from .errors import CircuitError, EmulatorError

__all__ = ["MAX_NESTING", "Card", "Definition", "located", "parse"]

MAX_CHARACTERS = 8 << 20

MAX_ASSIGNMENTS = 50_000
"""On one card."""

MAX_NESTING = 20
"""Subcircuits within subcircuits."""

_COMMENT = re.compile(r"(?:;|(?:^|\s)\$\s).*")
_QUOTED = re.compile(r"\{[^{}]*\}|'[^']*'")
_ASSIGNMENT = re.compile(r"\b([A-Za-z_]\w*(?:\s*\([^()=]*\))?)\s*=\s*")
_GAP = re.compile(r"[\s,()]+")


@dataclass(frozen=True)
class Card:
    """One card with its continuation lines: the line on which it begins, and its text."""

    line: int
    text: str

    @property
    def head(self) -> str:
        """Its first word, as it stands."""
        return self.text.split(maxsplit=1)[0]

    @property
    def kind(self) -> str:
        """.subckt and the like, or the letter of an element; lower case."""
        return self.head.lower() if self.text.startswith(".") else self.text[0].lower()

    def fields(self) -> tuple[list[str], dict[str, str]]:
        """The words up to the first assignment, and the assignments, their names in lower case and without blanks.

        Braces and quotes hold together. Raises CircuitError for a name assigned twice, or text between assignments.
        """
        masked = _QUOTED.sub(lambda match: "#" * len(match.group()), self.text)
        found = list(itertools.islice(_ASSIGNMENT.finditer(masked), MAX_ASSIGNMENTS + 1))
        if len(found) > MAX_ASSIGNMENTS:
            raise CircuitError(f"has more than {MAX_ASSIGNMENTS} assignments")
        ends = [*(match.start() for match in found[1:]), len(self.text)][: len(found)]
        words = list(self._words(masked, found[0].start() if found else len(masked)))
        values: dict[str, str] = {}
        for match, end in zip(found, ends, strict=True):
            name = "".join(match[1].lower().split())
            if name in values:
                raise CircuitError(f"{name} is given twice")
            values[name] = self.text[match.end() : end].strip().rstrip(",")
        return words, values

    def _words(self, masked: str, stop: int) -> Iterator[str]:
        start = 0
        for gap in _GAP.finditer(masked, 0, stop):
            if gap.start() > start:
                yield self.text[start : gap.start()]
            start = gap.end()
        if start < stop:
            yield self.text[start:stop]


@dataclass
class Definition:
    """A subcircuit, or the whole deck: its ports, the texts of its parameters, its cards, the subcircuits within."""

    name: str
    ports: tuple[str, ...] = ()
    parameters: dict[str, str] = field(default_factory=dict)
    cards: list[Card] = field(default_factory=list)
    inner: dict[str, Definition] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    """Every card in it, as is; to tell one definition from another."""

    @property
    def signature(self) -> str:
        """The same for definitions that differ in blanks, case, line ends and comments only."""
        return "\n".join(" ".join(line.split()) for line in self.lines).lower()


class located:  # noqa: N801 - reads as a word in a with statement
    """Puts file, line and card before the message of whatever error of the emulator passes."""

    def __init__(self, name: str, card: Card) -> None:
        self._where = f"{name}:{card.line}: {card.head[:40]}"

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, EmulatorError):
            raise type(error)(f"{self._where}: {error}") from error


def parse(text: str, name: str) -> tuple[str, Definition]:
    """The title, which is the first line whatever it says, and the deck as far as .end.

    name: of the file, for the errors. Raises CircuitError for what is not balanced, too long or nested too deeply.
    """
    if len(text) > MAX_CHARACTERS:
        raise CircuitError(f"{name}: the deck has {len(text)} characters; at most {MAX_CHARACTERS} are read")
    title, *lines = text.splitlines() or [""]
    stack = [Definition("")]
    for card in _cards(lines, name):
        with located(name, card):
            if card.kind == ".end":
                break
            _enter(stack, card)
    if len(stack) > 1:
        raise CircuitError(f"{name}: subcircuit {stack[-1].name} has no .ends")
    return title.lstrip("* ").rstrip(), stack[0]


def _cards(lines: Iterable[str], name: str) -> Iterator[Card]:
    first, parts = 0, list[str]()
    for number, line in enumerate(lines, start=2):
        content = "" if line.startswith("*") else _COMMENT.sub("", line).strip()
        if content.startswith("+"):
            if not parts:
                raise CircuitError(f"{name}:{number}: a continuation line continues nothing")
            parts.append(content[1:])
        elif content:
            if parts:
                yield Card(first, " ".join(parts))
            first, parts = number, [content]
    if parts:
        yield Card(first, " ".join(parts))


def _enter(stack: list[Definition], card: Card) -> None:
    for definition in stack[1:]:
        definition.lines.append(card.text)
    if card.kind == ".subckt":
        _open(stack, card)
    elif card.kind == ".ends":
        if len(stack) == 1:
            raise CircuitError("there is no .subckt before it")
        stack.pop()
    elif card.kind == ".param":
        _add_parameters(stack[-1], card)
    else:
        stack[-1].cards.append(card)


def _open(stack: list[Definition], card: Card) -> None:
    words, values = card.fields()
    words = [word for word in words[1:] if word.lower() != "params:"]
    if not words:
        raise CircuitError("a subcircuit needs a name")
    name, *ports = (word.lower() for word in words)
    if len(set(ports)) < len(ports):
        raise CircuitError(f"subcircuit {name} has two ports of the same name")
    if name in stack[-1].inner:
        raise CircuitError(f"subcircuit {name} is defined twice")
    if len(stack) > MAX_NESTING:
        raise CircuitError(f"subcircuits are defined within each other more than {MAX_NESTING} deep")
    definition = Definition(name, tuple(ports), values, lines=[card.text])
    stack[-1].inner[name] = definition
    stack.append(definition)


def _add_parameters(definition: Definition, card: Card) -> None:
    words, values = card.fields()
    if len(words) > 1 or not values:
        raise CircuitError("expected name = value")
    for name, text in values.items():
        if name in definition.parameters:
            raise CircuitError(f"parameter {name} is given twice")
        definition.parameters[name] = text
