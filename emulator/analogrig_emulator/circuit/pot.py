"""Coefficient potentiometers under load.

A pot of track Rp set to dial k (0..1) and loaded by RL to ground (or to a virtual ground) passes the coefficient

    k_eff = k / (1 + k (1 - k) Rp / RL)

less than its dial. An operator sets either the dial, or the coefficient with the load connected (pot-set mode).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine.system import is_integer
from analogrig_emulator.exceptions import CircuitError, PotError

_PLACES = 5000
"""Number of places with a noise of their own on a continuous track."""

_ROUNDING = 1e-9
END_FRACTION = 1e-6
"""Part of the track between wiper and terminal at an end stop, so that no leg is a short circuit."""


class PotTurn(NamedTuple):
    """Settings that the pots of a machine take from a sample on: at once, or evenly over ramp_n samples.

    sample: last sample before the change; sample + 1 is the first that can show it. values: by setting of
    SuspensionComputer.set where a program is played, dials (0..1) by pot where a circuit is.
    """

    sample: int
    values: Mapping[str, float]
    ramp_n: int = 0


def check_dial(dial: float, name: str = "pot") -> float:
    """Return the dial. Raises PotError unless it is within 0..1."""
    if not 0.0 <= dial <= 1.0:
        raise PotError(f"pot {name}: dial {dial!r} is beyond the track (0 to 1)", element=name)
    return dial


def check_ramp(ramp_n: int, pots: Iterable[str]) -> int:
    """Return ramp_n. Raises PotError naming the pots unless it is an integer >= 0."""
    if not (is_integer(ramp_n) and ramp_n >= 0):
        raise PotError(f"pots {', '.join(pots)}: cannot turn in {ramp_n!r} samples")
    return ramp_n


def coefficient_under_load(dial: float, track_ohm: float, load_ohm: float) -> float:
    """Coefficient (V/V) of a pot at that dial driving load_ohm to ground from a stiff source."""
    return dial / (1.0 + dial * (1.0 - dial) * track_ohm / load_ohm)


def dial_for(coefficient: float, track_ohm: float, load_ohm: float, name: str = "pot") -> float:
    """Dial for a coefficient under load: the inverse of coefficient_under_load.

    Raises PotError naming the pot when the coefficient is not within 0..1, but for rounding.
    """
    if not 0.0 <= coefficient <= 1.0 + _ROUNDING:
        raise PotError(f"pot {name}: coefficient {coefficient:.6g} is beyond the track (0 to 1)")
    coefficient = min(coefficient, 1.0)
    # The positive root of c a k^2 + (1 - c a) k - c = 0 with a = Rp/RL, in the form that does not cancel.
    ca = coefficient * track_ohm / load_ohm
    return 2.0 * coefficient / ((1.0 - ca) + math.sqrt((1.0 - ca) ** 2 + 4.0 * ca * coefficient))


def legs_ohm(dial: float, track_ohm: float) -> tuple[float, float]:
    """Resistance in ohm from the top to the wiper and from the wiper to the bottom."""
    end_ohm = END_FRACTION * track_ohm
    return max((1.0 - dial) * track_ohm, end_ohm), max(dial * track_ohm, end_ohm)


def _inward(coefficient: float, to: float) -> str:
    """Coefficient in five digits, rounded towards another: the text is one that the track has."""
    text = float(f"{coefficient:.5g}")
    step = 10.0 ** (math.floor(math.log10(coefficient)) - 4) if coefficient else 0.0
    outside = text < coefficient if to > coefficient else text > coefficient
    return f"{text + math.copysign(step, to - coefficient) if outside else text:.5g}"


@dataclass(frozen=True)
class PotModel:
    """Real pot: coefficient of a dial under load, and the inverse.

    track_ohm: resistance between the end stops, dial 0 to dial 1; end_ohm: resistance beyond either stop; wiper_ohm:
    contact resistance in series with the load. windings: turns of wire, so that the dial acts in steps of 1 / windings;
    0 for a continuous track. wiper_noise_ohm: largest rise of the contact resistance while the wiper moves
    (the datasheets' equivalent noise resistance; 100 ohm is usual for wire).
    Raises CircuitError naming the field.
    """

    track_ohm: float
    wiper_ohm: float = 0.0
    end_ohm: float = 0.0
    windings: int = 0
    wiper_noise_ohm: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.track_ohm < math.inf:
            raise CircuitError(f"pot: track_ohm must be positive and finite, got {self.track_ohm!r}")
        for field in ("wiper_ohm", "end_ohm", "windings", "wiper_noise_ohm"):
            value = getattr(self, field)
            if not 0 <= value < math.inf:
                raise CircuitError(f"pot: {field} must be finite and not negative, got {value!r}")

    @property
    def _total_ohm(self) -> float:
        return self.track_ohm + 2.0 * self.end_ohm

    def coefficient(self, dial: float, load_ohm: float) -> float:
        """Coefficient (V/V) at a dial into load_ohm, from a stiff source."""
        fraction = self.end_ohm / self._total_ohm + dial * (self.track_ohm / self._total_ohm)
        driven_ohm = load_ohm + self.wiper_ohm
        return coefficient_under_load(fraction, self._total_ohm, driven_ohm) * (load_ohm / driven_ohm)

    def dial(self, coefficient: float, load_ohm: float, name: str = "pot") -> float:
        """Dial for a coefficient into load_ohm, on a continuous track.

        Raises PotError naming the pot if the dial lies beyond an end stop.
        """
        low, high = (self.coefficient(end, load_ohm) for end in (0.0, 1.0))
        if not low <= coefficient <= high * (1.0 + _ROUNDING):
            track = f"{_inward(low, high)} to {_inward(high, low)}"
            raise PotError(f"pot {name}: coefficient {coefficient:.6g} is beyond the track ({track})")
        driven_ohm = load_ohm + self.wiper_ohm
        fraction = dial_for(min(coefficient, high) * (driven_ohm / load_ohm), self._total_ohm, driven_ohm, name)
        dial = fraction * (self._total_ohm / self.track_ohm) - self.end_ohm / self.track_ohm
        return min(max(dial, 0.0), 1.0)

    def resting(self, dial: float) -> float:
        """Dial of the winding nearest to a dial, where the wiper rests."""
        return round(dial * self.windings) / self.windings if self.windings else dial

    def contact(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Fraction of wiper_noise_ohm at each place of one specimen's track: (places,), 0..1.

        A place is a winding, or a five-thousandth of a continuous track.
        """
        return rng.uniform(0.0, 1.0, (self.windings or _PLACES) + 1)
