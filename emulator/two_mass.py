"""A second program of the analogue computer: the front suspension on its tyre, thesis Equ 2.1 and 2.2.

    M2 x2'' = F - S,        S = B2 w + K2 d,   w = x2' - x1',   d = x2 - x1
    M1 x1'' = S - B1 x1' - K1 x1

Four integrators (x2', x1', d, x1), six pots, one for each mass, damper and spring, 200 times faster than the
suspension. README.md draws the circuit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace

from .circuit import GROUND, Capacitor, Circuit, Element, OpAmp, Pot, Resistor, VoltageSource
from .errors import PotError
from .opamp import OpAmpModel, preset
from .pot import coefficient_under_load, dial_for

__all__ = ["TWO_MASS_READINGS", "TwoMassParts", "TwoMassPlant", "TwoMassProgram", "TwoMassScales"]

TWO_MASS_READINGS: Mapping[str, tuple[str, float]] = {
    "force_n": ("in", 1.0),
    "displacement_m": ("u11", -1.0),
    "velocity_m_per_s": ("u2", 1.0),
    "net_force_n": ("u1", -1.0),
    "suspension_force_n": ("u6", -1.0),
    "compression_m": ("u5", 1.0),
    "compression_rate_m_per_s": ("u3", -1.0),
    "tyre_net_force_n": ("u7", 1.0),
    "tyre_velocity_m_per_s": ("u8", -1.0),
    "tyre_displacement_m": ("u9", 1.0),
}
"""Node and sign of every quantity, named as in TwoMassScales; displacement and velocity are those of M2."""


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
class TwoMassScales:
    """What 10 V stand for, by the names of TWO_MASS_READINGS; all of it follows from two choices and the parts.

    At the edges of a square wave over 0..10 V (0..2940 N) the front suspension needs: x2 6.8 V, x2' 4.7 V, S 6.4 V,
    d 6.0 V, w 4.0 V, x1 5.3 V, x1' 3.4 V, wheel's net force 3.0 V, net force 9.9 V.
    """

    force_n: float
    net_force_n: float
    suspension_force_n: float
    velocity_m_per_s: float
    compression_rate_m_per_s: float
    compression_m: float
    tyre_net_force_n: float
    tyre_velocity_m_per_s: float
    tyre_displacement_m: float
    displacement_m: float
    time: float

    @classmethod
    def of(
        cls, parts: TwoMassParts, *, force_n: float = 2940.0, velocity_m_per_s: float = 2.0, time: float = 200.0
    ) -> TwoMassScales:
        """The scales that the ratios of the parts give."""
        suspension_n = force_n * parts.r_force_ohm / parts.r_suspension_ohm
        wheel_m_per_s = velocity_m_per_s * parts.r_w_v2_ohm / parts.r_w_v1_ohm
        compression_m = time * velocity_m_per_s * parts.r_d_ohm * parts.c_d_farad
        return cls(
            force_n=force_n,
            net_force_n=force_n * parts.r_force_ohm / parts.feedback_ohm,
            suspension_force_n=suspension_n,
            velocity_m_per_s=velocity_m_per_s,
            compression_rate_m_per_s=velocity_m_per_s * parts.r_w_v2_ohm / parts.feedback_ohm,
            compression_m=compression_m,
            tyre_net_force_n=suspension_n * parts.r_wheel_ohm / parts.feedback_ohm,
            tyre_velocity_m_per_s=wheel_m_per_s,
            tyre_displacement_m=time * wheel_m_per_s * parts.r_x1_ohm * parts.c_x1_farad,
            displacement_m=compression_m * parts.r_out_d_ohm / parts.feedback_ohm,
            time=time,
        )

    def volts_per(self, quantity: str) -> float:
        """Volts per N, m or m/s of a quantity in TWO_MASS_READINGS, at its node, the sign included."""
        full: float = getattr(self, quantity)
        return 10.0 * TWO_MASS_READINGS[quantity][1] / full


@dataclass(frozen=True)
class TwoMassProgram:
    """A plant and the parts that are to show it; opamp: of all eleven amplifiers."""

    plant: TwoMassPlant = TwoMassPlant()
    parts: TwoMassParts = TwoMassParts()
    opamp: str | OpAmpModel = "tl07x"

    @property
    def scales(self) -> TwoMassScales:
        """What the voltages stand for."""
        return TwoMassScales.of(self.parts)

    def coefficients(self) -> dict[str, float]:
        """What each pot has to pass under its load, 0..1 where the plant can be shown.

        Raises PotError for a parameter that is not positive and finite.
        """
        plant, parts, scales = self.plant, self.parts, self.scales
        for name, value in asdict(plant).items():
            if not (math.isfinite(value) and value > 0):
                raise PotError(f"pot {name[:2]}: {name} must be positive and finite, got {value!r}")
        to_s = parts.feedback_ohm * scales.suspension_force_n
        to_wheel = parts.feedback_ohm * scales.tyre_net_force_n
        m2 = scales.time * scales.net_force_n * parts.r_m2_ohm * parts.c_velocity_farad
        m1 = scales.time * scales.tyre_net_force_n * parts.r_m1_ohm * parts.c_wheel_velocity_farad
        return {
            "M2": m2 / (plant.M2_kg * scales.velocity_m_per_s),
            "B2": plant.B2_n_s_per_m * scales.compression_rate_m_per_s * parts.r_b2_ohm / to_s,
            "K2": plant.K2_n_per_m * scales.compression_m * parts.r_k2_ohm / to_s,
            "M1": m1 / (plant.M1_kg * scales.tyre_velocity_m_per_s),
            "B1": plant.B1_n_s_per_m * scales.tyre_velocity_m_per_s * parts.r_b1_ohm / to_wheel,
            "K1": plant.K1_n_per_m * scales.tyre_displacement_m * parts.r_k1_ohm / to_wheel,
        }

    def dials(self) -> dict[str, float]:
        """Where the pots stand, their loads connected. Raises PotError for a plant beyond a track."""
        return {
            pot: dial_for(coefficient, self.parts.track_ohm, self._load_ohm(pot), name=pot)
            for pot, coefficient in self.coefficients().items()
        }

    def dials_for(self, **settings: float) -> dict[str, float]:
        """The dials that show other values of some parameters (names of TwoMassPlant). Raises PotError."""
        known = [field.name for field in fields(TwoMassPlant)]
        for name in settings:
            if name not in known:
                raise PotError(f"unknown setting {name!r}; there are {', '.join(known)}")
        dials = replace(self, plant=replace(self.plant, **settings)).dials()
        return {name[:2]: dials[name[:2]] for name in settings}

    def shown(self, dials: Mapping[str, float]) -> dict[str, float]:
        """The coefficients that pots at these dials pass under their loads."""
        return {
            pot: coefficient_under_load(dial, self.parts.track_ohm, self._load_ohm(pot)) for pot, dial in dials.items()
        }

    def circuit(self) -> Circuit:
        """The netlist, its pots set; the input is F, at node "in". Raises PotError."""
        return Circuit(
            _netlist(self.parts, preset(self.opamp) if isinstance(self.opamp, str) else self.opamp, self.dials())
        )

    def _load_ohm(self, pot: str) -> float:
        load_ohm: float = getattr(self.parts, f"r_{pot.lower()}_ohm")
        return load_ohm


def _netlist(parts: TwoMassParts, model: OpAmpModel, dials: Mapping[str, float]) -> list[Element]:
    fb, inv, track = parts.feedback_ohm, parts.inverter_ohm, parts.track_ohm
    return [
        VoltageSource("F", "in"),
        # -e_N = -(e_F - e_S)
        Resistor("RF", "in", "s1", parts.r_force_ohm),
        Resistor("RS", "u6", "s1", parts.r_suspension_ohm),
        Resistor("R1FB", "s1", "u1", fb),
        OpAmp("U1", GROUND, "s1", "u1", model),
        # +e_v2
        Pot("M2", "u1", "wm2", GROUND, track, dials["M2"]),
        Resistor("RM2", "wm2", "s2", parts.r_m2_ohm),
        Capacitor("CV2", "s2", "u2", parts.c_velocity_farad),
        OpAmp("U2", GROUND, "s2", "u2", model),
        # -e_w and +e_w
        Resistor("RW2", "u2", "s3", parts.r_w_v2_ohm),
        Resistor("RW1", "u8", "s3", parts.r_w_v1_ohm),
        Resistor("R3FB", "s3", "u3", fb),
        OpAmp("U3", GROUND, "s3", "u3", model),
        Resistor("R4", "u3", "s4", inv),
        Resistor("R4FB", "s4", "u4", inv),
        OpAmp("U4", GROUND, "s4", "u4", model),
        # +e_d
        Resistor("RD", "u3", "s5", parts.r_d_ohm),
        Capacitor("CD", "s5", "u5", parts.c_d_farad),
        OpAmp("U5", GROUND, "s5", "u5", model),
        # -e_S
        Pot("B2", "u4", "wb2", GROUND, track, dials["B2"]),
        Resistor("RB2", "wb2", "s6", parts.r_b2_ohm),
        Pot("K2", "u5", "wk2", GROUND, track, dials["K2"]),
        Resistor("RK2", "wk2", "s6", parts.r_k2_ohm),
        Resistor("R6FB", "s6", "u6", fb),
        OpAmp("U6", GROUND, "s6", "u6", model),
        # the wheel: its net force +e_T, -e_v1, +e_x1
        Resistor("RT", "u6", "s7", parts.r_wheel_ohm),
        Pot("K1", "u9", "wk1", GROUND, track, dials["K1"]),
        Resistor("RK1", "wk1", "s7", parts.r_k1_ohm),
        Pot("B1", "u10", "wb1", GROUND, track, dials["B1"]),
        Resistor("RB1", "wb1", "s7", parts.r_b1_ohm),
        Resistor("R7FB", "s7", "u7", fb),
        OpAmp("U7", GROUND, "s7", "u7", model),
        Pot("M1", "u7", "wm1", GROUND, track, dials["M1"]),
        Resistor("RM1", "wm1", "s8", parts.r_m1_ohm),
        Capacitor("CV1", "s8", "u8", parts.c_wheel_velocity_farad),
        OpAmp("U8", GROUND, "s8", "u8", model),
        Resistor("RX1", "u8", "s9", parts.r_x1_ohm),
        Capacitor("CX1", "s9", "u9", parts.c_x1_farad),
        OpAmp("U9", GROUND, "s9", "u9", model),
        Resistor("R10", "u8", "s10", inv),
        Resistor("R10FB", "s10", "u10", inv),
        OpAmp("U10", GROUND, "s10", "u10", model),
        # -e_x2 = -(e_d + e_x1), for the card
        Resistor("ROD", "u5", "s11", parts.r_out_d_ohm),
        Resistor("ROX", "u9", "s11", parts.r_out_x1_ohm),
        Resistor("R11FB", "s11", "u11", fb),
        OpAmp("U11", GROUND, "s11", "u11", model),
    ]
