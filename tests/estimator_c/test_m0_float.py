"""The float arithmetic for the Cortex-M0 (estimator_c/ports/cortex_m0/float.S) gives the bits that numpy's gives."""

from __future__ import annotations

import itertools
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator_c.evidence import cost

COMPILER = "arm-linux-gnueabi-gcc"
EMULATOR = "qemu-arm"

pytestmark = pytest.mark.tools(COMPILER, EMULATOR)

Words = NDArray[np.uint32]
Floats = NDArray[np.float32]
Integers = NDArray[np.int64]

# ---- what each routine should return


def words(values: Floats) -> Words:
    return values.astype(np.float32).view(np.uint32)


def floats(values: Words) -> Floats:
    return values.view(np.float32)


def truncated(a: Floats, kind: type[np.integer]) -> Words:
    """Integer as Arm's VCVT gives it: beyond the range its end, and 0 for no number."""
    limits = np.iinfo(kind)
    whole = np.trunc(np.nan_to_num(a.astype(np.float64), nan=0.0, posinf=1e30, neginf=-1e30))
    return np.clip(whole, limits.min, limits.max).astype(kind).view(np.uint32)


ARITHMETIC: dict[str, Callable[[Floats, Floats], Floats]] = {
    "fadd": lambda a, b: a + b,
    "fsub": lambda a, b: a - b,
    "frsub": lambda a, b: b - a,
    "fmul": lambda a, b: a * b,
    "fdiv": lambda a, b: a / b,
}
OTHERS: dict[str, Callable[[Floats, Floats], Words]] = {
    "fcmpeq": lambda a, b: (a == b).astype(np.uint32),
    "fcmplt": lambda a, b: (a < b).astype(np.uint32),
    "fcmple": lambda a, b: (a <= b).astype(np.uint32),
    "fcmpge": lambda a, b: (a >= b).astype(np.uint32),
    "fcmpgt": lambda a, b: (a > b).astype(np.uint32),
    "fcmpun": lambda a, b: (np.isnan(a) | np.isnan(b)).astype(np.uint32),
    "i2f": lambda a, _: words(a.view(np.int32).astype(np.float32)),
    "ui2f": lambda a, _: words(a.view(np.uint32).astype(np.float32)),
    "f2iz": lambda a, _: truncated(a, np.int32),
    "f2uiz": lambda a, _: truncated(a, np.uint32),
}


def expected(name: str, a: Words, b: Words) -> Words:
    with np.errstate(all="ignore"):
        if name in ARITHMETIC:
            return words(ARITHMETIC[name](floats(a), floats(b)))
        return OTHERS[name](floats(a), floats(b))


# ---- operands

SPECIAL = np.array(
    [
        *(0, 1, 2, 3, 0x0000FFFF, 0x00400000, 0x007FFFFE, 0x007FFFFF),  # zero, subnormal
        *(0x00800000, 0x00800001, 0x00800002, 0x00FFFFFF, 0x01000000, 0x01000001),  # tiny
        *(0x0BFFFFFF, 0x0C000000, 0x0C7FFFFF, 0x0C800000),  # their differences are tiny
        *(0x1FFFFFFF, 0x20000000, 0x2AFFFFFF, 0x2B000000, 0x33800000, 0x34000000, 0x3F000000, 0x3F7FFFFF),
        *(0x3F800000, 0x3F800001, 0x3FC00000, 0x3FFFFFFF, 0x40000000, 0x40400000, 0x40490FDB, 0x457FF000),
        *(0x4AFFFFFF, 0x4B000000, 0x4B7FFFFF, 0x4B800000, 0x4EFFFFFF, 0x4F000000, 0x4F7FFFFF, 0x4F800000),
        *(0x557FFFFF, 0x55800000, 0x5FFFFFFF, 0x60000000, 0x7E7FFFFF, 0x7E800000, 0x7EFFFFFF, 0x7F000000),
        *(0x7F7FFFFE, 0x7F7FFFFF, 0x7F800000, 0x7F800001, 0x7FBFFFFF, 0x7FC00000, 0x7FFFFFFF),  # the largest, beyond
    ],
    np.uint32,
)


def special_pairs() -> tuple[Words, Words]:
    """All of them, of either sign."""
    values = np.concatenate([SPECIAL, SPECIAL | np.uint32(1 << 31)])
    a, b = zip(*itertools.product(values, values), strict=True)
    return np.array(a, np.uint32), np.array(b, np.uint32)


def made_of(rng: np.random.Generator, exponents: Integers, mantissas: Integers) -> Words:
    """Floats of either sign; the mantissas without their leading one."""
    signs = rng.integers(0, 2, exponents.size)
    return (signs << 31 | exponents << 23 | mantissas).astype(np.uint32)


