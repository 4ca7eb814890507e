"""Other readings of a signal's bits: a wrong byte order, sign or type in a DBC shows in the course of the values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

_LEAST = 16
"""Frames from which on a course shows more than chance."""

_ROUGH, _SMOOTHER = 0.15, 0.35
"""Mean step over standard deviation from which on a course is rough (random bits: 1.15), and the share of it that a
reading leaves which fits."""

_RANDOM = 0.5
"""Mean step over standard deviation of whole numbers that may be random bits."""

_UNWRAPPED = 0.02
"""Total variation with the right sign over that with the wrong one: without the jumps between the ends of the range."""

_SANE = (1e-9, 1e9)
"""Magnitudes of plausible floats."""

_LARGE = 1e5
"""Physical value from which on a whole number may be a float that was misread."""

_FLOAT_BITS = 0x30000000, 0x4F000000
"""Bits of 5e-10 and of 2e9 as floats of 32 bits."""

_INFINITE_BITS, _NAN_BITS = 0x7F800000, 0x7FC00000
"""Bits of the float infinity, and of the usual one that is no number."""

_FLOATS = {16: ">f2", 32: ">f4", 64: ">f8"}


class BitLayout(NamedTuple):
    """Bits of a signal in its message, and their meaning."""

    start: int
    length: int
    is_little: bool
    is_signed: bool
    is_float: bool
    exchanges_words: bool = False
    """True if the halves of 32 bits are exchanged."""

    def bits(self) -> list[int]:
        """Its bits, the highest first, counted from the highest bit of the first byte."""
        if self.is_little:
            return [_mirrored(bit) for bit in reversed(range(self.start, self.start + self.length))]
        return list(range(_mirrored(self.start), _mirrored(self.start) + self.length))


def _mirrored(bit: int) -> int:
    """Bit counted from the other end of its byte."""
    return 8 * (bit // 8) + 7 - bit % 8


def layout_of(signal: Any) -> BitLayout:
    """BitLayout of a signal of cantools."""
    is_little = signal.byte_order == "little_endian"
    return BitLayout(signal.start, signal.length, is_little, bool(signal.is_signed), bool(signal.is_float))


def raw_values(frames: Sequence[bytes], layout: BitLayout) -> Values:
    """Values before scaling in frames of one length, which hold the signal."""
    bits = np.unpackbits(np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), -1), axis=1)
    chosen = bits[:, layout.bits()]
    if layout.exchanges_words:
        chosen = np.roll(chosen, layout.length // 2, axis=1)
    if layout.is_float and layout.length in _FLOATS:
        with np.errstate(invalid="ignore"):
            packed = np.ascontiguousarray(np.packbits(chosen, axis=1))
            return np.asarray(packed.view(_FLOATS[layout.length])[:, 0], np.float64)
    weights = 2.0 ** np.arange(layout.length - 1, -1, -1)
    if layout.is_signed:
        weights[0] = -weights[0]
    return np.asarray(chosen @ weights)


def misreading(frames: Sequence[bytes], layout: BitLayout, scale: float) -> str:
    """Clause that names a reading which fits the frames far better than ``layout``; empty if there is none.

    :param scale: that of the DBC.
    """
    if len(frames) < _LEAST or len({len(frame) for frame in frames}) > 1:
        return ""
    stated = raw_values(frames, layout)
    finite = np.abs(stated[np.isfinite(stated)])
    if len(finite) and not np.any(finite):
        return ""
    is_large = bool(len(finite) and np.median(finite) * abs(scale) > _LARGE)
    found = []
    for name, other in _others(layout, 8 * len(frames[0])):
        values = raw_values(frames, other)
        if other.is_float and not layout.is_float and not is_large:
            continue
        if _is_better(stated, layout, values, other):
            found.append((_roughness(values) if layout.is_float else 0.0, name, values))
    if not found:
        return ""
    _, name, values = min(found, key=lambda each: each[0])
    return f"raw values from {_span(stated)} by the DBC, but {name} from {_span(values)}"


def _others(layout: BitLayout, bits: int) -> Iterator[tuple[str, BitLayout]]:
    """Other readings of the same bits, or of those at the same start in the other order."""
    start, length = layout.start, layout.length
    if length % 8 == 0 and length > 8:
        if layout.is_little and start % 8 == 0:
            yield "in the other byte order", layout._replace(start=start + 7, is_little=False)
        elif not layout.is_little and start % 8 == 7:
            yield "in the other byte order", layout._replace(start=start - 7, is_little=True)
    if length > 8 and max(start, _mirrored(start)) + length <= bits:
        yield f"with the other byte order from bit {start} on", layout._replace(is_little=not layout.is_little)
    if not layout.is_float:
        yield (
            f"as {'an unsigned' if layout.is_signed else 'a signed'} number",
            layout._replace(is_signed=not layout.is_signed),
        )
    if length == 32 and layout.is_float:
        yield "with exchanged words of 16 bits", layout._replace(exchanges_words=True)
    if length == 32:
        yield (
            ("as a whole number" if layout.is_float else "as a float"),
            layout._replace(is_float=not layout.is_float, is_signed=True),
        )


def _is_better(stated: Values, layout: BitLayout, values: Values, other: BitLayout) -> bool:
    """True if another reading fits the frames far better."""
    if layout.is_float and other.is_float and len(np.unique(stated)) == 1:
        return False  # the bytes of one number are plausible in some other order by chance
    if other.is_float or layout.is_float:
        return _is_sane(values, other) and not _is_sane(stated, layout)
    if other.is_signed != layout.is_signed:
        return _is_unwrapped(stated, values, 2.0**layout.length)
    if not np.any(stated % 256.0) and len(np.unique(stated)) >= _LEAST // 2:
        return bool(np.any(values % 256.0))  # the last byte is never used: it is the first
    return _roughness(stated) > _ROUGH and _roughness(values) < _SMOOTHER * _roughness(stated)


def _is_unwrapped(stated: Values, values: Values, width: float) -> bool:
    """True if another sign removes the jumps between the ends of the range, ``width`` apart."""
    if len(np.unique(stated)) <= _LEAST or not np.ptp(values):
        return False
    is_continuous = np.ptp(values) > 0.2 * width and np.abs(np.diff(values)).max() < 0.1 * width
    jumps = bool(np.abs(np.diff(stated)).max() > 0.9 * width)
    return (jumps and bool(is_continuous)) or _variation(values) < _UNWRAPPED * _variation(stated)


def _is_sane(values: Values, layout: BitLayout) -> bool:
    """True if nearly all values are plausible, of floats by their magnitude, of whole numbers by not being floats."""
    if not layout.is_float:
        magnitudes = np.where(values < 0, values + 2.0**31, np.where(values >= 2.0**31, values - 2.0**31, values))
        is_float = (magnitudes > _FLOAT_BITS[0]) & (magnitudes < _FLOAT_BITS[1])
        is_float |= (values >= _INFINITE_BITS) | (magnitudes == _NAN_BITS)
        return bool(np.mean(is_float) < 0.1) and _roughness(values) < _RANDOM
    finite = np.abs(values[np.isfinite(values)])
    good = (finite == 0.0) | ((finite > _SANE[0]) & (finite < _SANE[1]))
    return bool(np.any(finite)) and bool(np.sum(good) > 0.95 * len(values))


def _roughness(values: Values) -> float:
    """Mean step over the standard deviation; 0 for a constant."""
    spread = float(np.std(values))
    return float(np.mean(np.abs(np.diff(values)))) / spread if spread > 0.0 else 0.0


def _variation(values: Values) -> float:
    return float(np.sum(np.abs(np.diff(values))))


def _span(values: Values) -> str:
    finite = values[np.isfinite(values)]
    return f"{finite.min():.4g} to {finite.max():.4g}" if len(finite) else "none to none"
