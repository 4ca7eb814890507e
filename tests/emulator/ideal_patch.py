"""Netlist with ideal parts, solved at one instant: voltages of the integrators in, their slopes out.

It reads elements alone and knows nothing of stages, scales or signs, so it can judge the compiler.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import root

from analogrig_emulator import Capacitor, DiodeLimiter, OpAmp, Pot, Resistor, VoltageSource
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.circuit.pot import legs_ohm
from tests.emulator.plays import Volts

_LEAST_INTEGRATOR_FARAD = 0.9e-9


@dataclass
class IdealPatch:
    """elements: with pots at 0; dials: by pot."""

    elements: Sequence[object]
    dials: Mapping[str, float]

    def __post_init__(self) -> None:
        self.amps = [each for each in self.elements if isinstance(each, OpAmp)]
        self.pots = {each.wiper: each for each in self.elements if isinstance(each, Pot)}
        self.capacitors = {
            each.a: each.farad
            for each in self.elements
            if isinstance(each, Capacitor) and each.farad > _LEAST_INTEGRATOR_FARAD
        }

    def slopes(self, known_v: Mapping[str, float], guess_v: Mapping[str, float]) -> dict[str, float]:
        """dv/dt in V/s of every integrator's output, by node.

        known_v: inputs and integrators' outputs; guess_v: other outputs, where the search for them begins.
        """
        nodes = list(guess_v)
        constants = {
            each.plus: each.dc_v for each in self.elements if isinstance(each, VoltageSource) and each.dc_v is not None
        }

        def at(volts: Volts) -> dict[str, float]:
            return {**constants, **known_v, **dict(zip(nodes, volts.tolist(), strict=True)), "0": 0.0}

        found = root(
            lambda volts: self._errors(at(volts), nodes), np.array([guess_v[node] for node in nodes]), tol=1e-13
        )
        volts = at(found.x)
        assert np.abs(self._errors(volts, nodes)).max(initial=0.0) < 1e-8, found.message
        return {
            amp.out: -sum(self._currents(amp.minus, volts)) / self.capacitors[amp.minus]
            for amp in self.amps
            if amp.minus in self.capacitors
        }

    def _errors(self, volts: Mapping[str, float], nodes: Sequence[str]) -> Volts:
        """Currents in mA that no amplifier cancels, and V by which products and functions are off."""
        errors = {amp.out: 1e5 * sum(self._currents(amp.minus, volts)) for amp in self.amps}
        for each in self.elements:
            if isinstance(each, Multiplier):
                errors[each.out] = volts[each.out] - volts[each.x] * volts[each.y] / each.scale_v
            if isinstance(each, Function):
                at, to = np.array(each.breakpoints).T
                errors[each.out] = volts[each.out] - float(np.interp(volts[each.x], at, to))
        return np.array([errors[node] for node in nodes])

    def _currents(self, junction: str, volts: Mapping[str, float]) -> Iterator[float]:
        """Currents into a junction at 0 V, capacitors left out."""
        for each in self.elements:
            if isinstance(each, Resistor) and each.b == junction:
                yield self._source_v(each.a, each.ohm, volts) / each.ohm
            elif isinstance(each, Resistor) and each.a == junction:
                yield volts[each.b] / each.ohm
            elif isinstance(each, DiodeLimiter) and junction in (each.a, each.b):
                yield self._limited(each, junction, volts)

    def _source_v(self, node: str, load_ohm: float, volts: Mapping[str, float]) -> float:
        if node not in self.pots:
            return volts[node]
        pot = self.pots[node]
        upper, lower = legs_ohm(self.dials[pot.name], pot.track_ohm)
        return volts[pot.top] / upper / (1 / upper + 1 / lower + 1 / load_ohm)

    @staticmethod
    def _limited(limiter: DiodeLimiter, junction: str, volts: Mapping[str, float]) -> float:
        across = (0.0 if limiter.a == junction else volts[limiter.a]) - (
            0.0 if limiter.b == junction else volts[limiter.b]
        )
        current = across / limiter.off_ohm + limiter.excess_siemens * max(0.0, across - limiter.threshold_v)
        return current if limiter.b == junction else -current
