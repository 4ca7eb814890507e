"""Random rigs, the values of theirs that force and displacement identify, and the distance of a twin from them.

The truth follows from the circuit alone (emulator/README.md, "The circuit"), with r4 = R4FB / R4, r5 = R5FB / R5 and
amplifiers that hold their junctions at their offsets V1..V5:

    u1 = -(RFB/RF) F - (RFB/RB) k_B u4 - (RFB/RK) k_K u3 + V1 N     N = 1 + RFB (1/RF + 1/(RB + rho_B) + 1/(RK + rho_K))
    d_M u1 = V2 at rest                                             u4 = -r4 u2 + (1 + r4) V4
    u2 = V3 at rest                                                 x = -r5 u3 + (1 + r5) V5

rho is the source resistance of a pot's wiper, d_M the dial of pot M.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from analogrig.program import Program
from analogrig.rigs.emulator import CardDescription, ComputerDescription, EmulatorDescription, EmulatorRig
from analogrig.scenario import PotChange, Scenario
from analogrig_emulator import COMPONENTS, PROGRAMS, Capacitor, Components, OpAmp, Pot, Resistor, SuspensionComputer
from analogrig_instruments.calibration.averages import DISPLACEMENT, ProgramName, record, scenarios
from analogrig_instruments.calibration.fit import Calibration, Pots, Stock, calibrate, noise_free_lsb

_LOADS = {"M": "R1", "B": "RB", "K": "RK"}

GBW_HZ, SLEW_V_PER_S = 3e6, 13e6
"""Gain-bandwidth product and slew rate of the TL07x model."""


@dataclass(frozen=True)
class DrawnRig:
    """Random rig and the program wired on it."""

    description: EmulatorDescription
    program: ProgramName

    @property
    def stock(self) -> Stock:
        return self.description.computer.components


def draw_rig(number: int) -> DrawnRig:
    """Rig with random components within their tolerances.

    Every second one has the card of a served instrument, every third one pots set by dials, every fifth one is wired as
    the shock absorber.
    """
    rng = np.random.default_rng([20, number])
    span_v, bits = (20.0, 14) if number % 2 else (10.0, 12)
    card = CardDescription(
        range_v=dict.fromkeys(("force", "displacement", "velocity", "net_force"), (-span_v, span_v)),
        bits=bits,
        noise_lsb=float(rng.uniform(0.3, 1.0)),
        faults={
            "skew_s": (0.0, float(rng.integers(0, 25)) * 1.25e-6, 0.0, 0.0),
            "gain_error": tuple(rng.uniform(-2e-3, 2e-3, 4).tolist()),
            "offset_lsb": tuple(rng.uniform(-3.0, 3.0, 4).tolist()),
        },
    )
    stock: Stock = "polyester" if number % 4 < 2 else "polypropylene"
    pots: Pots = "dial" if number % 3 == 2 else "coefficient"
    computer = ComputerDescription(components=stock, specimen=number, offset_v=2e-3, pots=pots)
    return DrawnRig(EmulatorDescription(card=card, computer=computer), "shock" if number % 5 == 4 else "front")


def calibrate_rig(
    rig: DrawnRig, number: int, stocks: tuple[Stock, ...], pots: tuple[Pots, ...] = ("coefficient",)
) -> Calibration:
    """Calibration of a rig from recordings with independent noise."""
    with EmulatorRig(rig.description) as there:
        recordings = [record(there, each, 1000 * number + i) for i, each in enumerate(scenarios(rig.program))]
    return calibrate(recordings, stocks=stocks, pots=pots)


def truth(rig: DrawnRig) -> dict[str, float]:
    """True values of the estimates by name; those of the tracks apply to pots set by dials."""
    there, nominal = _values(rig.description, rig.program), _nominal(rig.program)
    channel = DISPLACEMENT
    card = rig.description.card
    gain = 1.0 + card.faults["gain_error"][channel]
    lsb_v = (card.range_v["displacement"][1] - card.range_v["displacement"][0]) / 2**card.bits
    r4, r5 = there["R4FB"] / there["R4"], there["R5FB"] / there["R5"]
    part = {name: there[name] / nominal[name] for name in nominal if name[0] in "RCMBK"}
    deviation = {
        "RF": part["RF"] * part["R5"] / (part["RK"] * part["R5FB"] * gain) - 1.0,
        "C1": part["C1"] * part["R1"] * part["RB"] * part["R4"] / (part["RFB"] * part["R4FB"]) - 1.0,
        "C2": part["C2"] * part["R2"] * part["RK"] * part["R4FB"] / (part["RB"] * part["R4"]) - 1.0,
    }
    twin = {**nominal, **{name: nominal[name] * (1.0 + deviation[name]) for name in deviation}}
    spring_ratio = gain * r5 * (there["RK"] / there["RFB"]) / (twin["RK"] / twin["RFB"])
    loop_ratio = gain * r5 * (there["RK"] / there["RB"]) / (twin["RK"] / twin["RB"])
    noise_gains = _noise_gain(there) / _noise_gain(twin)
    return {
        **deviation,
        "U1 offset": there["V1"] * spring_ratio * noise_gains,
        "U2 offset": there["V2"] * spring_ratio * twin["dial M"] / there["dial M"],
        "U4 offset": ((1.0 + r4) * there["V4"] - r4 * there["V3"]) / 2.0 * loop_ratio,
        "U1 bandwidth": there["GBW1"] / GBW_HZ / noise_gains - 1.0,
        **{f"U{i} bandwidth": there[f"GBW{i}"] / GBW_HZ - 1.0 for i in (2, 3, 4)},
        "U1 slew": there["SR1"] / SLEW_V_PER_S - 1.0,
        **{f"{pot} track": part[pot] / part[load] - 1.0 for pot, load in _LOADS.items()},
        "skew": card.faults["skew_s"][channel] + (1.0 / GBW_HZ - 1.0 / there["GBW5"]) / math.pi,
        "displacement offset": card.faults["offset_lsb"][channel] + gain * (1.0 + r5) * there["V5"] / lsb_v,
        "displacement noise": float(card.noise_lsb),  # type: ignore[arg-type]
        "force offset": card.faults["offset_lsb"][0],
        "force gain": card.faults["gain_error"][0],
        "force noise": float(card.noise_lsb),  # type: ignore[arg-type]
    }


def rms_lsb(rig: DrawnRig, twin: EmulatorDescription, scenario: Scenario) -> float:
    """Rms difference between the displacements of rig and twin over the whole scenario, without noise."""
    difference = noise_free_lsb(rig.description, scenario, 0) - noise_free_lsb(twin, scenario, 0)
    return float(np.sqrt(np.mean(difference[:, DISPLACEMENT] ** 2)))


def thesis_profile(program: ProgramName) -> Scenario:
    """Scenario of the thesis; for the shock absorber the same relative changes, but for M, which exceeds its pot."""
    thesis = Scenario.load("thesis")
    if program == "front":
        return thesis
    front, shock = PROGRAMS["front"].values, PROGRAMS["shock"].values
    b = shock["B"] / front["B"]
    k = shock["K"] / front["K"]
    return Scenario(
        samples=thesis.samples,
        excitation=thesis.excitation,
        program=Program.load("shock"),
        changes=(
            PotChange(1200, {"K": 18000.0 * k}),
            PotChange(1400, {"B": 3453.0 * b}),
            PotChange(1500, {"B": 2123.0 * b, "K": 20000.0 * k}),
        ),
        name="thesis, shock",
    )


def _values(description: EmulatorDescription, program: ProgramName) -> dict[str, float]:
    """Values of the rig's machine by name, in ohm, F, V, Hz, V/s, and its dials."""
    scenario = Scenario(samples=1, excitation=Scenario.load("thesis").excitation, program=Program.load(program))
    return _read(EmulatorRig(description).set_up(scenario, 0).computer, description.computer.components)


