"""The points that a plot of a run shows: every sample of a short run, minima and maxima of a long one.

A long run is divided into pieces. Near a moment of interest a piece holds every sample. Elsewhere two points stand for
a bucket of consecutive samples: the minimum and the maximum, so that no peak is lost. Zoomed out, a bucket is narrower
than a pixel and the plot is the same as with all samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.run import CHUNK_SAMPLES

MOST_POINTS = 100_000
"""A run of at most so many samples is shown sample by sample."""

_MOST_BUCKETS = 25_000
_MOST_NEAR_MOMENTS = 50_000
"""Samples shown near all moments together."""
_MOST_MOMENTS = 100
_LONGEST_REACH = 1_000
"""Samples on either side of a moment."""


class Piece(NamedTuple):
    """The samples ``start`` <= k < ``end``, in buckets of ``size`` samples; the last bucket may be shorter."""

    start: int
    end: int
    size: int
    """1: the points are the samples themselves. Otherwise each bucket has two points, at its start and its middle."""

    @property
    def points(self) -> int:
        return self.end - self.start if self.size == 1 else 2 * -(-(self.end - self.start) // self.size)

    def parts(self) -> Iterator[slice]:
        """Whole buckets, about as many samples at a time as fit a chunk."""
        step = max(1, CHUNK_SAMPLES // self.size) * self.size
        for first in range(self.start, self.end, step):
            yield slice(first, min(first + step, self.end))


def pieces(samples: int, moments: Iterable[int]) -> tuple[Piece, ...]:
    """Division of a run; ``moments`` are the samples of interest, the most important first."""
    if samples <= MOST_POINTS:
        return (Piece(0, samples, 1),)
    size = -(-samples // _MOST_BUCKETS)
    out: list[Piece] = []
    end = 0
    for begin, last in [*_near(moments, samples), (samples, samples)]:
        first = begin - ((begin - end) % size == 1)  # a bucket of one sample has no two points
        if end < first:
            out.append(Piece(end, first, size))
        if first < last:
            out.append(Piece(first, last, 1))
        end = last
    return tuple(out)


def _near(moments: Iterable[int], samples: int) -> list[tuple[int, int]]:
    """Spans (first, end) around the most important moments, in order and apart."""
    chosen = list(dict.fromkeys(moments))[:_MOST_MOMENTS]
    reach = min(_LONGEST_REACH, _MOST_NEAR_MOMENTS // (2 * len(chosen))) if chosen else 0
    out: list[tuple[int, int]] = []
    for moment in sorted(chosen):
        first, end = max(0, moment - reach), min(samples, moment + reach)
        if out and first <= out[-1][1] + 1:
            first = out.pop()[0]
        out.append((first, end))
    return out


def condense(values: NDArray[Any], size: int) -> NDArray[Any]:
    """(p, ...): minimum and maximum in turn of each bucket of (n, ...); NaN for a bucket without a finite value."""
    if size == 1:
        return values
    if values.dtype.kind == "f":
        values = np.where(np.isfinite(values), values, np.nan)
    starts = range(0, len(values), size)
    out = np.empty((2 * len(starts), *values.shape[1:]), values.dtype)
    out[0::2] = np.fmin.reduceat(values, starts, axis=0)
    out[1::2] = np.fmax.reduceat(values, starts, axis=0)
    return out


def condense_clipping(codes: NDArray[np.uint16], clipped: NDArray[np.bool_], size: int) -> NDArray[np.bool_]:
    """(p, c): the points of ``condense(codes, size)`` that were clipped; a clipped code is an end of its range."""
    if size == 1:
        return clipped
    starts = range(0, len(codes), size)
    least, greatest = np.minimum.reduceat(codes, starts, axis=0), np.maximum.reduceat(codes, starts, axis=0)
    bucket = np.arange(len(codes)) // size
    out = np.empty((2 * len(starts), codes.shape[1]), np.bool_)
    out[0::2] = np.logical_or.reduceat(clipped & (codes == least[bucket]), starts, axis=0)
    out[1::2] = np.logical_or.reduceat(clipped & (codes == greatest[bucket]), starts, axis=0)
    return out


def spread(values: Sequence[int], samples: int, most: int) -> list[int]:
    """At most ``most`` of the samples ``values``, in order: the first of each stretch of the run."""
    if len(values) <= most:
        return sorted(values)
    ordered = np.sort(np.asarray(values, np.int64))
    _, firsts = np.unique(ordered * most // samples, return_index=True)
    return [int(each) for each in ordered[firsts]]
