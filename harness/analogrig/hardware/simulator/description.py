"""The ``[instrument]`` table of a served rig: how the instrument is connected, and what is wrong with it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

from analogrig.hardware.simulator.acquisition import AcquisitionFaults
from analogrig.hardware.simulator.inputs import InputFaults
from analogrig.hardware.simulator.table import SEEN, Wiring
from analogrig_emulator import Card

_ON_BOTH = {"noise_lsb", "gain_error", "offset_lsb", "skew_s", "clock_drift_ppm"}
_OF_THE_CARD = {"bits", "rate_hz", "ranges_v", "throughput_hz"}


@dataclass(frozen=True)
class InstrumentDescription:
    """Nothing is wrong unless it is said here; every part is a table of its own."""

    wiring: Wiring = field(default_factory=Wiring)
    inputs: InputFaults = field(default_factory=InputFaults)
    acquisition: AcquisitionFaults = field(default_factory=AcquisitionFaults)

    def beside(self, card: Card) -> InstrumentDescription:
        """An instrument that has besides its own faults those of a card that it can have.

        :raises ValueError: together they are too large.
        """
        own, (first, second) = self.inputs, SEEN
        lsb_v, noise_lsb = card.lsb_v, card.noise_lsb
        gain_error, offset_lsb, skew_s = (
            card.per_channel(name).tolist() for name in ("gain_error", "offset_lsb", "skew_s")
        )

        def both(mine: tuple[float, float], of_card: list[float]) -> tuple[float, float]:
            return mine[0] + of_card[first], mine[1] + of_card[second]

        noise_v = (float(noise_lsb[first] * lsb_v[first]), float(noise_lsb[second] * lsb_v[second]))
        return replace(
            self,
            inputs=replace(
                own,
                noise_v=(math.hypot(own.noise_v[0], noise_v[0]), math.hypot(own.noise_v[1], noise_v[1])),
                gain_error=both(own.gain_error, gain_error),
                offset_v=both(own.offset_v, (offset_lsb * lsb_v).tolist()),
                skew_s=own.skew_s + skew_s[second] - skew_s[first],
            ),
            acquisition=replace(self.acquisition, clock_ppm=self.acquisition.clock_ppm + card.clock_drift_ppm),
        )


def left_out(card: Card) -> tuple[str, ...]:
    """The faults of a card that an instrument cannot have."""
    others = [field for field in fields(Card) if field.name not in _ON_BOTH | _OF_THE_CARD]
    return tuple(field.name for field in others if getattr(card, field.name) != field.default)
