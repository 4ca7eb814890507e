"""Emulated analogue computer with signal generator and data-acquisition card.

Start with SuspensionComputer, Excitation and Sampler.
"""

from analogrig_emulator.card.acquisition import acquired, ahead_ticks, probes_per_sample
from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.card.sampler import CARDS, Card, Sampler, drawn_levels, sample_plays
from analogrig_emulator.card.smooth import RecordedExcitation
from analogrig_emulator.circuit.circuit import Circuit, Element
from analogrig_emulator.circuit.components import (
    COMPONENTS,
    DIELECTRICS,
    FINE_OP_AMP_GRADES,
    MULTIPLIER_GRADES,
    NOMINAL,
    OP_AMP_GRADES,
    Components,
    Dielectric,
    Grade,
    MultiplierGrade,
    OpAmpGrade,
    PotGrade,
)
from analogrig_emulator.circuit.elements import (
    Capacitor,
    CurrentSource,
    DiodeLimiter,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
)
from analogrig_emulator.circuit.nodal import piecewise_linear
from analogrig_emulator.circuit.nonlinear import MULTIPLIERS, Function, Multiplier, MultiplierModel
from analogrig_emulator.circuit.opamp import IDEAL, OpAmpModel, preset
from analogrig_emulator.circuit.pot import PotModel, PotTurn
from analogrig_emulator.circuit.spice import Deck, to_spice
from analogrig_emulator.engine.engine import Engine
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Edges, PiecewiseLinear
from analogrig_emulator.exceptions import (
    CircuitError,
    EmulatorError,
    EngineError,
    ExcitationError,
    ModeError,
    PotError,
    ProgramError,
    SamplerError,
)
from analogrig_emulator.machine.analog_computer import AnalogComputer
from analogrig_emulator.machine.channel_courses import (
    Course,
    Courses,
    LinearMode,
    Moment,
    RepeatedCourses,
    WideProgram,
    Wired,
)
from analogrig_emulator.machine.noise import ABSOLUTE_ZERO_C, CircuitNoise, NoisySuspension, Supply
from analogrig_emulator.machine.patched_program import PatchedProgram
from analogrig_emulator.machine.program_circuit import (
    CHANNELS,
    SOURCE,
    ForceLaw,
    Mass,
    Parameter,
    ProgramCircuit,
    Scale,
    Scales,
)
from analogrig_emulator.machine.program_file import Equations, ProgramParameter
from analogrig_emulator.machine.program_loader import circuit_of, compile_program, equations_of, load_patch
from analogrig_emulator.machine.quarter_car import FRONT, SHOCK, SuspensionParts, SuspensionProgram
from analogrig_emulator.machine.readouts import LAMP_DELAY_S
from analogrig_emulator.machine.relays import REFERENCE_V, Mode
from analogrig_emulator.machine.repeated_plays import Repeat, RepeatedPlay, is_repeatable
from analogrig_emulator.machine.suspension import PROGRAMS, SuspensionComputer, drawn_offsets_v
from analogrig_emulator.machine.units import Unit, parse_unit
from analogrig_emulator.streams import NormalStream, normals, uniforms

__all__ = [
    "ABSOLUTE_ZERO_C",
    "CARDS",
    "CHANNELS",
    "COMPONENTS",
    "DIELECTRICS",
    "FINE_OP_AMP_GRADES",
    "FRONT",
    "IDEAL",
    "LAMP_DELAY_S",
    "MULTIPLIERS",
    "MULTIPLIER_GRADES",
    "NOMINAL",
    "OP_AMP_GRADES",
    "PROGRAMS",
    "REFERENCE_V",
    "SHOCK",
    "SOURCE",
    "TICKS_PER_SAMPLE",
    "AnalogComputer",
    "Capacitor",
    "Card",
    "Circuit",
    "CircuitError",
    "CircuitNoise",
    "Components",
    "Course",
    "Courses",
    "CurrentSource",
    "Deck",
    "Dielectric",
    "DiodeLimiter",
    "Edges",
    "Element",
    "EmulatorError",
    "Engine",
    "EngineError",
    "Equations",
    "Excitation",
    "ExcitationError",
    "ForceLaw",
    "Function",
    "Grade",
    "LinearMode",
    "Mass",
    "Mode",
    "ModeError",
    "Moment",
    "Multiplier",
    "MultiplierGrade",
    "MultiplierModel",
    "NoisySuspension",
    "NormalStream",
    "OpAmp",
    "OpAmpGrade",
    "OpAmpModel",
    "Parameter",
    "PatchedProgram",
    "PiecewiseLinear",
    "Pot",
    "PotError",
    "PotGrade",
    "PotModel",
    "PotTurn",
    "ProgramCircuit",
    "ProgramError",
    "ProgramParameter",
    "RecordedExcitation",
    "Repeat",
    "RepeatedCourses",
    "RepeatedPlay",
    "Resistor",
    "Sampler",
    "SamplerError",
    "Scale",
    "Scales",
    "Supply",
    "SuspensionComputer",
    "SuspensionParts",
    "SuspensionProgram",
    "Switch",
    "Unit",
    "VoltageSource",
    "WideProgram",
    "Wired",
    "acquired",
    "ahead_ticks",
    "circuit_of",
    "compile_program",
    "drawn_levels",
    "drawn_offsets_v",
    "equations_of",
    "is_repeatable",
    "load_patch",
    "normals",
    "parse_unit",
    "piecewise_linear",
    "preset",
    "probes_per_sample",
    "sample_plays",
    "to_spice",
    "uniforms",
]