def random_pairs(rng: np.random.Generator, n: int) -> Iterator[tuple[Words, Words]]:
    """Bit patterns, moderate numbers, results at either end of the range, sums that cancel, and short mantissas."""

    def mantissas() -> Integers:
        return rng.integers(0, 1 << 23, n)

    def near(exponents: Integers, distance: int) -> Integers:
        return (exponents + rng.integers(-distance, distance + 1, n)).clip(0, 254)

    yield rng.integers(0, 1 << 32, n, np.uint32), rng.integers(0, 1 << 32, n, np.uint32)
    for lowest, highest, distance in ((70, 180, 30), (90, 165, 2), (0, 30, 26), (230, 254, 20)):
        exponents = rng.integers(lowest, highest + 1, n)
        yield made_of(rng, exponents, mantissas()), made_of(rng, near(exponents, distance), mantissas())
    for total in (127 - 12, 127 + 254):  # products, and
        exponents = rng.integers(max(0, total - 254), min(254, total) + 1, n)
        yield made_of(rng, exponents, mantissas()), made_of(rng, near(total - exponents, 13), mantissas())
    for difference in (-127 - 12, 127):  # quotients at the ends of the range
        exponents = rng.integers(max(0, difference), min(254, 254 + difference) + 1, n)
        yield made_of(rng, exponents, mantissas()), made_of(rng, near(exponents - difference, 13), mantissas())
    exponents, mantissa = rng.integers(1, 254, n), mantissas()
    other = (mantissa + rng.integers(-99, 100, n)).clip(0, (1 << 23) - 1)
    yield made_of(rng, exponents, mantissa), made_of(rng, exponents, other)
    a, b = (mantissas() & -(1 << rng.integers(0, 23, n)) for _ in range(2))
    yield made_of(rng, exponents, a), made_of(rng, near(exponents, 24), b)


def inverses(odd: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Modulo 2^64."""
    x = odd.copy()
    for _ in range(5):  # 3 bits are right to begin with, and twice as many each time
        x *= np.uint64(2) - odd * x
    return x


def halves(rng: np.random.Generator, name: str, n: int) -> tuple[Words, Words]:
    """The result lies half way between two floats, or so close to it that all bits are needed."""
    odd = rng.integers(1 << 22, 1 << 23, n, np.uint64) * np.uint64(2) + np.uint64(1)
    nearly = (rng.integers(-3, 4, n) << rng.integers(0, 20, n)).astype(np.uint64)
    if name == "fmul":  # of the product, 23 or 24 bits are lost
        a = ((np.uint64(1) << rng.integers(22, 24, n, np.uint64)) + nearly) * inverses(odd) % np.uint64(1 << 24)
        short = rng.integers(1 << 11, 1 << 13, (2, n), np.uint64)
        a, b = np.where(rng.integers(0, 4, n) == 0, short, [a, odd])
    elif name == "fdiv":  # the quotient has an odd number of 24 or 25 bits, less nearly / odd
        bits = rng.integers(24, 26, n, np.uint64)
        b = odd
        a = ((nearly | np.uint64(1)) * inverses(odd) % (np.uint64(1) << bits)) * odd >> bits
    else:  # one has 24 bits before the point, the other ends in a half, or beside it
        a = odd >> rng.integers(0, 2, n, np.uint64)
        b = (rng.integers(0, 1 << 22, n, np.uint64) >> rng.integers(0, 23, n, np.uint64)).astype(np.float32) + 0.5
        b = floats(words(b) + rng.integers(-1, 2, n).astype(np.uint32))
    signs = rng.choice([-1.0, 1.0], (2, n))
    return words(a * signs[0]), words(b * signs[1])


# ---- the routines


class Arm:
    """A program that runs them, in a simulated processor."""

    def __init__(self, folder: Path) -> None:
        self._program = folder / "m0_float"
        sources = [Path(__file__).with_name("m0_float_driver.c"), cost.FLOAT_ROUTINES]
        flags = ("-O2", "-static", "-Wall", "-Wextra", "-Werror")
        subprocess.run([COMPILER, *flags, *map(str, sources), "-o", str(self._program)], check=True)

    def __call__(self, name: str, a: Words, b: Words) -> Words:
        pairs = np.stack([a, b], axis=1).astype("<u4")
        command = [EMULATOR, str(self._program), name]
        done = subprocess.run(command, input=pairs.tobytes(), stdout=subprocess.PIPE, check=True)
        return np.frombuffer(done.stdout, "<u4").astype(np.uint32)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Arm:
    return Arm(tmp_path_factory.mktemp("m0_float"))


def disagreements(arm: Arm, name: str, a: Words, b: Words) -> list[str]:
    """The first of them; one NaN is as good as another."""
    got, wanted = arm(name, a, b), expected(name, a, b)
    assert got.shape == wanted.shape
    wrong = got != wanted
    if name in ARITHMETIC:
        wrong &= ~(np.isnan(floats(got)) & np.isnan(floats(wanted)))
    rows = zip(*(operand[wrong][:9].tolist() for operand in (a, b, got, wanted)), strict=True)
    return ["{} {:#010x} {:#010x}: {:#010x}, not {:#010x}".format(name, *row) for row in rows]


ROUTINES = [*ARITHMETIC, *OTHERS]


@pytest.mark.parametrize("name", ROUTINES)
def test_special_numbers_give_the_bits_of_ieee_754(name: str, arm: Arm) -> None:
    assert not disagreements(arm, name, *special_pairs())


@pytest.mark.parametrize("n", [20_000, pytest.param(200_000, marks=pytest.mark.heavy)])
@pytest.mark.parametrize("name", ROUTINES)
def test_random_numbers_give_the_bits_of_ieee_754(name: str, n: int, arm: Arm) -> None:
    rng = np.random.default_rng(754)
    pairs = [*random_pairs(rng, n), *([halves(rng, name, n)] if name in ARITHMETIC else [])]
    a, b = (np.concatenate(operands) for operands in zip(*pairs, strict=True))
    assert a.size > 10 * n
    assert not disagreements(arm, name, a, b)
