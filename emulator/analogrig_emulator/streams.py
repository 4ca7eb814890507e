"""First numbers of the random streams default_rng([seed, stream]) of many seeds.

They are numpy's to the bit. To make a generator of numpy for each seed takes as long as some hundred samples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine import library


def uniforms(seeds: Sequence[int], stream: int, count: int) -> NDArray[np.float64]:
    """Uniform numbers from 0 to 1, as of random(count): (seeds, count)."""
    states, out = _states(seeds, stream), np.empty((len(seeds), count))
    library.load().engine_draw(*out.shape, states.ctypes.data, out.ctypes.data)
    return out


def normals(seeds: Sequence[int], stream: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Standard normal numbers, as of standard_normal(shape): (seeds, *shape)."""
    bits, out = np.random.PCG64(0), np.empty((len(seeds), *shape))
    generator = np.random.Generator(bits)
    for row, (high, low, increment_high, increment_low) in zip(out, _states(seeds, stream).tolist(), strict=True):
        bits.state = {
            "bit_generator": "PCG64",
            "state": {"state": high << 64 | low, "inc": increment_high << 64 | increment_low},
            "has_uint32": 0,
            "uinteger": 0,
        }
        generator.standard_normal(out=row)
    return out


def _states(seeds: Sequence[int], stream: int) -> NDArray[np.uint64]:
    """State and increment of each stream, high and low half: (seeds, 4)."""
    words, states = np.array(seeds, np.uint64), np.empty((len(seeds), 4), np.uint64)
    library.load().engine_seed(words.size, words.ctypes.data, stream, states.ctypes.data)
    return states
