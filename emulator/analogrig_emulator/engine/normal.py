"""Standard normal numbers of numpy's generators, to the bit and faster."""

from __future__ import annotations

import ctypes
import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.random import _generator
from numpy.typing import NDArray

from analogrig_emulator.engine import library

_BOXES = 256
_HALF = (1 << 64) - 1


class _Ziggurat(NamedTuple):
    """numpy's function, and the table that engine_normal_learn() has found in it."""

    function: int
    width: NDArray[np.float64]
    limit: NDArray[np.uint64]
    addresses: tuple[int, int, int]


@functools.cache
def _ziggurat() -> _Ziggurat | None:
    """None if numpy does not export its function, or this processor has no integers of 128 bits."""
    try:
        exported = ctypes.CDLL(_generator.__file__).random_standard_normal
    except (AttributeError, OSError):
        return None
    function = ctypes.cast(exported, ctypes.c_void_p).value or 0
    width, limit = np.empty(_BOXES), np.empty(_BOXES, np.uint64)
    addresses = (function, width.ctypes.data, limit.ctypes.data)
    return _Ziggurat(function, width, limit, addresses) if library.load().engine_normal_learn(*addresses) else None


def standard_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Numbers of rng.standard_normal(shape), to the bit; rng advances likewise. A PCG64 takes half the time."""
    ziggurat, bits = _ziggurat(), rng.bit_generator
    if ziggurat is None or type(bits) is not np.random.PCG64:
        return rng.standard_normal(shape)
    now: Any = bits.state
    state, increment = now["state"]["state"], now["state"]["inc"]
    halves = (ctypes.c_uint64 * 4)(state >> 64, state & _HALF, increment >> 64, increment & _HALF)
    numbers = np.empty(shape)
    library.load().engine_normal_fill(*ziggurat.addresses, halves, numbers.size, numbers.ctypes.data)
    now["state"]["state"] = halves[0] << 64 | halves[1]
    bits.state = now
    return numbers
