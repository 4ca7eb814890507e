"""Thermal noise of the resistors, input noise of the op-amps and hum of their supply, exact at the samples.

The noise is small: it is the solution of the linear circuit with white sources, and adds to the engine's voltages.
No amplifier limits and no diode limiter conducts in that circuit, so a bump stop does not change the noise. Products
are held in it: noise begins at a multiplier's output, and ends at its inputs.
With dx = A x dt + B dw, one sample period T takes the noise x to

    Phi x + w,   Phi = exp(A T),   cov(w) = integral over 0..T of exp(A s) B B' exp(A' s) ds

both by doubling a short step (engine/noise.c). Sources (two-sided densities): 2 k T / R across each resistor and each
leg of a pot, en^2 / 2 in series with the + input of an op-amp and in a product, in^2 / 2 into each of an op-amp's
inputs. Noise that reaches an
output without passing a state is omitted: white without bound in this model, some nV per root Hz in reality.

1/f noise of an op-amp is the sum of one first-order process a decade, from 1 Hz to 1 kHz, each with the variance
K ln 10 that the density K / f has in a decade; K = en^2 times the frequency where both are equal. Its level at the
first sample is drawn too. Hum of the supply, over the rejection, is in series with the + input of every op-amp. Both
are states that drive the circuit.
Elementwise arithmetic only, so a seed has the same bits on every machine.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.circuit.circuit import Circuit
from analogrig_emulator.circuit.components import REFERENCE_C, OpAmpGrade
from analogrig_emulator.circuit.elements import GROUND, OpAmp, Pot, Resistor
from analogrig_emulator.circuit.nodal import analyse
from analogrig_emulator.circuit.nonlinear import Multiplier
from analogrig_emulator.circuit.pot import PotTurn, legs_ohm
from analogrig_emulator.engine import binding
from analogrig_emulator.exceptions import CircuitError
from analogrig_emulator.machine.suspension import BLOCK_SAMPLES, SuspensionComputer

BOLTZMANN_J_PER_K = 1.380649e-23
ABSOLUTE_ZERO_C = -273.15

_ROOT_TWO = math.sqrt(2.0)
_TURN = 2.0 * math.pi

_FLICKER_HZ = (1.0, 10.0, 100.0, 1000.0)
"""Corners of the processes that make up 1/f noise."""

_KEPT_PROPAGATIONS = 16

_MOST_GROWTH_PER_S = 1.0
"""Rate of growth, in 1/s, beyond which a circuit with its products held is unstable; rounding makes up to 0.1."""

Matrix = NDArray[np.float64]


class Propagation(NamedTuple):
    """Noise over one sample period at some dials.

    transition, covariance: Phi and cov(w), (n, n); factor: Cholesky factor of the covariance; reading: outputs by
    state, (outputs, n). addresses: those of transition, factor and reading.
    """

    transition: Matrix
    covariance: Matrix
    factor: Matrix
    reading: Matrix
    addresses: tuple[int, int, int]

    @classmethod
    def of(cls, transition: Matrix, covariance: Matrix, factor: Matrix, reading: Matrix) -> Propagation:
        addresses = (transition.ctypes.data, factor.ctypes.data, reading.ctypes.data)
        return cls(transition, covariance, factor, reading, addresses)


@dataclass(frozen=True)
class Supply:
    """Supply of the op-amps: a sine of amplitude hum_v at hum_hz, 0 V and rising at sample 0. Raises CircuitError."""

    hum_v: float = 0.0
    hum_hz: float = 100.0

    def __post_init__(self) -> None:
        if not 0 <= self.hum_v < math.inf:
            raise CircuitError(f"supply: hum_v must be finite and not negative, got {self.hum_v!r}")
        if not 0 < self.hum_hz < math.inf:
            raise CircuitError(f"supply: hum_hz must be positive and finite, got {self.hum_hz!r}")


QUIET = Supply()
"""Supply without hum."""


@dataclass(frozen=True)
class _Conditions:
    """Conditions of a noise, apart from circuit and dials."""

    outputs: tuple[str, ...]
    op_amps: OpAmpGrade
    temperature_k: float
    period_s: float
    supply: Supply

    @property
    def flicker_v(self) -> float:
        """Rms of each process of an op-amp's 1/f noise."""
        return self.op_amps.noise_v_per_rthz * math.sqrt(self.op_amps.flicker_hz * math.log(10.0))

    @property
    def hum_v(self) -> float:
        """Amplitude of the hum at an op-amp's input."""
        return self.supply.hum_v / self.op_amps.psrr


