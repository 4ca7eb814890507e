"""Faults of the codes on the way to the estimator: their scale, sign, bytes, digits and limits."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from analogrig.claims.feed import Feed
from analogrig.claims.sample_faults import Mask, Suspect, following, on, previous, previous_or_zero, treat_as_missing
from analogrig.run import Channel

Codes = NDArray[np.float32]
Change = Callable[[Codes], Codes]

HIGH, LOW, TOP = 0xFF00, 0x00FF, 4095

_SCALES = (0.5, 2.0, 0.1, 10.0, 0.25, 4.0, 0.0625, 16.0, 0.01, 100.0, 0.001, 1000.0, 0.00390625, 256.0, -1.0)
_OFFSETS = (1.0, -1.0, 0.5, -0.5, -2048.0, 2048.0, -128.0, -512.0, -32768.0)
_LIMITS = (127, 255, 511, 999, 1000, 1023, 2047, 2048, 3000, 3500, 4000, 4090, 4094, 4095)

_WHICH = ((("u", "y"), "u and y"), (("y",), "y"), (("u",), "u"))
_EITHER = ((("u", "y"), "u or y"), (("y",), "y"), (("u",), "u"))


def code_hypotheses() -> Iterator[Suspect]:
    """Hypotheses about the codes that reach the estimator."""
    for (cause, change), (names, what) in itertools.product(_changes(), _WHICH):
        yield Suspect(f"{what} {cause}", functools.partial(_changed, names, change))
    for (cause, test), (names, what) in itertools.product(_tests(), _EITHER):
        where = functools.partial(_any, names, test)
        yield Suspect(
            f"samples treated as missing where {what} {cause}", functools.partial(on, where, treat_as_missing)
        )
        yield Suspect(f"samples lost where {what} {cause}", functools.partial(on, where, Feed.without))
    for name, (cause, step) in itertools.product(("u", "y"), _MISALIGNED.items()):
        yield Suspect(f"{name} read one byte off: {cause}", functools.partial(_misread, name, step))
    for names, what in _WHICH:
        yield Suspect(
            f"repeated values of {what} lost: a sample equal to the one before is taken for a repetition",
            functools.partial(_without_repetitions, names),
        )


def unit_hypotheses(channels: Mapping[str, Channel]) -> Iterator[Suspect]:
    """Hypotheses that the estimator gets another unit than codes."""
    units = (("volts", 1.0), ("millivolts", 1000.0), ("physical units", 0.0))
    for (unit, factor), (offset, zero) in itertools.product(units, (("", 1.0), (" that are 0 at code 0", 0.0))):
        scales = {}
        for name, channel in channels.items():
            by = factor or channel.unit_per_v
            scales[name] = (np.float32(channel.lsb_v * by), np.float32(zero * channel.low_v * by))
        for names, what in _WHICH:
            yield Suspect(f"{what} in {unit}{offset} instead of codes", functools.partial(_in_units, names, scales))


def _in_units(names: Sequence[str], scales: Mapping[str, tuple[np.float32, np.float32]], feed: Feed) -> Feed:
    return feed.altered(**{name: getattr(feed, name) * scales[name][0] + scales[name][1] for name in names})


def torn(now: Codes, other: Codes, mask: int) -> Codes:
    """Codes with the bits of ``mask`` of others."""
    return (now.astype(np.int64) & ~mask | other.astype(np.int64) & mask).astype(np.float32)


def _changed(names: Sequence[str], change: Change, feed: Feed) -> Feed:
    return feed.altered(**{name: change(getattr(feed, name)) for name in names})


def _any(names: Sequence[str], test: Callable[[Codes], Mask], feed: Feed) -> Mask:
    return np.asarray(np.any([test(getattr(feed, name)) for name in names], axis=0))


# -------------------------------------------------------------------------------------------------------------- changes


def _changes() -> Iterator[tuple[str, Change]]:
    for factor in _SCALES:
        yield f"scaled by {factor:g}", functools.partial(np.multiply, np.float32(factor))
    for offset in _OFFSETS:
        yield f"shifted by {offset:g} codes", functools.partial(np.add, np.float32(offset))
    yield f"inverted: {TOP} - code", lambda x: TOP - x
    yield from _cuts()
    yield "byte-swapped", lambda x: x.astype(np.uint16).byteswap().astype(np.float32)
    for limit in _LIMITS[:-1]:
        yield f"limited to {limit}", functools.partial(np.minimum, np.float32(limit))
    yield "constant: the first sample for ever", lambda x: np.full_like(x, x[0])
    yield "always 0", np.zeros_like
    for number in (2, 3, 4, 8):
        yield f"averaged over {number} samples", functools.partial(_averaged, number)
    for mask, part, rest in ((HIGH, "high", "low"), (LOW, "low", "high")):
        for neighbour, which in (
            (previous, "sample before"),
            (previous_or_zero, "sample before (0 at first)"),
            (following, "next sample"),
        ):
            yield (
                f"torn: {part} byte of the {which}, {rest} byte of this one",
                functools.partial(_torn_with, neighbour, mask),
            )


def _cuts() -> Iterator[tuple[str, Change]]:
    """Changes that keep some of the bits or digits."""
    for bits in (12, 16, 13, 11, 10, 8):  # where several agree, that of the converter
        yield f"read as signed codes of {bits} bits", functools.partial(_signed, bits)
    for bits in (11, 10, 8):
        yield f"cut to the low {bits} bits: the code overflows", functools.partial(_remainder, 1 << bits)
    for bits in (1, 2, 3, 4, 8):
        yield f"without the low {bits} bits", functools.partial(_without_low_bits, bits)
        yield f"shifted right by {bits} bits", functools.partial(_shifted_right, bits)
    for digits in (1, 2, 3):
        yield f"cut to the first {digits} digits", functools.partial(_first_digits, digits)
        yield f"cut to the last {digits} digits", functools.partial(_remainder, 10**digits)


def _signed(bits: int, x: Codes) -> Codes:
    whole = x.astype(np.int64) & (1 << bits) - 1
    return (whole - (whole >> bits - 1 << bits)).astype(np.float32)


def _without_low_bits(bits: int, x: Codes) -> Codes:
    return (x.astype(np.int64) >> bits << bits).astype(np.float32)


def _shifted_right(bits: int, x: Codes) -> Codes:
    return (x.astype(np.int64) >> bits).astype(np.float32)


def _first_digits(digits: int, x: Codes) -> Codes:
    length = np.floor(np.log10(np.maximum(x, 1.0).astype(np.float64)) + 1e-12) + 1.0
    return np.floor(x / 10.0 ** np.maximum(length - digits, 0.0)).astype(np.float32)


def _remainder(of: float, x: Codes) -> Codes:
    return np.remainder(x, np.float32(of))


def _averaged(number: int, x: Codes) -> Codes:
    padded = np.concatenate([np.repeat(x[:1], number - 1), x]).astype(np.float64)
    return (np.convolve(padded, np.ones(number), "valid") / number).astype(np.float32)


def _torn_with(neighbour: Change, mask: int, x: Codes) -> Codes:
    return torn(x, neighbour(x), mask)


# ---------------------------------------------------------------------------------------------------------------- tests


def _tests() -> Iterator[tuple[str, Callable[[Codes], Mask]]]:
    for limit in _LIMITS:
        yield f"is {limit} or more", functools.partial(np.less_equal, np.float32(limit))
    yield "is 0", functools.partial(np.equal, np.float32(0))
    for values, which in (((0,), "of 0"), ((10, 13), "of a line end"), ((0, 10, 13), "of 0 or a line end")):
        yield f"has a low byte {which}", functools.partial(_has_low_byte, values)
        yield f"has a byte {which}", functools.partial(_has_byte, values)


def _has_low_byte(values: Sequence[int], x: Codes) -> Mask:
    return np.isin(x.astype(np.int64) & LOW, values)


def _has_byte(values: Sequence[int], x: Codes) -> Mask:
    return np.asarray(_has_low_byte(values, x) | np.isin(x.astype(np.int64) >> 8, values))


# ------------------------------------------------------------------------------------------------------- bytes in a row


_MISALIGNED = {
    "high byte of u, then low byte of y": 1,
    "low byte of y as low byte, high byte of u as high byte": -1,
}
"""Readings one byte off, with the step through the high byte of u and the low byte of y from the low byte on."""


def _misread(name: str, step: int, feed: Feed) -> Feed:
    low, high = (feed.u.astype(np.int64) >> 8 & LOW, feed.y.astype(np.int64) & LOW)[::step]
    return feed.altered(**{name: low | high << 8})


def _without_repetitions(names: Sequence[str], feed: Feed) -> Feed:
    same = [np.concatenate([[False], np.diff(getattr(feed, name)) == 0]) for name in names]
    return feed.without(np.all(same, axis=0))
