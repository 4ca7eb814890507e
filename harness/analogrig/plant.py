"""Plant model: a mass, a damper and a spring, in continuous time and discretised.

The harness uses this model for the information bounds and to convert estimates to physical units. It never produces
the samples of a run.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig.datasheet import ModelOrders

PARAMETERS = ("M", "B", "K")
"""Names of the physical parameters, in the order of every array of them."""

MAX_SAMPLES = 10_000_000
"""Largest number of samples. A run is kept in memory; tests/harness/test_long_runs.py bounds its size."""

MAX_CHANGES = 1_000
"""Largest number of changes, and of records, in a run. The bounds of each take milliseconds to compute."""

UNITS = {"M": "kg", "B": "N s/m", "K": "N/m"}

LEAST_PARAMETER, MOST_PARAMETER = 1e-12, 1e12
"""Limits of each parameter in its unit, exclusive."""


@dataclass(frozen=True)
class Plant:
    """Mass in kg, damping in N s/m and stiffness in N/m of M x'' + B x' + K x = F (thesis Equ 2.3).

    ValueError: a parameter is not positive, or 1e12 or more.
    """

    mass_kg: float
    damping_n_s_per_m: float
    stiffness_n_per_m: float

    def __post_init__(self) -> None:
        for name, value in self.parameters().items():
            if not LEAST_PARAMETER < value < MOST_PARAMETER:
                limits = f"more than {LEAST_PARAMETER:g} and less than {MOST_PARAMETER:g}"
                raise ValueError(f"{name} must be {limits}, not {value:g}")

    def parameters(self) -> dict[str, float]:
        """Values by their short names ``M``, ``B``, ``K``."""
        return dict(zip(PARAMETERS, (self.mass_kg, self.damping_n_s_per_m, self.stiffness_n_per_m), strict=True))

    def scaled(self, name: str, factor: float) -> Plant:
        """The same plant with parameter ``name`` (``M``, ``B`` or ``K``) multiplied by ``factor``."""
        values = self.parameters()
        return Plant(*(value * factor if name == each else value for each, value in values.items()))

    def interpolate(self, other: Plant, part: float) -> Plant:
        """Plant at the fraction ``part`` (0..1) of a ramp to ``other``: linear in 1/M, B and K, as the pots set them.

        The load of the pots is neglected: it moves a coefficient by at most 2 % if the dials turn linearly.
        """
        mass_kg = 1.0 / ((1.0 - part) / self.mass_kg + part / other.mass_kg)
        damping = self.damping_n_s_per_m + part * (other.damping_n_s_per_m - self.damping_n_s_per_m)
        stiffness = self.stiffness_n_per_m + part * (other.stiffness_n_per_m - self.stiffness_n_per_m)
        return Plant(mass_kg, damping, stiffness)

    def changes_to(self, other: Plant) -> dict[str, tuple[float, float]]:
        """Parameters in which ``other`` differs, as ``{name: (before, after)}``."""
        pairs = zip(PARAMETERS, self.parameters().values(), other.parameters().values(), strict=True)
        return {name: (before, after) for name, before, after in pairs if before != after}


@dataclass(frozen=True)
class Segment:
    """Plant from a sample on, until the next segment. Instants are sample indices."""

    start: int
    """First sample, or the likeliest one if estimated from the samples."""
    plant: Plant
    ramp_n: int = 0
    """Samples from ``start`` to the end of the ramp; 0: a jump."""
    start_low: int | None = None
    """Earliest possible ``start``; None: ``start`` is exact."""
    start_high: int | None = None
    """Latest possible ``start``; None: ``start`` is exact."""
    end_low: int | None = None
    """Earliest possible end of the ramp; None: ``ramp_n`` is exact."""
    end_high: int | None = None
    """Latest possible end of the ramp; None: ``ramp_n`` is exact."""
    unseen: str = ""
    """Reason that the change could not be found in the samples; empty otherwise."""

    def earliest(self) -> Self:
        """The same segment with its change at the earliest possible instants."""
        return self._move_to(self.start_low, self.end_low)

    def latest(self) -> Self:
        """The same segment with its change at the latest possible instants."""
        return self._move_to(self.start_high, self.end_high)

    def _move_to(self, start: int | None, end: int | None) -> Self:
        start = self.start if start is None else start
        ramp_n = self.ramp_n if end is None else max(0, end - start)
        return dataclasses.replace(self, start=start, ramp_n=ramp_n)

    @property
    def is_exact(self) -> bool:
        """True if start and end are known, not estimated from the samples."""
        return self.start_low is None and self.start_high is None and self.end_low is None and self.end_high is None


State = tuple[float, float]
"""Displacement [m] and velocity [m/s]."""

AT_REST: State = (0.0, 0.0)


@dataclass(frozen=True)
class SampledPlant:
    """Plant discretised by an exact zero-order hold of the force.

    Plain floats: numpy takes ten times as long for a 2 x 2 product.
    """

    transition: tuple[float, float, float, float]
    """Transition matrix of (x, v), row by row."""
    response: tuple[float, float]
    """Change of x and v per newton."""

    @classmethod
    def from_plant(cls, plant: Plant, period_s: float) -> SampledPlant:
        """Discretise with ``period_s`` of problem time (Astrom and Wittenmark, Computer-Controlled Systems, 2.3)."""
        return _sampled(plant, period_s)

    @classmethod
    def from_plants(cls, plants: Sequence[Plant], period_s: float) -> list[SampledPlant]:
        """Discretise many plants at once; equal to ``from_plant`` to the bit."""
        parameters = np.array([(each.mass_kg, each.damping_n_s_per_m, each.stiffness_n_per_m) for each in plants])
        return [
            cls(transition=(xx, xv, vx, vv), response=(xf, vf))
            for (xx, xv, xf), (vx, vv, vf) in discretise(parameters.reshape(-1, 3), period_s).tolist()
        ]

    @functools.cached_property
    def matrices(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Transition (2, 2) and response (2,)."""
        return np.array(self.transition).reshape(2, 2), np.array(self.response)

    def next(self, state: State, force_n: float) -> State:
        """State one sample later."""
        x, v = state
        xx, xv, vx, vv = self.transition
        xf, vf = self.response
        return (xx * x + xv * v + xf * force_n, vx * x + vv * v + vf * force_n)