class _Sources:
    """Sources of noise in one circuit. Its last propagations are kept: returning to earlier dials costs nothing."""

    def __init__(self, circuit: Circuit) -> None:
        self._nodal = analyse(circuit)
        self._tracks_ohm = [(pot.name, pot.track_ohm) for pot in circuit.of(Pot)]
        self._amps = circuit.of(OpAmp)
        self._multipliers = [part for part in circuit.of(Multiplier) if part.model.has_state]
        self._fixed_ohm = [resistor.ohm for resistor in circuit.of(Resistor)]
        bonds = [(resistor.a, resistor.b) for resistor in circuit.of(Resistor)]
        bonds += [leg for pot in circuit.of(Pot) for leg in pot.bonds]
        self._from, self._to = [a for a, _ in bonds], [b for _, b in bonds]
        self._kept: dict[object, Propagation] = {}

    def propagation(self, conditions: _Conditions, dials: Mapping[str, float]) -> Propagation:
        """Propagation at dials of all pots. Raises CircuitError."""
        place = (conditions, tuple([dials[name] for name, _ in self._tracks_ohm]))
        found = self._kept.get(place)
        if found is None:
            found = self._propagate(conditions, dials)
            if len(self._kept) >= _KEPT_PROPAGATIONS:
                del self._kept[next(iter(self._kept))]
            self._kept[place] = found
        return found

    def _propagate(self, conditions: _Conditions, dials: Mapping[str, float]) -> Propagation:
        system = self._nodal.at(dials)
        n, slopes = len(system.states), np.array([kink.slopes[1] for kink in system.kinks])
        circuit = system.abc[:, :n] + _product(system.g * slopes, system.cde[:, :n])  # without active limits
        if system.products and np.linalg.eigvals(circuit).real.max() > _MOST_GROWTH_PER_S:
            raise CircuitError(
                "noise and hum of this program cannot be computed: products are held in them, and without its products "
                "the plant is unstable, or a divider or root of real amplifiers is; play it without noise and hum"
            )
        response = self._nodal.disturbances(dials)
        drives = self._drives(conditions, dials, response)
        a, inputs = self._with_shapers(conditions, circuit, response)
        intensity = np.diag(inputs**2)
        n = len(circuit)
        intensity[:n, :n] = _product(drives.T, drives)
        reading = np.zeros((len(conditions.outputs), len(a)))
        reading[:, :n] = system.readings(conditions.outputs)[:, :n]
        return Propagation.of(*_propagate(a, intensity, conditions.period_s), reading)

    def initial(self, conditions: _Conditions, states: int, rng: np.random.Generator) -> Matrix:
        """First state of a noise: circuit at rest, 1/f noise of any level, hum at 0 V and rising."""
        x = np.zeros(states)
        if conditions.hum_v > 0:
            x[-1] = conditions.hum_v
        if conditions.flicker_v > 0:
            count = len(self._amps) * len(_FLICKER_HZ)
            first = states - count - (2 if conditions.hum_v > 0 else 0)
            x[first : first + count] = conditions.flicker_v * rng.standard_normal(count)
        return x

    def _with_shapers(
        self, conditions: _Conditions, circuit: Matrix, response: Mapping[str, Matrix]
    ) -> tuple[Matrix, Matrix]:
        """Matrix A with the processes of 1/f noise, then the hum and its quadrature; white drive of each state."""
        corners_hz = [(amp.name, hz) for amp in self._amps for hz in _FLICKER_HZ if conditions.flicker_v > 0]
        n, hums = len(circuit), 2 if conditions.hum_v > 0 else 0
        size = n + len(corners_hz) + hums
        if size > binding.MAX_NOISE_STATES:
            raise CircuitError(f"the noise has {size} states; the engine takes at most {binding.MAX_NOISE_STATES}")
        a, inputs = np.zeros((size, size)), np.zeros(size)
        a[:n, :n] = circuit
        for i, (name, hz) in enumerate(corners_hz, n):
            a[:n, i] = response[name]
            a[i, i] = -_TURN * hz
            inputs[i] = conditions.flicker_v * math.sqrt(2.0 * _TURN * hz)
        if hums:
            a[:n, -2] = _rows_of(response, [amp.name for amp in self._amps]).sum(axis=0)
            a[-2, -1], a[-1, -2] = _TURN * conditions.supply.hum_hz, -_TURN * conditions.supply.hum_hz
        return a, inputs

    def _drives(self, conditions: _Conditions, dials: Mapping[str, float], response: Mapping[str, Matrix]) -> Matrix:
        """Contribution of each source to dx/dt, in V/s per root of its two-sided density: (sources, n)."""
        grade = conditions.op_amps
        legs_of_pots = [legs_ohm(dials[name], track_ohm) for name, track_ohm in self._tracks_ohm]
        ohm = np.array([*self._fixed_ohm, *itertools.chain.from_iterable(legs_of_pots)])
        thermal = _rows_of(response, self._from) - _rows_of(response, self._to)
        thermal *= np.sqrt(2 * BOLTZMANN_J_PER_K * conditions.temperature_k / ohm)[:, None]
        voltages = _rows_of(response, [amp.name for amp in self._amps]) * (grade.noise_v_per_rthz / _ROOT_TWO)
        inputs = [node for amp in self._amps for node in (amp.plus, amp.minus)]
        currents = _rows_of(response, inputs) * (grade.noise_a_per_rthz / _ROOT_TWO)
        densities = np.array([part.model.noise_v_per_rthz / _ROOT_TWO for part in self._multipliers])
        products = _rows_of(response, [part.name for part in self._multipliers]) * densities[:, None]
        return np.concatenate((thermal, voltages, currents, products))


