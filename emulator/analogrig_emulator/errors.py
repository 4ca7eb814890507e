"""The exceptions of the emulator.

* EmulatorError
  x CircuitError      a netlist that cannot be: duplicate name, bad value, floating node, singular matrix
  x PotError          a setting beyond the track of a pot
  x ExcitationError   a generator setting that cannot be
  x ModeError         a machine asked for what its mode does not allow
  x SamplerError      a card description or a voltage that cannot be
  x EngineError       the engine is missing, or a run cannot go on
"""

from __future__ import annotations


class EmulatorError(Exception):
    """Base of everything that the emulator raises on purpose; element: the name of the one at fault, if any."""

    def __init__(self, message: str = "", *, element: str = "") -> None:
        super().__init__(message)
        self.element = element


class CircuitError(EmulatorError):
    """The netlist is wrong; the message names the element and the node."""


class PotError(EmulatorError):
    """A coefficient or a dial beyond the track; the message names the pot and the value."""


class ExcitationError(EmulatorError):
    """A field of an Excitation is out of range; the message names the field."""


class ModeError(EmulatorError):
    """A change of mode that makes no sense, or a request in the wrong mode; the message names the mode."""


class SamplerError(EmulatorError):
    """A field of a Card is out of range, or a voltage is not finite."""


class EngineError(EmulatorError):
    """The compiled engine is absent, or it stopped; the message gives the sample."""
