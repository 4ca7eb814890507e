"""The front suspension with a square wave for gnucap, whose behavioural sources take one variable each.

A slew limit is a piecewise-linear source behind a node that sums the op-amp's inputs. Pots stand still: a resistor that
follows a voltage would need a product of two variables.
"""

from __future__ import annotations

import math
import re
import resource
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator import TICKS_PER_SAMPLE, Capacitor, Circuit, Edges, OpAmp, Pot, Resistor
from analogrig_emulator.circuit.opamp import CLAMP_RATE
from analogrig_emulator.circuit.pot import legs_ohm

STATE_FARAD = 1e-10
EDGE_S = 1e-11
FAR_V = 1e4

SUFFIXES: Mapping[str, float] = {"K": 1e3, "": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9, "p": 1e-12, "f": 1e-15}
ROW = re.compile(r"^ *([-+.\d]+(?:E[-+]?\d+)?)([KmunpfM]?) +([-+.\d]+(?:E[-+]?\d+)?)([KmunpfM]?) *$", re.MULTILINE)


@dataclass(frozen=True)
class Setting:
    """One way to run gnucap."""

    method: str
    reltol: float
    trtol: float
    max_step_s: float

    def __str__(self) -> str:
        """The setting in words."""
        return f"{self.method}, reltol {self.reltol:g}, trtol {self.trtol:g}, dtmax {1e6 * self.max_step_s:g} us"


def deck(setting: Setting, circuit: Circuit, edges: Edges, samples: int, rate_hz: float) -> str:
    """Text of a circuit of resistors, capacitors, pots at rest and op-amps."""
    lines = ["* analogue computer", _source(edges, samples, rate_hz)]
    lines += [f"{part.name} {part.a} {part.b} {part.ohm!r}" for part in circuit.of(Resistor)]
    lines += [f"{part.name} {part.a} {part.b} {part.farad!r}" for part in circuit.of(Capacitor)]
    for pot in circuit.of(Pot):
        upper, lower = legs_ohm(pot.dial, pot.track_ohm)
        lines.append(f"R{pot.name}_upper {pot.top} {pot.wiper} {upper!r}")
        lines.append(f"R{pot.name}_lower {pot.wiper} {pot.bottom} {lower!r}")
    for amp in circuit.of(OpAmp):
        lines += _op_amp(amp)
    lines.append(f".options reltol={setting.reltol} vntol=1e-6 trtol={setting.trtol} method={setting.method} numdgt=9")
    lines += [
        ".print tran v(u5)",
        f".tran 0 {(samples - 1) / rate_hz!r} {1 / rate_hz!r} dtmax {setting.max_step_s} uic",
    ]
    return "\n".join([*lines, ".end", ""])


def _source(edges: Edges, samples: int, rate_hz: float) -> str:
    instants_s = edges.ticks / TICKS_PER_SAMPLE / rate_hz
    corners, level_v = [], float(edges.levels_v[0])
    for instant_s, next_v in zip(instants_s.tolist(), edges.levels_v.tolist(), strict=True):
        corners += [(instant_s, level_v), (instant_s + EDGE_S, next_v)]
        level_v = next_v
    corners.append((samples / rate_hz, level_v))
    return "V_F in 0 PWL(" + " ".join(f"{at_s:.14g},{volts!r}" for at_s, volts in corners) + ")"


def _op_amp(amp: OpAmp) -> Iterator[str]:
    """Law of an op-amp without offset, in V and V/us."""
    name, model = amp.name, amp.model
    rate, slew = 2e-6 * math.pi * model.gbw_hz, 1e-6 * model.slew_v_per_s
    amperes = 1e6 * STATE_FARAD * slew
    low, high = model.swing_v
    pull = CLAMP_RATE * STATE_FARAD * FAR_V
    yield f"Gin_{name} 0 m_{name} {amp.plus} {amp.minus} {rate!r}"
    yield f"Gleak_{name} m_{name} 0 x_{name} 0 {rate / model.avol!r}"
    yield f"Rm_{name} m_{name} 0 1"
    limits = f"{-FAR_V},{-amperes} {-slew},{-amperes} {slew},{amperes} {FAR_V},{amperes}"
    yield f"Gslew_{name} 0 x_{name} m_{name} 0 PWL({limits})"
    yield f"Gclamp_{name} x_{name} 0 x_{name} 0 PWL({low - FAR_V},{-pull} {low},0 {high},0 {high + FAR_V},{pull})"
    yield f"C{name} x_{name} 0 {STATE_FARAD}"
    yield f"Gout_{name} 0 {amp.out} x_{name} 0 {1 / model.rout_ohm!r}"
    yield f"Rout_{name} {amp.out} 0 {model.rout_ohm!r}"


def run(text: str) -> tuple[float, NDArray[np.float64]]:
    """CPU time of a deck in s, and instant in s and volts of each row that gnucap prints: (rows, 2)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "deck.ckt")
        path.write_text(text)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        printed = subprocess.run(["gnucap", "-b", path], capture_output=True, check=True, text=True).stdout
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    rows = [(float(t) * SUFFIXES[of_t], float(v) * SUFFIXES[of_v]) for t, of_t, v, of_v in ROW.findall(printed)]
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, np.array(rows).reshape(-1, 2)
