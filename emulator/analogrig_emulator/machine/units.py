"""Units of a program file: dimension and factor to SI, from text such as "N s/m" or "kg m^2"."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from analogrig_emulator.exceptions import ProgramError

_BASE = ("kg", "m", "s", "A", "K", "mol", "cd")
_MOST_CHARACTERS = 60
_MOST_POWER = 12
_FACTOR_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Unit:
    """Unit: exponents of kg, m, s, A, K, mol and cd, and its size in SI units. text: as the file writes it."""

    exponents: tuple[float, ...] = (0,) * len(_BASE)
    factor: float = 1.0
    text: str = "1"

    def __mul__(self, other: Unit) -> Unit:
        exponents = tuple(a + b for a, b in zip(self.exponents, other.exponents, strict=True))
        return _named(exponents, self.factor * other.factor)

    def __truediv__(self, other: Unit) -> Unit:
        return self * other**-1

    def __pow__(self, power: int) -> Unit:
        return _named(tuple(power * each for each in self.exponents), self.factor**power)

    def root(self) -> Unit:
        """Unit of the square root."""
        return _named(tuple(each / 2 for each in self.exponents), math.sqrt(self.factor))

    def matches(self, other: Unit) -> bool:
        """True if both have the same dimension and size."""
        return self.exponents == other.exponents and math.isclose(
            self.factor, other.factor, rel_tol=_FACTOR_TOLERANCE, abs_tol=0.0
        )

    def factor_to(self, other: Unit) -> float | None:
        """Number of ``other`` in one of this unit; None if it measures something else.

        Frequencies and angular velocities, fractions and angles have the same dimension, but measure different things.
        """
        if self.exponents != other.exponents or any(
            (each in self.text) != (each in other.text) for each in ("Hz", "%")
        ):
            return None
        return self.factor / other.factor


def _named(exponents: tuple[float, ...], factor: float) -> Unit:
    """Unit with a text made of its factor and exponents."""
    powers = sorted(zip(_BASE, exponents, strict=True), key=lambda pair: pair[1] < 0)
    parts = [name if n == 1 else f"{name}^{n:g}" for name, n in powers if n]
    head = [] if parts and math.isclose(factor, 1.0, rel_tol=_FACTOR_TOLERANCE) else [f"{factor:.6g}"]
    return Unit(exponents, factor, " ".join(head + parts))


NUMBER = Unit()


def _si(factor: float = 1.0, **exponents: int) -> Unit:
    return Unit(tuple(exponents.get(name, 0) for name in _BASE), factor)


_SYMBOLS: Mapping[str, Unit] = MappingProxyType(
    {
        "1": NUMBER,
        "%": _si(0.01),
        "rad": NUMBER,
        "deg": _si(math.pi / 180),
        "rev": _si(2 * math.pi),
        "rpm": _si(math.pi / 30, s=-1),
        "m": _si(m=1),
        "g": _si(1e-3, kg=1),
        "t": _si(1e3, kg=1),
        "s": _si(s=1),
        "min": _si(60.0, s=1),
        "h": _si(3600.0, s=1),
        "A": _si(A=1),
        "K": _si(K=1),
        "mol": _si(mol=1),
        "cd": _si(cd=1),
        "Hz": _si(s=-1),
        "N": _si(kg=1, m=1, s=-2),
        "Pa": _si(kg=1, m=-1, s=-2),
        "bar": _si(1e5, kg=1, m=-1, s=-2),
        "J": _si(kg=1, m=2, s=-2),
        "W": _si(kg=1, m=2, s=-3),
        "C": _si(A=1, s=1),
        "V": _si(kg=1, m=2, s=-3, A=-1),
        "F": _si(kg=-1, m=-2, s=4, A=2),
        "ohm": _si(kg=1, m=2, s=-3, A=-2),
        "S": _si(kg=-1, m=-2, s=3, A=2),
        "H": _si(kg=1, m=2, s=-2, A=-2),
        "Wb": _si(kg=1, m=2, s=-2, A=-1),
        "T": _si(kg=1, s=-2, A=-1),
        "l": _si(1e-3, m=3),
        "L": _si(1e-3, m=3),
    }
)

_PREFIXES = MappingProxyType({"p": 1e-12, "n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1} | {"k": 1e3, "M": 1e6})
_WITHOUT_PREFIX = {"1", "%", "rad", "deg", "rev", "rpm", "min", "h", "t"}

_TOKEN = re.compile(r"\s*(?:(?P<symbol>[A-Za-z]+|%|1)(?:\^(?P<power>-?\d{1,2}))?|(?P<sign>[*/()]))")


def parse_unit(text: str) -> Unit:
    """Unit of a text: symbols with SI prefixes, ``^`` before a power, a space or ``*`` between factors, ``/``, ().

    A ``/`` divides by the one factor after it. Raises ProgramError naming the symbol.
    """
    if len(text) > _MOST_CHARACTERS:
        raise ProgramError(f"unit of {len(text)} characters; write at most {_MOST_CHARACTERS}")
    unit, rest = _product(text, text)
    if re.match(r"\.\d", rest):
        raise ProgramError(f"unit {text!r}: a power is no whole number; leave out the units of its terms")
    if rest.strip():
        raise ProgramError(f"unit {text!r}: {rest.strip()[0]!r} is out of place; write N s/m, kg m^2 or V/(rad/s)")
    return Unit(unit.exponents, unit.factor, text)


def _product(rest: str, whole: str) -> tuple[Unit, str]:
    """Unit at the beginning of `rest`, up to its end or a closing bracket, and what follows."""
    unit, divide, needs_factor = NUMBER, False, True
    while match := _TOKEN.match(rest):
        sign = match["sign"]
        if sign == ")":
            break
        rest = rest[match.end() :]
        if sign in ("*", "/"):
            if needs_factor:
                raise ProgramError(f"unit {whole!r}: nothing stands before {sign!r}")
            divide, needs_factor = sign == "/", True
            continue
        if sign == "(":
            factor, rest = _product(rest, whole)
            if not rest.startswith(")"):
                raise ProgramError(f"unit {whole!r}: a bracket is not closed")
            rest = rest[1:]
        else:
            factor = _symbol(match["symbol"], whole) ** _power(match["power"], whole)
        unit, divide, needs_factor = (unit / factor if divide else unit * factor), False, False
    if needs_factor:
        raise ProgramError(f"unit {whole!r} ends before a symbol; a number without unit is '1'")
    return unit, rest


def _power(text: str | None, whole: str) -> int:
    power = int(text or 1)
    if abs(power) > _MOST_POWER:
        raise ProgramError(f"unit {whole!r}: power {power} exceeds {_MOST_POWER}")
    return power


def _symbol(symbol: str, whole: str) -> Unit:
    if symbol in _SYMBOLS:
        return _SYMBOLS[symbol]
    prefix, root = symbol[:1], symbol[1:]
    if prefix in _PREFIXES and root in _SYMBOLS and root not in _WITHOUT_PREFIX:
        known = _SYMBOLS[root]
        return Unit(known.exponents, known.factor * _PREFIXES[prefix])
    raise ProgramError(f"unit {whole!r}: unknown symbol {symbol!r}; there are {', '.join(sorted(_SYMBOLS))}")
