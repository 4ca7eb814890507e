"""The analogue computer, its generator and its card.

README.md explains the circuit; SuspensionComputer and Sampler are the way in.
"""

from .bump_stop import BumpStop
from .circuit import Capacitor, Circuit, DiodeLimiter, OpAmp, Pot, Resistor, Switch, VoltageSource
from .deck import Deck, read_deck
from .engine import Engine
from .errors import CircuitError, EmulatorError, EngineError, ExcitationError, PotError, SamplerError
from .excitation import TICKS_PER_SAMPLE, Edges, Excitation
from .nodal import PiecewiseLinear, piecewise_linear
from .opamp import IDEAL, OpAmpModel
from .sampler import Card, Sampler
from .spice import to_spice
from .suspension import CHANNELS, FRONT, PROGRAMS, SHOCK, Program, Scales, SuspensionComputer, SuspensionParts
from .two_mass import TWO_MASS_READINGS, TwoMassParts, TwoMassPlant, TwoMassProgram, TwoMassScales

__all__ = [
    "CHANNELS",
    "FRONT",
    "IDEAL",
    "PROGRAMS",
    "SHOCK",
    "TICKS_PER_SAMPLE",
    "TWO_MASS_READINGS",
    "BumpStop",
    "Capacitor",
    "Card",
    "Circuit",
    "CircuitError",
    "Deck",
    "DiodeLimiter",
    "Edges",
    "EmulatorError",
    "Engine",
    "EngineError",
    "Excitation",
    "ExcitationError",
    "OpAmp",
    "OpAmpModel",
    "PiecewiseLinear",
    "Pot",
    "PotError",
    "Program",
    "Resistor",
    "Sampler",
    "SamplerError",
    "Scales",
    "SuspensionComputer",
    "SuspensionParts",
    "Switch",
    "TwoMassParts",
    "TwoMassPlant",
    "TwoMassProgram",
    "TwoMassScales",
    "VoltageSource",
    "piecewise_linear",
    "read_deck",
    "to_spice",
]
