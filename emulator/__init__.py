"""The analogue computer, its generator and its card.

README.md explains the circuit; SuspensionComputer and Sampler are the way in.
"""

from .circuit import Capacitor, Circuit, DiodeLimiter, OpAmp, Pot, Resistor, Switch, VoltageSource
from .engine import Engine
from .errors import CircuitError, EmulatorError, EngineError, ExcitationError, ModeError, PotError, SamplerError
from .excitation import TICKS_PER_SAMPLE, Edges, Excitation
from .machine import LAMP_DELAY_S, REFERENCE_V, AnalogComputer, Mode
from .nodal import PiecewiseLinear, piecewise_linear
from .opamp import IDEAL, OpAmpModel
from .sampler import Card, Sampler
from .spice import to_spice
from .suspension import CHANNELS, FRONT, PROGRAMS, SHOCK, Program, Scales, SuspensionComputer, SuspensionParts

__all__ = [
    "CHANNELS",
    "FRONT",
    "IDEAL",
    "LAMP_DELAY_S",
    "PROGRAMS",
    "REFERENCE_V",
    "SHOCK",
    "TICKS_PER_SAMPLE",
    "AnalogComputer",
    "Capacitor",
    "Card",
    "Circuit",
    "CircuitError",
    "DiodeLimiter",
    "Edges",
    "EmulatorError",
    "Engine",
    "EngineError",
    "Excitation",
    "ExcitationError",
    "Mode",
    "ModeError",
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
    "VoltageSource",
    "piecewise_linear",
    "to_spice",
]
