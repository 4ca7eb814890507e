"""Numbers and arithmetic as SPICE writes them: 49.9k, 3meg, {2 * r / (1 + k)}.

Evaluated by a parser of its own, never by Python: only numbers, names, + - * / and parentheses, of bounded length,
depth and amount.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from .errors import CircuitError

__all__ = ["Budget", "Scope", "number"]

MAX_LENGTH = 1000
"""Characters of one expression."""

MAX_DEPTH = 50
"""Parentheses, signs and parameters that refer to parameters, together."""

_EXPONENTS = {"t": 12, "g": 9, "meg": 6, "k": 3, "m": -3, "u": -6, "n": -9, "p": -12, "f": -15, "": 0}
_NUMBER = re.compile(r"([0-9]+\.?[0-9]*|\.[0-9]+)(?:e([+-]?[0-9]{1,4}))?([a-z]*)", re.IGNORECASE)
_SIGNED = re.compile(rf"\s*([+-]?){_NUMBER.pattern}\s*", re.IGNORECASE)
_TOKEN = re.compile(
    rf"\s*(?:(?P<number>{_NUMBER.pattern})|(?P<name>[a-z_][a-z0-9_]*)|(?P<sign>[-+*/()]))", re.IGNORECASE
)


def number(text: str) -> float | None:
    """A plain number with SPICE's suffixes, whatever unit behind them (10k, 10kohm, 5V); None when it is none.

    The decimal value is rounded once, so 49.9k is the float 49900.0. 1F is a femto, as everywhere in SPICE.
    """
    match = _SIGNED.fullmatch(text) if len(text) <= MAX_LENGTH else None
    return None if match is None else _value(*match.groups())


def _value(sign: str, digits: str, exponent: str | None, suffix: str) -> float:
    suffix = suffix.lower()
    if suffix.startswith("mil"):
        return float(f"{sign}{digits}e{exponent or 0}") * 25.4e-6
    key = "meg" if suffix.startswith("meg") else suffix[:1]
    return float(f"{sign}{digits}e{int(exponent or 0) + _EXPONENTS.get(key, 0)}")


@dataclass
class Budget:
    """What reading one deck may still cost."""

    work: int

    def spend(self) -> None:
        """Raises CircuitError when nothing is left."""
        self.work -= 1
        if self.work < 0:
            raise CircuitError(
                "the deck is too large: too many cards and parameters after its subcircuits are expanded"
            )


@dataclass
class Scope:
    """The parameters that a card sees: those of its subcircuit, then those around it.

    Each is evaluated when first asked for, so that they may stand in any order.
    """

    texts: Mapping[str, str]
    budget: Budget
    outer: Scope | None = None
    given: Mapping[str, float] = field(default_factory=dict)
    """Values that an instance passes; they go before texts."""
    _values: dict[str, float] = field(default_factory=dict)
    _pending: set[str] = field(default_factory=set)

    def evaluate(self, text: str, depth: int = 0) -> float:
        """The finite value of a number or of an expression, with or without braces or quotes. Raises CircuitError."""
        plain = number(text)
        value = _Parser(_unquoted(text), self, depth).value() if plain is None else plain
        if not math.isfinite(value):
            raise CircuitError(f"{_shown(text)} is not a finite number")
        return value

    def value_of(self, name: str, depth: int) -> float:
        """The value of a parameter. Raises CircuitError when there is none, or when it needs itself."""
        if name in self.given:
            return self.given[name]
        if name not in self.texts:
            if self.outer is None:
                raise CircuitError(f"no parameter is called {name!r}")
            return self.outer.value_of(name, depth)
        if name not in self._values:
            self._values[name] = self._evaluated(name, depth)
        return self._values[name]

    def _evaluated(self, name: str, depth: int) -> float:
        self.budget.spend()
        if name in self._pending:
            raise CircuitError(f"parameter {name} needs itself")
        self._pending.add(name)
        value = self.evaluate(self.texts[name], depth + 1)
        self._pending.remove(name)
        return value


class _Parser:
    """sum = product {+- product}; product = factor {*/ factor}; factor = number | name | (sum) | +-factor."""

    def __init__(self, text: str, scope: Scope, depth: int) -> None:
        if len(text) > MAX_LENGTH:
            raise CircuitError(f"an expression has {len(text)} characters; at most {MAX_LENGTH} are allowed")
        self._text = text
        self._scope = scope
        self._depth = depth
        self._at = 0
        self._token: re.Match[str] | None = None
        self._next()

    def value(self) -> float:
        value = self._sum()
        if self._token is not None:
            raise self._unexpected()
        return value

    def _next(self) -> None:
        self._token = _TOKEN.match(self._text, self._at)
        if self._token is not None:
            self._at = self._token.end()
        elif self._text[self._at :].strip():
            raise CircuitError(f"{_shown(self._text)}: only numbers, parameters, + - * / and ( ) are allowed")

    def _takes(self, signs: str) -> str:
        """The sign at hand if it is one of these, taken; else nothing."""
        sign = (self._token and self._token["sign"]) or ""
        if sign not in signs:
            return ""
        if sign:
            self._next()
        return sign

    def _sum(self) -> float:
        value = self._product()
        while sign := self._takes("+-"):
            value += self._product() if sign == "+" else -self._product()
        return value

    def _product(self) -> float:
        value = self._factor()
        while sign := self._takes("*/"):
            factor = self._factor()
            if sign == "/" and not factor:
                raise CircuitError(f"{_shown(self._text)} divides by zero")
            value = value * factor if sign == "*" else value / factor
        return value

    def _factor(self) -> float:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise CircuitError(f"{_shown(self._text)} is nested deeper than {MAX_DEPTH}")
        value = self._nested() if self._token and self._token["sign"] else self._operand()
        self._depth -= 1
        return value

    def _nested(self) -> float:
        if sign := self._takes("+-"):
            return self._factor() if sign == "+" else -self._factor()
        if not self._takes("("):
            raise self._unexpected()
        value = self._sum()
        if not self._takes(")"):
            raise self._unexpected()
        return value

    def _operand(self) -> float:
        token = self._token
        if token is None:
            raise self._unexpected()
        self._next()
        if token["name"]:
            return self._scope.value_of(token["name"].lower(), self._depth)
        plain = number(token["number"])
        assert plain is not None  # noqa: S101 - the same pattern found it
        return plain

    def _unexpected(self) -> CircuitError:
        what = "its end" if self._token is None else repr(self._token.group().strip())
        return CircuitError(f"{_shown(self._text)}: {what} is not expected there")


def _unquoted(text: str) -> str:
    text = text.strip()
    quoted = len(text) > 1 and (text[0], text[-1]) in {("{", "}"), ("'", "'")}
    return text[1:-1] if quoted else text


def _shown(text: str) -> str:
    text = text.strip()
    return repr(text if len(text) <= 60 else text[:57] + "...")
