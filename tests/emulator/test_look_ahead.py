"""Voltages a little after each sample: of the engine, of the machine, and of the card that needs them."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig_emulator import (
    CARDS,
    OP_AMP_GRADES,
    TICKS_PER_SAMPLE,
    Card,
    Edges,
    Engine,
    Excitation,
    NoisySuspension,
    PotTurn,
    SuspensionComputer,
    acquired,
    ahead_ticks,
    piecewise_linear,
)

RATE_HZ, NODES = 20e3, ("in", "u5", "u2", "u1")
FINER = 64
AHEAD_TICKS = TICKS_PER_SAMPLE // FINER
SQUARE, FREE = Excitation(), Excitation(clock="free", phase=0.137, drift_ppm=20.0)
PRBS = Excitation(shape="prbs", frequency_hz=10e3)
CHANGES = (PotTurn(60, {"K": 18000.0}), PotTurn(99, {"M": 30.0}, 20))
LSB_V = 10.0 / 4096


def engine(rate_hz: float = RATE_HZ, ahead: int = 0) -> Engine:
    return Engine(piecewise_linear(SuspensionComputer("front").circuit), NODES, rate_hz, ahead_ticks=ahead)


@pytest.mark.parametrize("excitation", [SQUARE, FREE, PRBS])
def test_looking_ahead_is_running_on_and_changes_no_sample(excitation: Excitation) -> None:
    """With a finer grid the samples of the engine itself lie at the later instants."""
    samples = 300
    edges = excitation.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)
    looking, counts = engine(ahead=AHEAD_TICKS), (1, 70, samples - 71)
    volts = np.concatenate([looking.run(n, {"F": edges.within(*looking.window(n))}) for n in counts])
    start, stop = 0, (samples - 1) * TICKS_PER_SAMPLE + 1
    assert np.array_equal(volts, engine(ahead=AHEAD_TICKS).run(samples, {"F": edges.within(start, stop)}))
    assert np.array_equal(volts[:, :4], engine().run(samples, {"F": edges.within(start, stop)}))
    finer = Edges(edges.ticks * FINER, edges.levels_v).within(start, stop * FINER)
    later = engine(RATE_HZ * FINER).run((samples - 1) * FINER + 2, {"F": finer})[1::FINER]
    after_sample = edges.ticks % TICKS_PER_SAMPLE
    assert not ((after_sample > 0) & (after_sample <= AHEAD_TICKS)).any()
    np.testing.assert_allclose(volts[:, 4:], later, rtol=0, atol=1e-7)


def test_a_play_that_looks_ahead_has_the_same_samples_through_changes_and_ramps() -> None:
    plain = np.concatenate(list(SuspensionComputer("front").play(FREE, 200, CHANGES)))
    for block in (33, 200):
        blocks = SuspensionComputer("front").play(FREE, 200, CHANGES, block, AHEAD_TICKS)
        volts = np.concatenate(list(blocks))
        assert np.array_equal(volts[:, :4], plain)
        assert 0.0 < np.abs(volts[:, 4:] - plain).max() < 10.0


def test_a_delayed_sample_is_that_of_a_machine_sampled_faster() -> None:
    """50 ns is a thousandth of the sample period, and the op-amps slew meanwhile."""
    samples, faster = 60, 1000
    card = Card(aperture_delay_s=50e-9)
    blocks = acquired(SuspensionComputer("front"), card, SQUARE, samples, rng=np.random.default_rng(1))
    edges = SQUARE.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)
    computer = SuspensionComputer("front")
    fast = Engine(piecewise_linear(computer.circuit), computer.program.channel_nodes, RATE_HZ * faster)
    every = fast.run((samples - 1) * faster + 2, {"F": Edges(edges.ticks * faster, edges.levels_v)})
    expected = every[1::faster] * computer.program.channel_signs
    np.testing.assert_allclose(np.concatenate(list(blocks)), expected, rtol=0, atol=0.001 * LSB_V)


def test_an_early_sample_lies_on_the_line_from_the_one_before() -> None:
    """Half of the samples without a delay are early. The force has its edges at sample instants."""
    card = Card(aperture_jitter_s=5e-9)
    blocks = acquired(SuspensionComputer("front"), card, SQUARE, 400, rng=np.random.default_rng(1), block_samples=64)
    force = np.concatenate(list(blocks))[:, 0]
    level = np.concatenate(list(SuspensionComputer("front").play(SQUARE, 400)))[:, 0]
    off = np.flatnonzero(np.abs(force - level) > 1e-9)
    assert set(off) <= {k for k in range(1, 400) if level[k] != level[k - 1]}
    assert 0 < len(off) < 16
    assert np.abs(force - level).max() < 10.0 * 25e-9 * RATE_HZ


def test_noise_of_the_circuit_is_the_same_in_both_voltages_of_a_row() -> None:
    def rows(*, noisy: bool) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        computer = SuspensionComputer("front")
        rng = np.random.default_rng(1)
        machine = NoisySuspension(computer, rng, op_amps=OP_AMP_GRADES["tl07x"]) if noisy else computer
        return np.concatenate(list(machine.play(SQUARE, 100, (), 32, AHEAD_TICKS)))

    noise_v = rows(noisy=True) - rows(noisy=False)
    assert np.abs(noise_v[:, :4]).max() > 0.0
    np.testing.assert_allclose(noise_v[:, :4], noise_v[:, 4:], rtol=0, atol=1e-14)


def test_only_a_card_with_aperture_errors_looks_ahead() -> None:
    assert ahead_ticks(Card()) == ahead_ticks(CARDS["skewed"]) == 0
    assert ahead_ticks(CARDS["dt2821"]) / TICKS_PER_SAMPLE / RATE_HZ == pytest.approx(50e-9, rel=1e-3)
    assert ahead_ticks(Card(aperture_jitter_s=1e-6, skew_s=(0.0, 1e-6, 0.0, 0.0))) == TICKS_PER_SAMPLE
