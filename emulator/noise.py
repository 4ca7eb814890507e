"""Thermal noise of the resistors and input noise of the op-amps, exact at the samples.

The noise is small, so it is the solution of the linear circuit (no amplifier at a limit) driven by white sources alone,
and adds to what the engine plays. With dx = A x dt + B dw, one sample period T takes the noise x to

    Phi x + w,   Phi = exp(A T),   cov(w) = integral over 0..T of exp(A s) B B' exp(A' s) ds

both by doubling a short step. Sources (two-sided densities): 2 k T R in series with each resistor and each leg of a
pot, en^2 / 2 in series with the + input of an op-amp, in^2 / 2 into each of its inputs. What reaches an output without
passing a state is left out: a resistor's noise divided down by an output resistance, white without bound in this
model, some nV per root Hz in a real one. Elementwise arithmetic only, so a seed has the same bits on every machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .circuit import GROUND, Circuit, Element, OpAmp, Pot, Resistor, VoltageSource
from .components import REFERENCE_C, OpAmpGrade
from .errors import CircuitError
from .excitation import Excitation
from .nodal import PiecewiseLinear, piecewise_linear
from .pot import legs_ohm
from .suspension import RampedTweak, SuspensionComputer, Tweak

__all__ = ["BOLTZMANN_J_PER_K", "CircuitNoise", "NoisySuspension"]

BOLTZMANN_J_PER_K = 1.380649e-23
_ZERO_C_K = 273.15

_INJECTOR_OHM = 1e12
"""Behind it a noise voltage is a noise current."""

_TERMS = 8
"""Of the Taylor series of the short step."""

_SHORT = 1e-2
"""Largest norm of A h for the short step h: the series ends within 1e-19 of its sum."""

Matrix = NDArray[np.float64]


class CircuitNoise:
    """The noise of a circuit's nodes at the samples; it starts at none.

    outputs: nodes; op_amps: whose noise_v_per_rthz and noise_a_per_rthz every op-amp has; temperature_c: of the
    resistors. Raises CircuitError for a node that is not there or a circuit that is singular.
    """

    def __init__(
        self,
        circuit: Circuit,
        outputs: Sequence[str],
        *,
        op_amps: OpAmpGrade,
        temperature_c: float = REFERENCE_C,
        sample_rate_hz: float = 20e3,
    ) -> None:
        self._outputs = tuple(outputs)
        self._op_amps = op_amps
        self._temperature_k = temperature_c + _ZERO_C_K
        self._period_s = 1.0 / sample_rate_hz
        self.set_circuit(circuit)
        self._x = np.zeros(len(self.transition))

    def set_circuit(self, circuit: Circuit) -> None:
        """Goes on with another circuit of the same states: a pot was turned."""
        fixed = Circuit(_without_pots(circuit))
        system = piecewise_linear(fixed)
        a, _ = _linear(system)
        intensity = np.zeros_like(a)
        for elements, density in _sources(fixed, self._op_amps, self._temperature_k):
            column = _linear(piecewise_linear(Circuit(elements)))[1][:, -1]
            intensity += density * column[:, None] * column[None, :]
        self.transition, self.covariance = _over(a, intensity, self._period_s)
        self._factor = _semidefinite_factor(self.covariance)
        self._reading = system.readings(self._outputs)[:, : len(a)]

    def volts(self, samples: int, rng: np.random.Generator) -> Matrix:
        """The noise at the next samples, (samples, outputs), in V. Cutting a run into blocks changes no bit."""
        steps = rng.standard_normal((samples, len(self._x)))
        states = np.empty_like(steps)
        for k, step in enumerate(steps):
            states[k] = self._x
            self._x = (self.transition * self._x).sum(axis=1) + (self._factor * step).sum(axis=1)
        return np.asarray((self._reading[None] * states[:, None, :]).sum(axis=2))


class NoisySuspension:
    """A SuspensionComputer with the noise of its resistors and op-amps added to every voltage that it plays."""

    def __init__(
        self,
        computer: SuspensionComputer,
        rng: np.random.Generator,
        *,
        op_amps: OpAmpGrade,
        temperature_c: float = REFERENCE_C,
    ) -> None:
        self._computer = computer
        self._rng = rng
        self._op_amps = op_amps
        self._temperature_c = temperature_c

    def play(
        self,
        excitation: Excitation,
        samples: int,
        tweaks: Sequence[Tweak | RampedTweak] = (),
        block_samples: int = 4096,
    ) -> Iterator[Matrix]:
        """As SuspensionComputer.play; set() between two blocks does not reach the noise, a ramp when it has ended."""
        computer = self._computer
        circuit = computer.circuit
        turns = [(turn.sample + 1 + turn.ramp_n, turn.dials) for turn in computer.planned(tweaks, samples)]
        turns.sort(key=lambda turn: turn[0])
        noise = CircuitNoise(
            circuit,
            computer.program.channel_nodes,
            op_amps=self._op_amps,
            temperature_c=self._temperature_c,
            sample_rate_hz=computer.sample_rate_hz,
        )
        return self._blocks(computer.play(excitation, samples, tweaks, block_samples), noise, circuit, turns)

    def _blocks(
        self, quiet: Iterator[Matrix], noise: CircuitNoise, circuit: Circuit, turns: list[tuple[int, dict[str, float]]]
    ) -> Iterator[Matrix]:
        first = 0
        for block in quiet:
            done = 0
            while done < len(block):
                while turns and turns[0][0] <= first + done:
                    circuit = circuit.with_dials(turns.pop(0)[1])
                    noise.set_circuit(circuit)
                until = min(len(block), turns[0][0] - first) if turns else len(block)
                block[done:until] += noise.volts(until - done, self._rng) * self._computer.program.channel_signs
                done = until
            first += len(block)
            yield block


def _without_pots(circuit: Circuit) -> Iterator[Element]:
    for element in circuit.elements:
        if isinstance(element, Pot):
            upper_ohm, lower_ohm = legs_ohm(element.dial, element.track_ohm)
            yield Resistor(f"{element.name}_upper", element.top, element.wiper, upper_ohm)
            yield Resistor(f"{element.name}_lower", element.wiper, element.bottom, lower_ohm)
        else:
            yield element


def _sources(
    circuit: Circuit, op_amps: OpAmpGrade, temperature_k: float
) -> Iterator[tuple[tuple[Element, ...], float]]:
    """The netlist with one noise voltage as its last input, and that voltage's two-sided density in V^2/Hz."""
    for i, element in enumerate(circuit.elements):
        if isinstance(element, Resistor):
            noisy = replace(element, a="noise")
            yield _with(circuit, i, noisy, "noise", element.a), 2 * BOLTZMANN_J_PER_K * temperature_k * element.ohm
        elif isinstance(element, OpAmp):
            if op_amps.noise_v_per_rthz > 0:
                noisy_amp = replace(element, plus="noise")
                yield _with(circuit, i, noisy_amp, "noise", element.plus), op_amps.noise_v_per_rthz**2 / 2
            for node in (element.plus, element.minus):
                if node != GROUND and op_amps.noise_a_per_rthz > 0:
                    injector = Resistor("noise_ohm", "noise", node, _INJECTOR_OHM)
                    elements = (*circuit.elements, injector, VoltageSource("noise", "noise"))
                    yield elements, (op_amps.noise_a_per_rthz * _INJECTOR_OHM) ** 2 / 2


