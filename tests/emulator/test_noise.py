"""Noise against equipartition, the textbook's noise bandwidth, and scipy's Lyapunov equation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from analogrig_emulator import (
    OP_AMP_GRADES,
    Capacitor,
    Circuit,
    CircuitError,
    CircuitNoise,
    Excitation,
    NoisySuspension,
    OpAmp,
    OpAmpGrade,
    OpAmpModel,
    Pot,
    PotTurn,
    Resistor,
    SuspensionComputer,
    VoltageSource,
)
from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.machine.noise import BOLTZMANN_J_PER_K
from tests.emulator.plays import LSB_V
from tests.emulator.programs import circuit_of

KT_J = BOLTZMANN_J_PER_K * (25.0 + 273.15)
TL07X = OP_AMP_GRADES["tl07x"]
NODES = ("in", "u5", "u2", "u1")


def test_a_capacitor_has_the_noise_of_equipartition_whatever_the_resistors() -> None:
    """kT/C in the long run, and kT/C (1 - exp(-2T/RC)) gathered in a period; the pot's legs are one source resistance
    of 2.5 k, in parallel 5 k / 2, by Nyquist."""
    source = VoltageSource("F", "in")
    circuit = Circuit([source, Pot("P", "in", "w", "0", 10e3, 0.5), Capacitor("C", "w", "0", 1e-9)])
    noise = CircuitNoise(circuit, ("w",), op_amps=OpAmpGrade(), sample_rate_hz=1e6)
    gathered = KT_J / 1e-9 * (1 - math.exp(-2 * 1e-6 / (2.5e3 * 1e-9)))
    assert noise.covariance[0, 0] == pytest.approx(gathered, rel=1e-12)
    assert noise.transition[0, 0] == pytest.approx(math.exp(-1e-6 / (2.5e3 * 1e-9)), rel=1e-12)


def test_an_amplifiers_noise_is_its_density_over_the_noise_bandwidth() -> None:
    """Gain of -1: en times the noise gain 2, over pi/2 times the closed-loop bandwidth GBW / 2."""
    elements: list[Element] = [
        VoltageSource("F", "in"),
        Resistor("R1", "in", "s", 1e-3),
        Resistor("R2", "s", "out", 1e-3),
        OpAmp("U1", "0", "s", "out", OpAmpModel(gbw_hz=3e6)),
    ]
    noise = CircuitNoise(Circuit(elements), ("out",), op_amps=OpAmpGrade(noise_v_per_rthz=18e-9))
    assert noise.covariance[0, 0] == pytest.approx((2 * 18e-9) ** 2 * math.pi / 2 * 1.5e6, rel=1e-6)


def test_current_noise_flows_through_the_feedback() -> None:
    """In into 1 M || 1 nF: in^2 R^2 over the noise bandwidth 1 / (4 R C), here within one period of many R C."""
    elements: list[Element] = [
        VoltageSource("F", "in"),
        Resistor("R1", "in", "s", 1e9),
        Resistor("R2", "s", "out", 1e6),
        Capacitor("C", "s", "out", 1e-12),
        OpAmp("U1", "0", "s", "out", OpAmpModel()),
    ]
    grade = OpAmpGrade(noise_a_per_rthz=10e-12)
    noise = CircuitNoise(Circuit(elements), ("out",), op_amps=grade)
    thermal = KT_J / 1e-12 * (1 + 1e-3)
    assert noise.covariance[0, 0] == pytest.approx((10e-12 * 1e6) ** 2 / (4 * 1e6 * 1e-12) + thermal, rel=1e-5)


@pytest.mark.parametrize("program", ["shock", "front"])
def test_the_suspensions_covariance_solves_the_lyapunov_equation(program: str) -> None:
    """Stationary X of the sampled noise, X = Phi X Phi' + Q, is that of the continuous one: it cannot depend on T."""
    circuit = SuspensionComputer(program).circuit
    stationary = []
    for rate_hz in (20e3, 1e6):
        noise = CircuitNoise(circuit, NODES, op_amps=TL07X, sample_rate_hz=rate_hz)
        stationary.append(scipy.linalg.solve_discrete_lyapunov(noise.transition, noise.covariance))
    scale = np.sqrt(np.outer(np.diag(stationary[0]), np.diag(stationary[0])))
    np.testing.assert_allclose(stationary[1] / scale, stationary[0] / scale, rtol=0, atol=1e-9)


def test_the_displacements_noise_is_that_of_its_covariance() -> None:
    """20,000 samples correlated over about 5: the standard error of their rms is about 1.1 %; the bound is 4 of it."""
    noise = CircuitNoise(SuspensionComputer("front").circuit, NODES, op_amps=TL07X)
    state = scipy.linalg.solve_discrete_lyapunov(noise.transition, noise.covariance)
    inverter = 6  # the states are C1 C2 U1 U2 U3 U4 U5
    volts = noise.volts(20_000, np.random.default_rng(1))
    rms_v = math.sqrt(float(state[inverter, inverter]))
    assert volts[1000:, 1].std() == pytest.approx(rms_v, rel=0.045)
    assert volts[1000:, 1].std() / LSB_V == pytest.approx(0.027, rel=0.1)  # an early study of the same circuit


def test_noise_adds_to_what_is_played_and_follows_its_pots() -> None:
    changes = [PotTurn(30, {"K": 18000.0}), PotTurn(90, {"M": 30.0})]

    def played(block_samples: int, seed: int = 1) -> np.ndarray:
        machine = NoisySuspension(SuspensionComputer("front"), np.random.default_rng(seed), op_amps=TL07X)
        return np.concatenate(list(machine.play(Excitation(), 150, changes, block_samples)))

    quiet = np.concatenate(list(SuspensionComputer("front").play(Excitation(), 150, changes)))
    noise = played(150) - quiet
    assert np.array_equal(noise[:, 0], np.zeros(150))
    assert 0 < np.abs(noise[:, 1]).max() < 0.2 * LSB_V
    assert np.array_equal(played(7), played(150))
    assert not np.array_equal(played(150, seed=2), played(150))
    assert np.array_equal(played(150)[0], quiet[0])


def test_without_sources_there_is_no_noise() -> None:
    circuit = SuspensionComputer("front").circuit
    cold = CircuitNoise(circuit, NODES, op_amps=OpAmpGrade(), temperature_c=-273.15)
    assert not cold.volts(10, np.random.default_rng(1)).any()
    warm = CircuitNoise(circuit, NODES, op_amps=replace(TL07X, noise_v_per_rthz=0.0))
    assert warm.volts(10, np.random.default_rng(1))[1:, 1].all()


@pytest.mark.parametrize("name", ["two-tanks", "van-der-pol"])
def test_noise_without_bound_is_refused(name: str) -> None:
    machine = NoisySuspension(SuspensionComputer(circuit_of(name)), np.random.default_rng(1), op_amps=TL07X)
    with pytest.raises(CircuitError, match="play it without noise and hum"):
        list(machine.play(Excitation(), 10))


def test_a_node_that_is_not_there_is_refused() -> None:
    with pytest.raises(CircuitError, match="no node is called 'u9'"):
        CircuitNoise(SuspensionComputer("front").circuit, ("u9",), op_amps=TL07X)
