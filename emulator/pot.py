"""Coefficient potentiometers, and what their load does to them.

A pot of track Rp set to dial k (0..1) and loaded by RL to ground (or to a virtual ground) passes the coefficient

    k_eff = k / (1 + k (1 - k) Rp / RL)

which is less than its dial shows. An operator either sets the dial, or sets the coefficient with the load connected
(pot-set mode).
"""

from __future__ import annotations

import math

from .errors import PotError

__all__ = ["END_FRACTION", "checked_dial", "coefficient_under_load", "dial_for", "legs_ohm"]

END_FRACTION = 1e-6
"""Part of the track that stays between wiper and terminal at an end stop, so that no leg is ever a short circuit."""


def checked_dial(dial: float, name: str = "pot") -> float:
    """The dial itself when it is within 0..1, else PotError."""
    if not 0.0 <= dial <= 1.0:
        raise PotError(f"pot {name}: dial {dial!r} is beyond the track (0 to 1)")
    return dial


def coefficient_under_load(dial: float, track_ohm: float, load_ohm: float) -> float:
    """Coefficient (V/V) of a pot at that dial driving load_ohm to ground from a stiff source."""
    return dial / (1.0 + dial * (1.0 - dial) * track_ohm / load_ohm)


def dial_for(coefficient: float, track_ohm: float, load_ohm: float, name: str = "pot") -> float:
    """The dial that gives the coefficient under load: the inverse of coefficient_under_load.

    Raises PotError naming the pot when the coefficient is not within 0..1.
    """
    if not 0.0 <= coefficient <= 1.0:
        raise PotError(f"pot {name}: coefficient {coefficient:.6g} is beyond the track (0 to 1)")
    # The positive root of c a k^2 + (1 - c a) k - c = 0 with a = Rp/RL, in the form that does not cancel.
    ca = coefficient * track_ohm / load_ohm
    return 2.0 * coefficient / ((1.0 - ca) + math.sqrt((1.0 - ca) ** 2 + 4.0 * ca * coefficient))


def legs_ohm(dial: float, track_ohm: float) -> tuple[float, float]:
    """Resistance in ohm from the top to the wiper and from the wiper to the bottom."""
    end_ohm = END_FRACTION * track_ohm
    return max((1.0 - dial) * track_ohm, end_ohm), max(dial * track_ohm, end_ohm)
