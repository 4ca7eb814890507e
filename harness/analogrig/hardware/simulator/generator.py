"""The generator of the instrument: its settings, and what it gives with them."""

from __future__ import annotations

from dataclasses import dataclass

from analogrig.hardware.simulator.scpi import ScpiError
from analogrig_emulator import Excitation

MOST_VOLTS = 1.0
"""Of its output, either way."""
SHAPES = ("SQUARE", "PWM", "DC")
_ROUNDING_V = 1e-9


@dataclass(frozen=True)
class Generator:
    """As GEN:RST leaves it."""

    shape: str = "SQUARE"
    frequency_hz: float = 1000.0
    amplitude_v: float = 1.0
    """Half of what lies between the two levels."""
    offset_v: float = 0.0
    phase_deg: float = 0.0
    duty: float = 0.5
    """Of PWM."""
    on: bool = False

    def waveform(self) -> Excitation:
        """What it gives once it is triggered.

        :raises ScpiError: that leaves the range of the output.
        """
        low_v, high_v = self.offset_v - self.amplitude_v, self.offset_v + self.amplitude_v
        if max(-low_v, high_v) > MOST_VOLTS + _ROUNDING_V:
            raise ScpiError(-221, f"{low_v:g} V to {high_v:g} V leaves +-{MOST_VOLTS:g} V")
        if not self.on:
            low_v = high_v = 0.0
        elif self.shape == "DC":
            low_v = high_v
        shape, duty = ("pulse", self.duty) if self.shape == "PWM" else ("square", 0.5)
        return Excitation(
            shape, low_v, high_v, self.frequency_hz, self.phase_deg / 360.0 % 1.0 % 1.0, duty, clock="free"
        )
