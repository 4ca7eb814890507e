"""The diagrams front and shock: a quarter-car suspension, M x'' + B x' + K x = F, wired by hand.

    U1 summer        -> -e_N = -(e_F - beta e_v - kappa e_x)
    pot M, U2        -> +e_v     integrator, R1 C1
    U3               -> -e_x     integrator, R2 C2
    U4, pot B        -> inverts e_v for the summer
    U5               -> +e_x     inverts for the card
    pot K            feeds -e_x to the summer

The summer puts out net force and not acceleration, so that a jump of M moves one pot.
The documentation draws the circuit.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.circuit.elements import GROUND, Capacitor, OpAmp, Pot, Resistor, VoltageSource
from analogrig_emulator.circuit.opamp import OpAmpModel
from analogrig_emulator.machine.program_circuit import SOURCE, ForceLaw, Mass, Parameter, ProgramCircuit, Scale, Scales


@dataclass(frozen=True)
class SuspensionParts:
    """Component values, in ohm and farad.

    rf, rfb, rb, rk: the summer; r1, c1 and r2, c2: the integrators; r4 and r5, in and feedback: the inverters;
    pot_m, pot_b, pot_k: the tracks.
    """

    rf_ohm: float = 100e3
    rfb_ohm: float = 100e3
    rb_ohm: float = 33.2e3
    rk_ohm: float = 49.9e3
    r1_ohm: float = 100e3
    c1_farad: float = 1e-9
    r2_ohm: float = 49.9e3
    c2_farad: float = 10e-9
    r4_in_ohm: float = 10e3
    r4_fb_ohm: float = 10e3
    r5_in_ohm: float = 10e3
    r5_fb_ohm: float = 10e3
    pot_m_ohm: float = 10e3
    pot_b_ohm: float = 10e3
    pot_k_ohm: float = 10e3


@dataclass(frozen=True)
class SuspensionProgram(ProgramCircuit):
    """Parameters with suitable scaling and nominal parts.

    force_n, velocity_m_per_s: full scale, 10 V; the displacement's is time velocity R2 C2.
    """

    name: str
    M_kg: float
    B_n_s_per_m: float
    K_n_per_m: float
    force_n: float
    parts: SuspensionParts = SuspensionParts()
    velocity_m_per_s: float = 2.0
    time: float = 200.0

    @functools.cached_property
    def scales(self) -> Scales:
        displacement_m = self.time * self.velocity_m_per_s * self.parts.r2_ohm * self.parts.c2_farad
        return Scales(
            self.time,
            {
                "force": Scale("in", 1.0, self.force_n),
                "displacement": Scale("u5", 1.0, displacement_m),
                "velocity": Scale("u2", 1.0, self.velocity_m_per_s),
                # U1 puts out -e_N: the card's differential input for the net force is wired the other way round.
                "net_force": Scale("u1", -1.0, self.force_n),
            },
        )

    @functools.cached_property
    def parameters(self) -> Mapping[str, Parameter]:
        parts, force_n, velocity_m_per_s = self.parts, self.force_n, self.velocity_m_per_s
        mass = self.time * force_n * parts.r1_ohm * parts.c1_farad
        by_b, by_k = parts.rb_ohm / parts.rfb_ohm, parts.rk_ohm / parts.rfb_ohm
        displacement_m = self.scales.full("displacement")
        return {
            "M": Mass("M", "R1", self.M_kg, mass, velocity_m_per_s),
            "B": ForceLaw("B", "RB", self.B_n_s_per_m, velocity_m_per_s, force_n, by_b),
            "K": ForceLaw("K", "RK", self.K_n_per_m, displacement_m, force_n, by_k),
        }

    @property
    def amplifiers(self) -> int:
        return 5

    @property
    def integrators(self) -> tuple[str, ...]:
        return "U2", "U3"

    def netlist(self, models: Sequence[OpAmpModel]) -> list[Element]:
        return _netlist(self.parts, models)


FRONT = SuspensionProgram("front", 115.0, 3021.0, 24500.0, force_n=2940.0)
"""The front suspension of the thesis."""

SHOCK = SuspensionProgram("shock", 2.0, 900.0, 12250.0, force_n=1470.0, parts=SuspensionParts(r1_ohm=10e3))
"""The shock absorber of the thesis; its mass pot feeds the integrator's gain-of-ten input."""


def _netlist(parts: SuspensionParts, models: Sequence[OpAmpModel]) -> list[Element]:
    """Elements of the diagram, with pots at 0."""
    u1, u2, u3, u4, u5 = models
    return [
        VoltageSource(SOURCE, "in"),
        Resistor("RF", "in", "s1", parts.rf_ohm),
        Resistor("RFB", "s1", "u1", parts.rfb_ohm),
        Resistor("RB", "wb", "s1", parts.rb_ohm),
        Resistor("RK", "wk", "s1", parts.rk_ohm),
        OpAmp("U1", GROUND, "s1", "u1", u1),
        Pot("M", "u1", "wm", GROUND, parts.pot_m_ohm, 0.0),
        Resistor("R1", "wm", "s2", parts.r1_ohm),
        Capacitor("C1", "s2", "u2", parts.c1_farad),
        OpAmp("U2", GROUND, "s2", "u2", u2),
        Resistor("R2", "u2", "s3", parts.r2_ohm),
        Capacitor("C2", "s3", "u3", parts.c2_farad),
        OpAmp("U3", GROUND, "s3", "u3", u3),
        Resistor("R4", "u2", "s4", parts.r4_in_ohm),
        Resistor("R4FB", "s4", "u4", parts.r4_fb_ohm),
        OpAmp("U4", GROUND, "s4", "u4", u4),
        Pot("B", "u4", "wb", GROUND, parts.pot_b_ohm, 0.0),
        Pot("K", "u3", "wk", GROUND, parts.pot_k_ohm, 0.0),
        Resistor("R5", "u3", "s5", parts.r5_in_ohm),
        Resistor("R5FB", "s5", "u5", parts.r5_fb_ohm),
        OpAmp("U5", GROUND, "s5", "u5", u5),
    ]
