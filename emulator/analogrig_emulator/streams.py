"""Numbers of the random streams default_rng([seed, stream]), the first ones of many seeds at once.

They are numpy's to the bit. To make a generator of numpy for each seed takes as long as some hundred samples.
"""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.random import _generator
from numpy.typing import NDArray

from analogrig_emulator.engine import binding


def uniforms(seeds: Sequence[int], stream: int, count: int) -> NDArray[np.float64]:
    """Uniform numbers from 0 to 1, as of random(count): (seeds, count)."""
    if not binding.has_streams():
        return np.array([each.random(count) for each in _generators(seeds, stream)]).reshape(len(seeds), count)
    states, out = _states(seeds, stream), np.empty((len(seeds), count))
    binding.load().engine_draw(*out.shape, states.ctypes.data, out.ctypes.data)
    return out


def normals(seeds: Sequence[int], stream: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Standard normal numbers, as of standard_normal(shape): (seeds, *shape)."""
    if not binding.has_streams():
        numbers = [each.standard_normal(shape) for each in _generators(seeds, stream)]
        return np.array(numbers).reshape(len(seeds), *shape)
    return _next_normals(_states(seeds, stream), shape)


def _generators(seeds: Sequence[int], stream: int) -> list[np.random.Generator]:
    """Streams of an engine without its fast parts."""
    return [np.random.default_rng([seed, stream]) for seed in seeds]


class NormalStream:
    """Standard normal numbers of one seed, in a third of the time of numpy's generator."""

    def __init__(self, seed: int, stream: int) -> None:
        self._generator = None if binding.has_streams() else _generators([seed], stream)[0]
        self._states = np.empty((0, 4), np.uint64) if self._generator else _states([seed], stream)

    def standard_normal(self, size: tuple[int, ...], /) -> NDArray[np.float64]:
        """The next numbers: (*size,)."""
        if self._generator:
            return self._generator.standard_normal(size)
        return _next_normals(self._states, size).reshape(size)


def _next_normals(states: NDArray[np.uint64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """The next numbers of each stream, (streams, *shape); the states are then those after them."""
    out, (normal, width, limit) = np.empty((len(states), *shape)), _ziggurat()
    table = (normal, width.ctypes.data, limit.ctypes.data)
    binding.load().engine_normals(*table, len(states), math.prod(shape), states.ctypes.data, out.ctypes.data)
    return out


@functools.cache
def _ziggurat() -> tuple[int, NDArray[np.float64], NDArray[np.uint64]]:
    """Address of numpy's function for normal numbers, and the widths and limits of its boxes.

    Numpy exports the function for such use (Extending via CFFI).
    """
    function = ctypes.CDLL(_generator.__file__).random_standard_normal
    address = ctypes.cast(function, ctypes.c_void_p).value or 0
    width, limit = np.empty(256), np.empty(256, np.uint64)
    binding.load().engine_learn(address, width.ctypes.data, limit.ctypes.data)
    return address, width, limit


def _states(seeds: Sequence[int], stream: int) -> NDArray[np.uint64]:
    """State and increment of each stream, high and low half: (seeds, 4)."""
    words, states = np.array(seeds, np.uint64), np.empty((len(seeds), 4), np.uint64)
    binding.load().engine_seed(words.size, words.ctypes.data, stream, states.ctypes.data)
    return states