class CircuitNoise:
    """Noise of a circuit's nodes at the samples, from zero.

    outputs: nodes; op_amps: grade with the noise and the supply rejection of every op-amp; temperature_c: temperature
    of the resistors. Raises CircuitError for an unknown node, a singular circuit or too many states.
    """

    def __init__(
        self,
        circuit: Circuit,
        outputs: Sequence[str],
        *,
        op_amps: OpAmpGrade,
        temperature_c: float = REFERENCE_C,
        sample_rate_hz: float = 20e3,
        supply: Supply = QUIET,
    ) -> None:
        temperature_k = temperature_c - ABSOLUTE_ZERO_C
        self._conditions = _Conditions(tuple(outputs), op_amps, temperature_k, 1.0 / sample_rate_hz, supply)
        self._sources = circuit.untrimmed.derive(_Sources)
        self._dials = {pot.name: pot.dial for pot in circuit.of(Pot)}
        self.turn({})
        self._x: Matrix | None = None

    @property
    def transition(self) -> Matrix:
        """exp(A T) at the present dials, (n, n)."""
        return self._propagation.transition

    @property
    def covariance(self) -> Matrix:
        """Covariance gathered in one sample period at the present dials, (n, n)."""
        return self._propagation.covariance

    def turn(self, dials: Mapping[str, float]) -> None:
        """Turn pots to dials."""
        self._dials |= dials
        self._propagation = self._sources.propagation(self._conditions, self._dials)

    def volts(self, samples: int, rng: np.random.Generator) -> Matrix:
        """Noise at the next samples: (samples, outputs), V. Cutting a run into blocks changes no bit."""
        volts = np.zeros((samples, len(self._propagation.reading)))
        self.add_to(volts, np.ones(volts.shape[1]), (), rng)
        return volts

    def add_to(
        self,
        volts: Matrix,
        signs: Matrix,
        turns: Sequence[tuple[int, Mapping[str, float]]],
        rng: np.random.Generator,
    ) -> None:
        """Add the noise of the next samples, times signs, to volts (samples, outputs).

        turns: dials set before a row of volts, in order of rows.
        """
        if self._x is None:
            self._x = self._sources.initial(self._conditions, len(self.transition), rng)
        stretches, begun = [], 0
        for row, dials in turns:
            stretches.append(binding.Noise(row - begun, *self._propagation.addresses))
            self.turn(dials)
            begun = row
        stretches.append(binding.Noise(len(volts) - begun, *self._propagation.addresses))
        normal = rng.standard_normal((len(volts), len(self._x)))
        addresses = [array.ctypes.data for array in (signs, normal, self._x, volts)]
        array_of_stretches = (binding.Noise * len(stretches))(*stretches)
        binding.load().engine_noise_add(len(self._x), len(signs), len(stretches), array_of_stretches, *addresses)


