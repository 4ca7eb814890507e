"""Modes of the analogue computer: which may follow which, and the circuit that the relays make in each.

    POT SET            integrators as in INITIAL CONDITION; every amplifier's inputs on ground instead of the junction,
                       so that pots keep their loads; a pot is read with its top on the reference
    INITIAL CONDITION  integrators charge to their initial voltages
    HOLD               integrators' inputs on ground instead of the junction: capacitors keep their voltages
    OPERATE            the circuit as patched

A mode is the circuit with its relays in another position, solved by nodal analysis like any other. Relays switch at any
tick, in no time and without bounce.
"""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from types import MappingProxyType
from typing import Any

from analogrig_emulator.circuit.circuit import Circuit, Element, label
from analogrig_emulator.circuit.elements import GROUND, Capacitor, OpAmp, Resistor, VoltageSource
from analogrig_emulator.circuit.nodal import Nodal
from analogrig_emulator.circuit.nonlinear import Multiplier
from analogrig_emulator.engine.system import Law
from analogrig_emulator.exceptions import CircuitError, ModeError
from analogrig_emulator.machine.patch_panel import Patch, patches

REFERENCE_V = 10.0
"""Reference voltage: limit of initial voltages, and at a pot's top while its coefficient is read."""

_AT_ONCE_OHM = 10e3


class Mode(enum.Enum):
    """Position of the relays."""

    POT_SET = "POT SET"
    INITIAL_CONDITION = "INITIAL CONDITION"
    HOLD = "HOLD"
    OPERATE = "OPERATE"

    @property
    def charges(self) -> bool:
        """True if integrators charge to their initial voltages."""
        return self in (Mode.INITIAL_CONDITION, Mode.POT_SET)


RelaySwitch = tuple[int, Mode]
"""(tick, mode): the relays switch at that tick, after its sample and edges."""

_FOLLOWERS: Mapping[Mode, frozenset[Mode]] = MappingProxyType(
    {
        Mode.POT_SET: frozenset({Mode.INITIAL_CONDITION}),
        Mode.INITIAL_CONDITION: frozenset({Mode.POT_SET, Mode.HOLD, Mode.OPERATE}),
        Mode.HOLD: frozenset({Mode.POT_SET, Mode.INITIAL_CONDITION, Mode.OPERATE}),
        Mode.OPERATE: frozenset({Mode.INITIAL_CONDITION, Mode.HOLD}),
    }
)


def check_modes(modes: Sequence[Mode]) -> None:
    """Raise ModeError unless each mode may follow the one before; the same mode again changes nothing."""
    for before, after in itertools.pairwise(modes):
        if after is not before and after not in _FOLLOWERS[before]:
            ways = ", ".join(sorted(mode.value for mode in _FOLLOWERS[before]))
            raise ModeError(f"{before.value} cannot be followed by {after.value}, only by {ways}")


class Relays:
    """Circuits of a patched circuit in each mode, with the initial voltages of its integrators; each analysed once.

    operate: analysis of the circuit as patched. ic_ohm: charging resistors, as for AnalogComputer.
    Raises CircuitError for errors of patching and for an initial voltage that no integrator takes.
    """

    def __init__(self, circuit: Circuit, operate: Nodal, initial_v: Mapping[str, float], ic_ohm: float | None) -> None:
        self._patched, self._ic_ohm = circuit, ic_ohm
        self._patches = patches(circuit)
        self._initial_v = dict(initial_v)
        self._nodals = {Mode.OPERATE: operate}
        self._check_integrators()

    def with_initial(self, initial_v: Mapping[str, float]) -> Relays:
        """The same with other initial voltages, by integrator. Raises CircuitError."""
        wanted = self._initial_v | dict(initial_v)
        if wanted.keys() != self._initial_v.keys():
            strangers = ", ".join(sorted(wanted.keys() - self._initial_v.keys()))
            raise CircuitError(f"{strangers}: no such integrator; there are {', '.join(self._initial_v) or 'none'}")
        relays = Relays(self._patched, self._nodals[Mode.OPERATE], wanted, self._ic_ohm)
        if Mode.HOLD in self._nodals:
            relays._nodals[Mode.HOLD] = self._nodals[Mode.HOLD]
        return relays

    def nodal(self, mode: Mode) -> Nodal:
        """Nodal analysis of a mode. Raises CircuitError for a circuit without a solution in that mode."""
        nodal = self._nodals.get(mode)
        if nodal is None:
            nodal = self._nodals[mode] = Nodal(self.circuit(mode))
        return nodal

    def circuit(self, mode: Mode) -> Circuit:
        """Circuit with the relays in the position of a mode."""
        if mode is Mode.OPERATE:
            return self._patched
        lifted = self._patches if mode is Mode.POT_SET else self._initial_v
        elements = list(self._patched.elements)
        for patch in (self._patches[amplifier] for amplifier in lifted):
            elements = [
                move_ends(each, patch.junction, GROUND) if each.name in patch.inputs else each for each in elements
            ]
        if mode is Mode.POT_SET:  # every input is at ground, and 0 / 0 has no value: dividers stand idle as multipliers
            elements = [replace(each, law=Law.PRODUCT) if isinstance(each, Multiplier) else each for each in elements]
        if mode is not Mode.HOLD:
            elements += [part for name in self._initial_v for part in self._charging_circuit(self._patches[name])]
        return Circuit(elements)

    def _charging_circuit(self, patch: Patch) -> list[Element]:
        """Charging circuit of one integrator: an inverter of gain 1 with the capacitor across it."""
        name, node, ohm = f"IC_{patch.amplifier}", f"ic_{patch.amplifier}", self._ic_ohm or _AT_ONCE_OHM
        return [
            VoltageSource(name, node, dc_v=-self._initial_v[patch.amplifier]),
            Resistor(f"{name}_in", node, patch.junction, ohm),
            Resistor(f"{name}_fb", patch.junction, patch.out, ohm),
        ]

    def _check_integrators(self) -> None:
        for name, volts in self._initial_v.items():
            patch = self._patches.get(name)
            if patch is None:
                raise CircuitError(f"no amplifier is called {name!r}; there are {', '.join(self._patches) or 'none'}")
            if not patch.capacitors:
                amp = next(amp for amp in self._patched.of(OpAmp) if amp.name == name)
                raise CircuitError(
                    f"{label(amp)}: an integrator without a capacitor between nodes {patch.junction} and {patch.out}"
                )
            if not math.isfinite(volts):
                raise CircuitError(f"integrator {name}: initial voltage {volts!r} is not finite")
            if abs(volts) > REFERENCE_V:
                raise CircuitError(
                    f"integrator {name}: initial voltage {volts:g} V is beyond the reference of {REFERENCE_V:g} V"
                )
        self._check_uncharged()

    def _check_uncharged(self) -> None:
        """Raise CircuitError for an integrator without initial voltage: it would drift into its limit."""
        for amp in self._patched.of(OpAmp):
            patch = self._patches[amp.name]
            if not patch.capacitors or amp.name in self._initial_v:
                continue
            parts = (part for part in self._patched.elements if not isinstance(part, Capacitor | OpAmp))
            if not any({patch.junction, patch.out} <= set(part.nodes) for part in parts):
                raise CircuitError(f"{label(amp)}: an integrator needs an initial voltage, if only {amp.name}: 0.0")


def move_ends(element: Element, node: str, to: str) -> Element:
    """Element with its ends at one node moved to another."""
    ends: dict[str, Any] = {
        field.name: to for field in fields(element) if field.name != "name" and getattr(element, field.name) == node
    }
    return replace(element, **ends)