@functools.lru_cache(maxsize=64)
def _sampled(plant: Plant, period_s: float) -> SampledPlant:
    """Discretised plant; the trials of a campaign ask for the same few."""
    return SampledPlant.from_plants([plant], period_s)[0]


def discretise(parameters: NDArray[np.float64], period_s: float) -> NDArray[np.float64]:
    """Discretise plants (n, 3) of M, B, K: (n, 2, 3), the rows of x and v from x, v and force."""
    m, b, k = parameters.T
    generators = np.zeros((len(parameters), 3, 3))
    generators[:, 0, 1] = 1.0
    generators[:, 1] = np.stack([-k / m, -b / m, 1.0 / m], axis=1)
    return _exponentials(generators * period_s)[:, :2]


def _exponentials(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix exponentials of (k, n, n), of the same shape. Importing scipy.linalg would take longer than numpy."""
    norms = np.abs(matrices).sum(axis=2).max(axis=1)
    squarings = np.maximum(0, np.frexp(norms)[1] + 4)
    out = np.empty_like(matrices)
    for count in np.unique(squarings).tolist():
        alike = squarings == count
        out[alike] = _exponential(matrices[alike], count)
    return out


def _exponential(matrices: NDArray[np.float64], squarings: int) -> NDArray[np.float64]:
    """Matrix exponentials by scaling, a Taylor series, and squaring; relative error near 1e-15 for these norms."""
    scaled = matrices / 2.0**squarings
    term = result = np.eye(matrices.shape[-1])
    for order in range(1, 13):
        term = term @ scaled / order
        result = result + term
    for _ in range(squarings):
        result = result @ result
    return np.asarray(result)


def physical_parameters(
    theta: NDArray[np.floating], model: ModelOrders, n_per_code: float, m_per_code: float, period_s: float
) -> NDArray[np.float64]:
    """M, B, K (n, 3) of estimates theta (n, p) in codes; NaN if a row describes no mass, damper and spring.

    The poles of A give B/M and K/M, the static gain gives K. Neither depends on the instant of an edge within a sample.

    :param model: meaning of theta; all NaN unless its ``na`` is 2.
    :param n_per_code: newtons per code of force.
    :param m_per_code: metres per code of displacement.
    :param period_s: problem time between samples.
    """
    if model.na != 2:
        return np.full((len(theta), 3), np.nan)
    a1, a2 = (theta[:, i].astype(np.float64) for i in range(2))
    with np.errstate(all="ignore"):
        gain = theta[:, 2 : 2 + model.nb].sum(axis=1, dtype=np.float64) / (1.0 + a1 + a2)
        stiffness = n_per_code / (gain * m_per_code)
        poles = np.sqrt((a1 * a1 - 4.0 * a2).astype(np.complex128))
        logs = [np.log((-a1 + sign * poles) / 2.0) / period_s for sign in (1.0, -1.0)]
        stiffness_over_mass = (logs[0] * logs[1]).real
        damping_over_mass = -(logs[0] + logs[1]).real
        mass = stiffness / stiffness_over_mass
        out = np.stack([mass, damping_over_mass * mass, stiffness], axis=1)
        out[~((out > LEAST_PARAMETER) & (out < MOST_PARAMETER)).all(axis=1)] = np.nan
    return out
