"""Standard normal numbers beside numpy's own."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig_emulator.engine import normal
from analogrig_emulator.engine.normal import standard_normal


def test_numbers_and_generator_are_those_of_numpy_to_the_bit() -> None:
    """Three million numbers: some 30,000 are not accepted at once, and some 800 lie in the tail."""
    own, numpys = (np.random.default_rng([2026, 2]) for _ in range(2))
    for shape in ((1,), (7, 4), (0, 4), (750_000, 4)):
        assert standard_normal(own, shape).tobytes() == numpys.standard_normal(shape).tobytes()
    assert own.bit_generator.state == numpys.bit_generator.state


def test_half_a_word_kept_by_the_generator_stays() -> None:
    own, numpys = (np.random.default_rng(3) for _ in range(2))
    for rng, numbers in ((own, standard_normal(own, (5,))), (numpys, numpys.standard_normal(5))):
        assert numbers.shape == (5,)
        rng.integers(10, dtype=np.uint32)
    assert standard_normal(own, (5,)).tobytes() == numpys.standard_normal(5).tobytes()
    assert own.integers(2**32, dtype=np.uint32) == numpys.integers(2**32, dtype=np.uint32)


@pytest.mark.parametrize("bits", [np.random.Philox, np.random.PCG64DXSM, np.random.MT19937])
def test_other_generators_are_numpys(bits: type[np.random.BitGenerator]) -> None:
    own, numpys = (np.random.Generator(bits(5)) for _ in range(2))
    assert standard_normal(own, (100,)).tobytes() == numpys.standard_normal(100).tobytes()


def test_every_boundary_of_a_box_is_numpys() -> None:
    """A state is chosen such that the next word is at the boundary, or just below it."""
    ziggurat = normal._ziggurat()
    if ziggurat is None:
        pytest.skip("no integers of 128 bits, or numpy exports no function: numpy computes every number")
    multiplier = 0x2360ED051FC65DA44385DF649FCCF645
    inverse, whole = pow(multiplier, -1, 1 << 128), (1 << 128) - 1
    for box, limit in enumerate(ziggurat.limit.tolist()):
        for distance in {max(limit - 1, 0), min(limit, (1 << 52) - 1)}:
            word = distance << 9 | 256 | box
            own, numpys = (np.random.default_rng(1) for _ in range(2))
            for rng in (own, numpys):
                state = rng.bit_generator.state
                state["state"]["state"] = (word - state["state"]["inc"]) * inverse & whole
                rng.bit_generator.state = state
            assert standard_normal(own, (3,)).tobytes() == numpys.standard_normal(3).tobytes()
            assert own.bit_generator.state == numpys.bit_generator.state


def test_without_numpys_function_numpy_computes_every_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(normal, "_ziggurat", lambda: None)
    own, numpys = (np.random.default_rng(4) for _ in range(2))
    assert standard_normal(own, (50, 2)).tobytes() == numpys.standard_normal((50, 2)).tobytes()
