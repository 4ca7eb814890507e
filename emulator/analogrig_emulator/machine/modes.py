"""State space of a machine as long as no amplifier, limiter or diode leaves its middle piece."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine.system import PiecewiseLinear
from analogrig_emulator.errors import CircuitError

Matrix = NDArray[np.float64]


class LinearMode(NamedTuple):
    """State space from one input of a circuit to a node: dx/dt = flow x + driven u, v = reading x + direct u."""

    flow: Matrix  # (n, n) 1/s
    driven: Matrix  # (n,) 1/s
    reading: Matrix  # (n,)
    direct: float


def linear_mode(circuit: PiecewiseLinear, source: str, node: str, sign: float) -> LinearMode:
    """State space of the circuit with every kink in its middle piece; sign: of the node in the output.

    Raises CircuitError for a circuit with multipliers.
    """
    if circuit.products:
        raise CircuitError("a circuit with multipliers has no linear mode")
    n, (row,) = len(circuit.states), circuit.rows([node])
    slopes = np.array([kink.slopes[1] for kink in circuit.kinks])
    phi = slopes[:, None] * np.linalg.solve(np.eye(len(slopes)) - circuit.w_phi * slopes, circuit.cde)
    flow = circuit.abc + circuit.g @ phi
    reading = sign * (circuit.lmn[row] + circuit.v_phi[row] @ phi)
    at = n + circuit.inputs.index(source)
    return LinearMode(flow[:, :n], flow[:, at], reading[:n], float(reading[at]))
