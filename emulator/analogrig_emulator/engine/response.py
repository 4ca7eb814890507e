"""Response of a sampled linear system."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine import library


def sampled_response(
    transition: NDArray[np.float64],
    response: NDArray[np.float64],
    state: NDArray[np.float64],
    inputs: NDArray[np.float64],
) -> NDArray[np.float64]:
    """First state after each sample period, (samples,), for one number of input each.

    transition: (n, n) and response: (n,), of a sample period; n is at most 32. state: (n,), advanced in place.
    """
    inputs = np.ascontiguousarray(inputs, np.float64)
    out = np.empty_like(inputs)
    addresses = [array.ctypes.data for array in (transition, response, inputs, state, out)]
    library.load().engine_follow(state.size, inputs.size, *addresses)
    return out