class NoisySuspension:
    """SuspensionComputer whose voltages include the noise of its resistors and op-amps, and hum of their supply."""

    def __init__(
        self,
        computer: SuspensionComputer,
        rng: np.random.Generator,
        *,
        op_amps: OpAmpGrade,
        temperature_c: float = REFERENCE_C,
        supply: Supply = QUIET,
    ) -> None:
        self._supply = supply
        self._computer = computer
        self._rng = rng
        self._op_amps = op_amps
        self._temperature_c = temperature_c

    @property
    def sample_rate_hz(self) -> float:
        """Sample rate of the computer."""
        return self._computer.sample_rate_hz

    def play(
        self,
        excitation: Excitation,
        samples: int,
        changes: Sequence[PotTurn] = (),
        block_samples: int = BLOCK_SAMPLES,
        ahead_ticks: int = 0,
    ) -> Iterator[Matrix]:
        """Play like SuspensionComputer.play. The noise ignores set() between blocks, and follows a ramp at its end.

        It does not change within ahead_ticks.
        """
        computer = self._computer
        planned = computer.plan(changes, samples)
        turns = sorted(((turn.sample + 1 + turn.ramp_n, turn.values) for turn in planned), key=lambda turn: turn[0])
        noise = CircuitNoise(
            computer.circuit,
            computer.program.channel_nodes,
            op_amps=self._op_amps,
            temperature_c=self._temperature_c,
            sample_rate_hz=computer.sample_rate_hz,
            supply=self._supply,
        )
        quiet = computer.play_planned(excitation, samples, planned, block_samples, ahead_ticks)
        return self._blocks(quiet, noise, turns)

    def _blocks(
        self, quiet: Iterator[Matrix], noise: CircuitNoise, turns: list[tuple[int, Mapping[str, float]]]
    ) -> Iterator[Matrix]:
        first, signs = 0, self._computer.program.channel_signs
        for block in quiet:
            now = [(int(sample) - first, dials) for sample, dials in turns if sample < first + len(block)]
            del turns[: len(now)]
            if block.shape[1] == len(signs):
                noise.add_to(block, signs, now, self._rng)
            else:
                noise_v = np.zeros((len(block), len(signs)))
                noise.add_to(noise_v, signs, now, self._rng)
                np.add(block, np.tile(noise_v, 2), out=block)
            first += len(block)
            yield block


def _rows_of(response: Mapping[str, Matrix], names: Sequence[str]) -> Matrix:
    """Rows by name: (names, n)."""
    return np.array([response[name] for name in names]).reshape(len(names), len(response[GROUND]))


def _propagate(a: Matrix, intensity: Matrix, period_s: float) -> tuple[Matrix, Matrix, Matrix]:
    """exp(A T), the covariance accumulated over T, and its Cholesky factor."""
    arrays = (np.ascontiguousarray(a), intensity, *(np.empty_like(intensity) for _ in range(3)))
    if not binding.load().engine_noise_gather(len(a), period_s, *(array.ctypes.data for array in arrays)):
        raise CircuitError("the noise of this circuit has no bound: the circuit is unstable")
    return arrays[2], arrays[3], arrays[4]


def _product(left: Matrix, right: Matrix) -> Matrix:
    """Left @ right without BLAS, whose sums differ from machine to machine."""
    return np.asarray((left[:, :, None] * right[None]).sum(axis=1))