def _with(circuit: Circuit, i: int, element: Element, plus: str, minus: str) -> tuple[Element, ...]:
    """The netlist with element i replaced, and an input from plus to minus."""
    return (*circuit.elements[:i], element, *circuit.elements[i + 1 :], VoltageSource("noise", plus, minus))


def _linear(system: PiecewiseLinear) -> tuple[Matrix, Matrix]:
    """A and B when no amplifier is at a limit: (n, n) and (n, inputs)."""
    slopes = np.array([kink.slopes[1] for kink in system.kinks])
    coupling = system.g * slopes
    whole = system.abc + (coupling[:, :, None] * system.cde[None]).sum(axis=1)
    n = len(system.states)
    return whole[:, :n], whole[:, n:-1]


def _over(a: Matrix, intensity: Matrix, period_s: float) -> tuple[Matrix, Matrix]:
    """exp(A T), and the covariance gathered over T.

    The short step's covariance is the Taylor series of dP/dt = A P + P A' + Q; doubling is P + Phi P Phi'.
    """
    norm = float(np.abs(a).sum(axis=1).max()) * period_s
    doublings = max(0, int(np.ceil(np.log2(max(norm, _SHORT) / _SHORT))))
    step_s = period_s / 2**doublings
    change, power = np.zeros_like(a), np.eye(len(a))
    covariance, term = np.zeros_like(a), intensity * step_s
    for j in range(1, _TERMS + 1):
        power = _product(power, a) * (step_s / j)
        change += power
        covariance += term
        grown = _product(a, term)
        term = (grown + grown.T) * (step_s / (j + 1))
    for _ in range(doublings):
        grown = _product(change, covariance)
        covariance = 2 * covariance + grown + grown.T + _product(grown, change.T)
        change = 2 * change + _product(change, change)
    transition = change + np.eye(len(a))
    if not (np.isfinite(transition).all() and np.isfinite(covariance).all()):
        raise CircuitError("the noise of this circuit has no bound: the circuit is unstable")
    return transition, covariance


def _product(left: Matrix, right: Matrix) -> Matrix:
    """Left @ right without BLAS, whose sums differ from machine to machine."""
    return np.asarray((left[:, :, None] * right[None]).sum(axis=1))


def _semidefinite_factor(covariance: Matrix) -> Matrix:
    """Lower triangular F with F F' = covariance, by Cholesky; directions without noise have columns of zeros."""
    left = covariance.copy()
    factor = np.zeros_like(left)
    for k in range(len(left)):
        if left[k, k] > 1e-12 * covariance[k, k]:
            factor[k:, k] = left[k:, k] / np.sqrt(left[k, k])
            left[k:, k:] -= factor[k:, k, None] * factor[None, k:, k]
    return factor
