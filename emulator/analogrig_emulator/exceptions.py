"""The exceptions of the emulator.

* EmulatorError
  x CircuitError      invalid netlist: duplicate name, bad value, floating node, singular matrix
  x PotError          a setting beyond the track of a pot
  x ProgramError      a program file that is malformed, or that no patch on the machine can solve
  x ExcitationError   invalid generator setting
  x ModeError         request that the mode of the machine does not allow
  x SamplerError      invalid card description or voltage
  x EngineError       the engine is missing, or a run cannot go on
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Edit = Mapping[tuple[str, ...], Any]
"""Change of a program file: value by place, ("states", "x", "full"); None deletes the key."""


class EmulatorError(Exception):
    """Base of the emulator's errors; element: name of the element at fault, if any."""

    def __init__(self, message: str = "", *, element: str = "") -> None:
        super().__init__(message)
        self.element = element


class CircuitError(EmulatorError):
    """Invalid netlist; the message names the element and the node."""


class PotError(EmulatorError):
    """A coefficient or a dial beyond the track; the message names the pot and the value."""


class ProgramError(EmulatorError):
    """Invalid program file; the message names the file, the place and the cure.

    edits: changes of the file that may cure it, none of them tried. otherwise: cure in words where none of them does.
    """

    def __init__(self, message: str = "", *, edits: Sequence[Edit] = (), otherwise: str = "") -> None:
        super().__init__(message)
        self.edits, self.otherwise = tuple(edits), otherwise

    def __str__(self) -> str:
        return f"{super().__str__()}; {self.otherwise}" if self.otherwise else super().__str__()

    def at(self, place: str) -> ProgramError:
        """The same error with a place before its message."""
        return ProgramError(f"{place}: {super().__str__()}", edits=self.edits, otherwise=self.otherwise)

    def advised(self, advice: str) -> ProgramError:
        """The same error with advice that was tried, and nothing more to try."""
        return ProgramError(super().__str__(), otherwise=advice)


class UnfitError(ProgramError):
    """Equations that machines of real parts cannot play at any full scale."""


class ExcitationError(EmulatorError):
    """A field of an Excitation is out of range; the message names the field."""


class ModeError(EmulatorError):
    """Invalid change of mode, or request in the wrong mode; the message names the mode."""


class SamplerError(EmulatorError):
    """A field of a Card is out of range, or a voltage is not finite."""


class EngineError(EmulatorError):
    """Compiled engine missing, or run stopped; the message gives the sample."""
