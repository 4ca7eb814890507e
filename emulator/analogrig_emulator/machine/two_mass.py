"""The program two-mass: the front suspension on its tyre, thesis Equ 2.1 and 2.2.

    M2 x2'' = F - S,        S = B2 w + K2 d,   w = x2' - x1',   d = x2 - x1
    M1 x1'' = S - B1 x1' - K1 x1

Four integrators (x2', x1', d, x1), six pots, one for each mass, damper and spring, 200 times faster than the
suspension. The documentation draws the circuit.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from analogrig_emulator.circuit.circuit import Capacitor, Element, OpAmp, Pot, Resistor, VoltageSource
from analogrig_emulator.circuit.opamp import OpAmpModel
from analogrig_emulator.circuit.part import GROUND
from analogrig_emulator.machine.program import SOURCE, ForceLaw, Mass, Parameter, ProgramCircuit, Scale, Scales


@dataclass(frozen=True)
class TwoMassPlant:
    """The front suspension of the thesis, on a tyre of 180 kN/m with a wheel of 18 kg.

    The thesis gives no figures for wheel and tyre. A motorcycle's front wheel with brakes and fork legs weighs 15 to
    20 kg, and its tyre has 150 to 200 kN/m and some hundred N s/m.
    """

    M2_kg: float = 115.0
    B2_n_s_per_m: float = 3021.0
    K2_n_per_m: float = 24500.0
    M1_kg: float = 18.0
    B1_n_s_per_m: float = 300.0
    K1_n_per_m: float = 180e3


@dataclass(frozen=True)
class TwoMassParts:
    """Component values, in ohm and farad, in the order of the circuit.

    The summers U1 (net force), U3 (w), U6 (S), U7 (net force of the wheel) and U11 (x2) have 100k from output to input.
    The inverters U4 and U10 have 10k and 10k.
    """

    feedback_ohm: float = 100e3
    r_force_ohm: float = 100e3
    r_suspension_ohm: float = 49.9e3
    r_m2_ohm: float = 100e3
    c_velocity_farad: float = 1e-9
    r_w_v2_ohm: float = 100e3
    r_w_v1_ohm: float = 200e3
    inverter_ohm: float = 10e3
    r_d_ohm: float = 49.9e3
    c_d_farad: float = 10e-9
    r_b2_ohm: float = 66.5e3
    r_k2_ohm: float = 100e3
    r_wheel_ohm: float = 16.9e3
    r_k1_ohm: float = 11e3
    r_b1_ohm: float = 100e3
    r_m1_ohm: float = 63.4e3
    c_wheel_velocity_farad: float = 1e-9
    r_x1_ohm: float = 20e3
    c_x1_farad: float = 10e-9
    r_out_d_ohm: float = 100e3
    r_out_x1_ohm: float = 499e3
    track_ohm: float = 10e3


@dataclass(frozen=True)
class TwoMassProgram(ProgramCircuit):
    """Plant and parts of the program; force_n, velocity_m_per_s: full scale, 10 V.

    All other scales follow from the ratios of the parts. At the edges of a square wave over 0..10 V (0..2940 N) the
    front suspension needs: x2 6.8 V, x2' 4.7 V, S 6.4 V, d 6.0 V, w 4.0 V, x1 5.3 V, x1' 3.4 V, wheel's net force
    3.0 V, net force 9.9 V.
    """

    plant: TwoMassPlant = TwoMassPlant()
    parts: TwoMassParts = TwoMassParts()
    force_n: float = 2940.0
    velocity_m_per_s: float = 2.0
    time: float = 200.0
    name: str = "two-mass"

    @functools.cached_property
    def scales(self) -> Scales:
        """Scales; displacement, velocity and net force are those of M2."""
        parts, force_n, velocity_m_per_s = self.parts, self.force_n, self.velocity_m_per_s
        suspension_n = force_n * parts.r_force_ohm / parts.r_suspension_ohm
        wheel_m_per_s = velocity_m_per_s * parts.r_w_v2_ohm / parts.r_w_v1_ohm
        compression_m = self.time * velocity_m_per_s * parts.r_d_ohm * parts.c_d_farad
        wheel_m = self.time * wheel_m_per_s * parts.r_x1_ohm * parts.c_x1_farad
        fb_ohm = parts.feedback_ohm
        return Scales(
            self.time,
            {
                "force": Scale("in", 1.0, force_n),
                "displacement": Scale("u11", -1.0, compression_m * parts.r_out_d_ohm / fb_ohm),
                "velocity": Scale("u2", 1.0, velocity_m_per_s),
                "net_force": Scale("u1", -1.0, force_n * parts.r_force_ohm / fb_ohm),
                "suspension_force": Scale("u6", -1.0, suspension_n),
                "compression": Scale("u5", 1.0, compression_m),
                "compression_rate": Scale("u3", -1.0, velocity_m_per_s * parts.r_w_v2_ohm / fb_ohm),
                "tyre_net_force": Scale("u7", 1.0, suspension_n * parts.r_wheel_ohm / fb_ohm),
                "tyre_velocity": Scale("u8", -1.0, wheel_m_per_s),
                "tyre_displacement": Scale("u9", 1.0, wheel_m),
            },
        )

    @functools.cached_property
    def parameters(self) -> Mapping[str, Parameter]:
        plant, parts, full = self.plant, self.parts, self.scales.full
        m2 = self.time * full("net_force") * parts.r_m2_ohm * parts.c_velocity_farad
        m1 = self.time * full("tyre_net_force") * parts.r_m1_ohm * parts.c_wheel_velocity_farad

        def force(pot: str, value: float, quantity: str, total: str, load_ohm: float) -> Parameter:
            gain = load_ohm / parts.feedback_ohm
            return ForceLaw(pot, f"R{pot}", value, full(quantity), full(total), gain)

        return {
            "M2": Mass("M2", "RM2", plant.M2_kg, m2, full("velocity")),
            "B2": force("B2", plant.B2_n_s_per_m, "compression_rate", "suspension_force", parts.r_b2_ohm),
            "K2": force("K2", plant.K2_n_per_m, "compression", "suspension_force", parts.r_k2_ohm),
            "M1": Mass("M1", "RM1", plant.M1_kg, m1, full("tyre_velocity")),
            "B1": force("B1", plant.B1_n_s_per_m, "tyre_velocity", "tyre_net_force", parts.r_b1_ohm),
            "K1": force("K1", plant.K1_n_per_m, "tyre_displacement", "tyre_net_force", parts.r_k1_ohm),
        }

    @property
    def amplifiers(self) -> int:
        return 11

    @property
    def integrators(self) -> tuple[str, ...]:
        return "U2", "U5", "U8", "U9"

    def netlist(self, models: Sequence[OpAmpModel]) -> list[Element]:
        diagram = _Diagram(self.parts, models)
        return [
            VoltageSource(SOURCE, "in"),
            *diagram.sprung_mass(),
            *diagram.suspension(),
            *diagram.wheel(),
            *diagram.output(),
        ]


TWO_MASS = TwoMassProgram()
"""The front suspension of the thesis on a motorcycle's tyre."""


