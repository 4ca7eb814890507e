"""Response of a sampled linear system, against the sums written out."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig_emulator import sampled_response


@pytest.mark.parametrize("states", [1, 2, 3, 7])
def test_response_is_that_of_the_sums_from_left_to_right_to_the_bit_in_any_parts(states: int) -> None:
    draw = np.random.default_rng(states)
    transition = draw.normal(size=(states, states)) / (2 * states)
    response, inputs, start = draw.normal(size=states), draw.normal(size=50), draw.normal(size=states)
    expected, x = [], start.tolist()
    for u in inputs.tolist():
        x = [
            sum((a * b for a, b in zip(row[1:], x[1:], strict=True)), row[0] * x[0]) + gain * u
            for row, gain in zip(transition.tolist(), response.tolist(), strict=True)
        ]
        expected.append(x[0])
    state = start.copy()
    parts = [sampled_response(transition, response, state, part) for part in np.split(inputs, [0, 1, 20])]
    assert np.concatenate(parts).tolist() == expected
    assert state.tolist() == x
