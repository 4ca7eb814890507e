"""Ideal LUCIDAC: the equations of a configuration with quantised coefficients, solved by scipy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from analogrig_emulator.lucidac.configuration import (
    FAST,
    INTEGRATORS,
    LANES,
    OUTPUTS,
    SLOW,
    Configuration,
    Integrator,
    LucidacLane,
    constant_output,
)

Values = NDArray[np.float64]

_STEPS = 2048
_FIRST_STEP_S = 1e-6
"""The step that scipy would try first overflows where a fast element has settled."""
_PASSES = 3
"""Passes that settle a chain of multipliers and identities."""


def ideal_solution(configuration: Configuration, samples: int, rate_hz: float, start: Values | None = None) -> Values:
    """Values of the converter's outputs in machine units at k / rate_hz, (samples, channels).

    start: values of the first integrators at the beginning, by default their initial conditions.
    """
    sources = np.zeros((OUTPUTS, OUTPUTS))
    constants = np.zeros(OUTPUTS)
    for number, lane in configuration.lanes.items():
        weight = round(lane.factor * _STEPS) / _STEPS * lane.gain
        if configuration.constant and lane.source == constant_output(number):
            constants[lane.target] += weight * configuration.constant
        elif lane.source is not None:
            sources[lane.target, lane.source] += weight

    def outputs(y: Values) -> Values:
        out = np.concatenate((y, np.zeros(OUTPUTS - INTEGRATORS)))
        for _ in range(_PASSES):
            s = sources @ out + constants
            out[8:12] = s[8::2] * s[9::2]
            out[12:] = -s[8:12]
        return out

    k0 = np.array([each.k0 for each in configuration.integrators], np.float64)
    initial = np.array([-each.ic for each in configuration.integrators])
    if start is not None:
        initial[: len(start)] = start
    instants_s = np.arange(samples) / rate_hz

    def slope(_: float, y: Values) -> Values:
        return np.asarray(-k0 * (sources @ outputs(y) + constants)[:INTEGRATORS])

    settings = {"method": "DOP853", "rtol": 1e-7, "atol": 1e-9, "first_step": _FIRST_STEP_S}
    solved = solve_ivp(slope, (0.0, instants_s[-1]), initial, t_eval=instants_s, **settings)
    return np.array([outputs(y)[list(configuration.adc)] for y in solved.y.T])


def random_configuration(rng: np.random.Generator) -> Configuration:
    """Configuration of up to eight integrators and four multipliers with random lanes, most of them stable."""
    count, products = int(rng.integers(2, INTEGRATORS + 1)), int(rng.integers(0, 4))
    targets = [*range(count), *range(8, 8 + 2 * products)]
    sources = [*range(count), *range(8, 8 + products), *([12, 13] if products else [])]
    constant = float(rng.choice([0.0, 1.0, -0.1]))
    lanes = {i: LucidacLane(i, i, float(rng.uniform(0.05, 0.5))) for i in range(count)}
    for number in range(count, int(rng.integers(count + len(targets), LANES + 1))):
        source = constant_output(number) if constant and rng.random() < 0.15 else int(rng.choice(sources))
        target = targets[(number - count) % len(targets)]
        if source >= 8 and target >= 8 and source != constant_output(number):
            source = int(rng.integers(count))  # a loop without an integrator need not have a solution
        lanes[number] = LucidacLane(source, target, float(rng.uniform(-0.6, 0.6)), bool(rng.random() < 0.1))
    integrators = [
        Integrator(float(rng.uniform(-0.7, 0.7)), FAST if rng.random() < 0.8 else SLOW) for _ in range(INTEGRATORS)
    ]
    return Configuration(tuple(integrators), lanes, constant, adc=tuple(sources[:8]))