_Input = tuple[str, str, float]
"""Resistor into a summing junction: name, source node, ohms."""


@dataclass(frozen=True)
class _Diagram:
    """Diagram in four parts; models: op-amp models of U1 to U11."""

    parts: TwoMassParts
    models: Sequence[OpAmpModel]

    def sprung_mass(self) -> Iterator[Element]:
        """-e_N = -(e_F - e_S), and +e_v2."""
        parts = self.parts
        yield from self._summer(1, ("RF", "in", parts.r_force_ohm), ("RS", "u6", parts.r_suspension_ohm))
        yield self._pot("M2", "u1")
        yield from self._integrator(2, ("RM2", "wm2", parts.r_m2_ohm), ("CV2", parts.c_velocity_farad))

    def suspension(self) -> Iterator[Element]:
        """-e_w and +e_w, +e_d, and -e_S of both."""
        parts = self.parts
        yield from self._summer(3, ("RW2", "u2", parts.r_w_v2_ohm), ("RW1", "u8", parts.r_w_v1_ohm))
        yield from self._inverter(4, "u3")
        yield from self._integrator(5, ("RD", "u3", parts.r_d_ohm), ("CD", parts.c_d_farad))
        yield self._pot("B2", "u4")
        yield self._pot("K2", "u5")
        yield from self._summer(6, ("RB2", "wb2", parts.r_b2_ohm), ("RK2", "wk2", parts.r_k2_ohm))

    def wheel(self) -> Iterator[Element]:
        """Its net force +e_T, -e_v1, +e_x1, and +e_v1."""
        parts = self.parts
        yield self._pot("K1", "u9")
        yield self._pot("B1", "u10")
        from_springs = ("RK1", "wk1", parts.r_k1_ohm), ("RB1", "wb1", parts.r_b1_ohm)
        yield from self._summer(7, ("RT", "u6", parts.r_wheel_ohm), *from_springs)
        yield self._pot("M1", "u7")
        yield from self._integrator(8, ("RM1", "wm1", parts.r_m1_ohm), ("CV1", parts.c_wheel_velocity_farad))
        yield from self._integrator(9, ("RX1", "u8", parts.r_x1_ohm), ("CX1", parts.c_x1_farad))
        yield from self._inverter(10, "u8")

    def output(self) -> Iterator[Element]:
        """-e_x2 = -(e_d + e_x1), for the card."""
        parts = self.parts
        yield from self._summer(11, ("ROD", "u5", parts.r_out_d_ohm), ("ROX", "u9", parts.r_out_x1_ohm))

    def _summer(self, number: int, *inputs: _Input) -> Iterator[Element]:
        yield from self._stage(number, inputs)
        yield Resistor(f"R{number}FB", f"s{number}", f"u{number}", self.parts.feedback_ohm)

    def _inverter(self, number: int, source: str) -> Iterator[Element]:
        yield from self._stage(number, [(f"R{number}", source, self.parts.inverter_ohm)])
        yield Resistor(f"R{number}FB", f"s{number}", f"u{number}", self.parts.inverter_ohm)

    def _integrator(self, number: int, source: _Input, capacitor: tuple[str, float]) -> Iterator[Element]:
        name, farad = capacitor
        yield from self._stage(number, [source])
        yield Capacitor(name, f"s{number}", f"u{number}", farad)

    def _stage(self, number: int, inputs: Sequence[_Input]) -> Iterator[Element]:
        """Amplifier with its inputs, without feedback."""
        for name, node, ohm in inputs:
            yield Resistor(name, node, f"s{number}", ohm)
        yield OpAmp(f"U{number}", GROUND, f"s{number}", f"u{number}", self.models[number - 1])

    def _pot(self, name: str, top: str) -> Pot:
        return Pot(name, top, f"w{name.lower()}", GROUND, self.parts.track_ohm, 0.0)
