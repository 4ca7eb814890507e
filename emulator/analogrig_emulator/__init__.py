"""The analogue computer, its generator and its card.

README.md explains the circuit; SuspensionComputer and Sampler are the way in.
"""

from .acquisition import acquired, probes_per_sample
from .bump_stop import BumpStop
from .circuit import Capacitor, Circuit, CurrentSource, DiodeLimiter, OpAmp, Pot, Resistor, Switch, VoltageSource
from .components import (
    COMPONENTS,
    DIELECTRICS,
    NOMINAL,
    OP_AMP_GRADES,
    Components,
    Dielectric,
    Grade,
    OpAmpGrade,
    PotGrade,
)
from .deck import Deck
from .engine import Engine
from .errors import CircuitError, EmulatorError, EngineError, ExcitationError, ModeError, PotError, SamplerError
from .excitation import TICKS_PER_SAMPLE, Edges, Excitation
from .machine import LAMP_DELAY_S, REFERENCE_V, AnalogComputer, Mode
from .nodal import PiecewiseLinear, piecewise_linear
from .noise import CircuitNoise, NoisySuspension
from .opamp import IDEAL, OpAmpModel
from .pot import PotModel
from .program import CHANNELS, ForceLaw, Mass, Parameter, Program, Quantity, Scales
from .quarter_car import BUMP_STOP, FRONT, SHOCK, SuspensionParts, SuspensionProgram
from .repeated import Repeat, RepeatedPlay, is_repeatable
from .sampler import CARDS, Card, Sampler, drawn_levels
from .spice import to_spice
from .suspension import PROGRAMS, RampedTweak, SuspensionComputer, Tweak, drawn_offsets_v
from .two_mass import TWO_MASS, TwoMassParts, TwoMassPlant, TwoMassProgram

__all__ = [
    "BUMP_STOP",
    "CARDS",
    "CHANNELS",
    "COMPONENTS",
    "DIELECTRICS",
    "FRONT",
    "IDEAL",
    "LAMP_DELAY_S",
    "NOMINAL",
    "OP_AMP_GRADES",
    "PROGRAMS",
    "REFERENCE_V",
    "SHOCK",
    "TICKS_PER_SAMPLE",
    "TWO_MASS",
    "AnalogComputer",
    "BumpStop",
    "Capacitor",
    "Card",
    "Circuit",
    "CircuitError",
    "CircuitNoise",
    "Components",
    "CurrentSource",
    "Deck",
    "Dielectric",
    "DiodeLimiter",
    "Edges",
    "EmulatorError",
    "Engine",
    "EngineError",
    "Excitation",
    "ExcitationError",
    "ForceLaw",
    "Grade",
    "Mass",
    "Mode",
    "ModeError",
    "NoisySuspension",
    "OpAmp",
    "OpAmpGrade",
    "OpAmpModel",
    "Parameter",
    "PiecewiseLinear",
    "Pot",
    "PotError",
    "PotGrade",
    "PotModel",
    "Program",
    "Quantity",
    "RampedTweak",
    "Repeat",
    "RepeatedPlay",
    "Resistor",
    "Sampler",
    "SamplerError",
    "Scales",
    "SuspensionComputer",
    "SuspensionParts",
    "SuspensionProgram",
    "Switch",
    "Tweak",
    "TwoMassParts",
    "TwoMassPlant",
    "TwoMassProgram",
    "VoltageSource",
    "acquired",
    "drawn_levels",
    "drawn_offsets_v",
    "is_repeatable",
    "piecewise_linear",
    "probes_per_sample",
    "to_spice",
]
