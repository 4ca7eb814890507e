"""The subcircuits of which decks are made, and the elements that they stand for, both ways."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from .circuit import DiodeLimiter, Element, OpAmp, Pot, Switch
from .deck_text import Definition, parse
from .errors import CircuitError
from .opamp import CLAMP_RATE, OpAmpModel
from .pot import END_FRACTION

__all__ = ["DEFINITIONS", "LIBRARY", "element_of", "instance_of"]

LIMITLESS = 1e99
"""What stands for infinity in a deck."""

LIBRARY: Mapping[str, str] = MappingProxyType(
    {
        # The capacitance only scales the currents to sizes that ngspice's tolerances suit (mA at full slew). An output
        # without resistance gets 0.1 mOhm, 1 uV at 10 mA.
        "opamp": f"""\
.subckt opamp plus minus out avol=2e5 gbw=3e6 slew=13e6 swing_low=-13.5 swing_high=13.5 rout=100 vos=0
Cstate state 0 1e-10
Bstate 0 state I = 1e-10 * (max(-{{slew}}, min({{slew}},
+ {2 * math.pi!r} * {{gbw}} * (v(plus, minus) + {{vos}} - v(state) / {{avol}})))
+ - {CLAMP_RATE!r} * (max(0, v(state) - {{swing_high}}) + min(0, v(state) - {{swing_low}})))
Einner inner 0 state 0 1
Rout inner out {{max(rout, 1e-4)}}
.ends""",
        "opamp_without_pole": """\
.subckt opamp_without_pole plus minus out avol=1e99 rout=0 vos=0
Binner inner 0 V = {min(avol, 1e9)} * (v(plus, minus) + {vos})
Rout inner out {max(rout, 1e-4)}
.ends""",
        "pot": f"""\
.subckt pot top wiper bottom track=10k dial=0.5
Rupper top wiper {{max(1 - dial, {END_FRACTION!r}) * track}}
Rlower wiper bottom {{max(dial, {END_FRACTION!r}) * track}}
.ends""",
        "turned_pot": f"""\
.subckt turned_pot top wiper bottom dial track=10k
Bupper top wiper I = v(top, wiper) / (max(1 - v(dial), {END_FRACTION!r}) * {{track}})
Blower wiper bottom I = v(wiper, bottom) / (max(v(dial), {END_FRACTION!r}) * {{track}})
.ends""",
        "diode_limiter": """\
.subckt diode_limiter a b threshold=0 on=1 off=1g
Roff a b {off}
Bon a b I = (1 / {on} - 1 / {off}) * max(0, v(a, b) - {threshold})
.ends""",
        "switch": """\
.subckt switch a b on=1 off=1g closed=1
Rab a b {closed * on + (1 - closed) * off}
.ends""",
        "time_points": """\
.subckt time_points node period=5e-5
Vnode node 0 PULSE(0 1 0 1n 1n {period / 2} {period})
.ends""",
    }
)
"""The subcircuits of which decks are made, by name."""

DEFINITIONS: Mapping[str, Definition] = parse("title\n" + "\n".join(LIBRARY.values()), "library")[1].inner
"""The same, parsed."""


def instance_of(element: OpAmp | Pot | DiodeLimiter | Switch) -> tuple[str, dict[str, float]]:
    """The subcircuit of an element, and its parameters; its nodes are those of the element, in their order."""
    match element:
        case OpAmp(model=model) if not model.has_state:
            return "opamp_without_pole", _finite(avol=model.avol, rout=model.rout_ohm, vos=model.vos_v)
        case OpAmp(model=model):
            low, high = model.swing_v
            return "opamp", _finite(
                avol=model.avol,
                gbw=model.gbw_hz,
                slew=model.slew_v_per_s,
                swing_low=low,
                swing_high=high,
                rout=model.rout_ohm,
                vos=model.vos_v,
            )
        case Pot():
            return "pot", {"track": element.track_ohm, "dial": element.dial}
        case DiodeLimiter():
            return "diode_limiter", {
                "threshold": element.threshold_v,
                "on": element.on_ohm,
                "off": element.off_ohm,
            }
        case Switch():
            return "switch", {"on": element.on_ohm, "off": element.off_ohm, "closed": float(element.closed)}


def element_of(subcircuit: str, name: str, nodes: Sequence[str], values: Mapping[str, float]) -> Element | None:
    """The element of an instance, all its parameters given; a turned pot stands at 0, and time points are none.

    nodes: as many as the subcircuit has ports. Raises CircuitError for parameters that cannot be.
    """
    match subcircuit:
        case "opamp" | "opamp_without_pole":
            plus, minus, out = nodes
            return OpAmp(name, plus, minus, out, _model(values))
        case "pot" | "turned_pot":
            top, wiper, bottom = nodes[:3]
            return Pot(name, top, wiper, bottom, values["track"], values.get("dial", 0.0))
        case "diode_limiter":
            a, b = nodes
            return DiodeLimiter(name, a, b, values["threshold"], values["on"], values["off"])
        case "switch":
            a, b = nodes
            if values["closed"] not in {0.0, 1.0}:
                raise CircuitError(f"closed must be 0 or 1, got {values['closed']:g}")
            return Switch(name, a, b, values["on"], values["off"], closed=values["closed"] == 1.0)
    return None


def _finite(**values: float) -> dict[str, float]:
    return {name: v if math.isfinite(v) else math.copysign(LIMITLESS, v) for name, v in values.items()}


def _model(given: Mapping[str, float]) -> OpAmpModel:
    """An op-amp of the parameters of LIBRARY's op-amps."""
    values = {name: math.copysign(math.inf, v) if abs(v) >= LIMITLESS else v for name, v in given.items()}
    return OpAmpModel(
        avol=values["avol"],
        gbw_hz=values.get("gbw", math.inf),
        slew_v_per_s=values.get("slew", math.inf),
        swing_v=(values.get("swing_low", -math.inf), values.get("swing_high", math.inf)),
        rout_ohm=values["rout"],
        vos_v=values["vos"],
    )
