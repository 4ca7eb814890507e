"""Words that the suites share: arrays of voltages, a code of the card, the oracle, the changes of the thesis."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator import TICKS_PER_SAMPLE, Edges, PotTurn

NgSpice = Callable[[str, Sequence[str], int], NDArray[np.float64]]
"""The fixture of conftest.py: (deck, nodes, samples) -> voltages of the nodes at every sample, (samples, nodes)."""

Volts = NDArray[np.float64]
LSB_V = 10.0 / 4096
SAMPLE_RATE_HZ = 20e3
AMPLIFIERS = ("u1", "u2", "u3", "u4", "u5")
THESIS_CHANGES = (
    PotTurn(200, {"K": 18000.0}),
    PotTurn(400, {"B": 3453.0}),
    PotTurn(500, {"B": 2123.0, "K": 20000.0}),
    PotTurn(600, {"M": 30.0}),
)


def steps(*changes: tuple[float, float]) -> dict[str, Edges]:
    """Edges of V1 at (instant in samples, level)."""
    instants, levels_v = np.array(changes).T
    return {"V1": Edges(np.rint(instants * TICKS_PER_SAMPLE).astype(np.int64), levels_v)}