def _nominal(program: ProgramName) -> dict[str, float]:
    return _read(SuspensionComputer(program, components=Components()), "nominal")


def _read(computer: SuspensionComputer, stock: str) -> dict[str, float]:
    instantaneous = COMPONENTS[stock].dielectric.instantaneous
    out = {f"dial {pot}": dial for pot, dial in computer.dials.items()}
    for element in computer.circuit.elements:
        if isinstance(element, Resistor):
            out[element.name] = element.ohm
        elif isinstance(element, Pot):
            out[element.name] = element.track_ohm
        elif isinstance(element, Capacitor):
            out[element.name] = element.farad / instantaneous
        elif isinstance(element, OpAmp):
            number = element.name.removeprefix("U")
            out[f"V{number}"], out[f"GBW{number}"] = element.model.vos_v, element.model.gbw_hz
            out[f"SR{number}"] = element.model.slew_v_per_s
    return out


def _noise_gain(value: Mapping[str, float]) -> float:
    loads_ohm = [value["RF"], *(value[f"R{pot}"] + _source_ohm(value[f"dial {pot}"]) for pot in "BK")]
    return 1.0 + value["RFB"] * sum(1.0 / ohm for ohm in loads_ohm)


def _source_ohm(dial: float) -> float:
    return dial * (1.0 - dial) * 10e3
