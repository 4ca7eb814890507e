"""The streams of many seeds are those of numpy, to the bit."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from analogrig_emulator import NormalStream, normals, uniforms
from analogrig_emulator.engine import binding

SEEDS = [0, 1, 1995, 2**32 - 1, 2**32, 2**40 + 5, 2**63 - 1]


@pytest.mark.parametrize("stream", [0, 1, 4, 2**32 - 1])
def test_numbers_of_many_seeds_are_those_of_a_generator_for_each(stream: int) -> None:
    generators = [np.random.default_rng([seed, stream]) for seed in SEEDS]
    expected = np.stack([generator.random(9) for generator in generators])
    assert uniforms(SEEDS, stream, 9).tobytes() == expected.tobytes()
    generators = [np.random.default_rng([seed, stream]) for seed in SEEDS]
    expected = np.stack([generator.standard_normal((50, 4)) for generator in generators])
    assert normals(SEEDS, stream, (50, 4)).tobytes() == expected.tobytes()


def test_many_normal_numbers_are_those_of_numpy() -> None:
    expected = np.stack([np.random.default_rng([seed, 4]).standard_normal(100_000) for seed in SEEDS])
    assert np.abs(expected).max() > 3.7  # the tail
    assert normals(SEEDS, 4, (100_000,)).tobytes() == expected.tobytes()


@pytest.mark.parametrize("seed", SEEDS)
def test_normal_numbers_go_on_as_those_of_numpy(seed: int) -> None:
    ours, generator = NormalStream(seed, 2), np.random.default_rng([seed, 2])
    for shape in ((3, 4), (1000, 4), (0, 4), (1, 4), (20_000, 4)):
        assert ours.standard_normal(shape).tobytes() == generator.standard_normal(shape).tobytes()


def test_a_function_that_makes_numbers_otherwise_is_asked_for_each() -> None:
    normal = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p)(lambda _: 0.25)
    address = ctypes.cast(normal, ctypes.c_void_p)
    width, limit, states, out = np.empty(256), np.ones(256, np.uint64), np.array([1, 2, 3, 5], np.uint64), np.empty(9)
    binding.load().engine_learn(address, width.ctypes.data, limit.ctypes.data)
    assert not limit.any()
    table = (address, width.ctypes.data, limit.ctypes.data)
    binding.load().engine_normals(*table, 1, 9, states.ctypes.data, out.ctypes.data)
    assert (out == 0.25).all()
