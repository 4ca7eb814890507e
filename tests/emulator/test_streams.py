"""The streams of many seeds are those of numpy, to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig_emulator import normals, uniforms

SEEDS = [0, 1, 1995, 2**32 - 1, 2**32, 2**40 + 5, 2**63 - 1]


@pytest.mark.parametrize("stream", [0, 1, 4, 2**32 - 1])
def test_numbers_of_many_seeds_are_those_of_a_generator_for_each(stream: int) -> None:
    generators = [np.random.default_rng([seed, stream]) for seed in SEEDS]
    expected = np.stack([generator.random(9) for generator in generators])
    assert uniforms(SEEDS, stream, 9).tobytes() == expected.tobytes()
    generators = [np.random.default_rng([seed, stream]) for seed in SEEDS]
    expected = np.stack([generator.standard_normal((50, 4)) for generator in generators])
    assert normals(SEEDS, stream, (50, 4)).tobytes() == expected.tobytes()
