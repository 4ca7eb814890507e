"""Stopping between two samples, and the watch over amplifiers at their limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    Edges,
    Engine,
    EngineError,
    OpAmp,
    OpAmpModel,
    PiecewiseLinear,
    Resistor,
    VoltageSource,
    piecewise_linear,
)

SOURCE = VoltageSource("V1", "in")
RATE = 2 * math.pi * 1e6
SLEW = 0.5e6
"""So a follower of 1 MHz slews for 19.68 us after a step of 10 V."""


def low_pass(ohm: float) -> PiecewiseLinear:
    return piecewise_linear(Circuit([SOURCE, Resistor("R1", "in", "out", ohm), Capacitor("C1", "out", "0", 1e-9)]))


def follower() -> Engine:
    model = OpAmpModel(gbw_hz=1e6, slew_v_per_s=SLEW)
    return Engine(piecewise_linear(Circuit([SOURCE, OpAmp("U1", "in", "out", "out", model)])), ["out"])


def edges(*changes: tuple[float, float]) -> dict[str, Edges]:
    instants, levels_v = np.array(changes).T
    return {"V1": Edges(np.rint(instants * TICKS_PER_SAMPLE).astype(np.int64), levels_v)}


def test_a_circuit_changed_between_two_samples_follows_both_exponentials() -> None:
    engine = Engine(low_pass(100e3), ["out"])
    engine.run(1, edges((0.0, 10.0)))
    engine.advance(TICKS_PER_SAMPLE // 4)
    engine.set_system(low_pass(20e3))
    volts = engine.run(2)[:, 0]
    expected = 10.0 * (1 - math.exp(-12.5e-6 / 100e-6) * np.exp(-np.array([37.5e-6, 87.5e-6]) / 20e-6))
    np.testing.assert_allclose(volts, expected, rtol=1e-12)


def test_edges_on_the_way_are_taken_and_the_window_begins_after_them() -> None:
    engine = Engine(low_pass(1.0), ["in"])
    engine.run(1, edges((0.0, 1.0)))
    engine.advance(TICKS_PER_SAMPLE // 2, edges((0.25, 2.0)))
    assert engine.window(2) == (TICKS_PER_SAMPLE // 2 + 1, 2 * TICKS_PER_SAMPLE + 1)
    assert engine.run(2, edges((1.5, 3.0)))[:, 0].tolist() == [2.0, 3.0]


@pytest.mark.parametrize("tick", [-1, 2 * TICKS_PER_SAMPLE - 1, 3 * TICKS_PER_SAMPLE])
def test_an_instant_past_or_not_before_the_next_sample_is_refused(tick: int) -> None:
    engine = Engine(low_pass(1e3), ["in"])
    engine.run(3)
    with pytest.raises(EngineError, match="after 3 samples"):
        engine.advance(tick)


def test_the_watch_tells_when_patience_ended() -> None:
    engine = follower()
    engine.watch(TICKS_PER_SAMPLE // 4)
    engine.run(3, edges((1.5, 10.0)))
    assert engine.overdue_ticks.tolist() == [pytest.approx(1.75 * TICKS_PER_SAMPLE, abs=1)]


def test_patience_counts_unbroken_stretches_only() -> None:
    engine = follower()
    engine.watch(TICKS_PER_SAMPLE // 2)
    engine.run(6, edges((0.0, 10.0), (1.0, 0.0), (2.0, 10.0)))
    assert engine.overdue_ticks.tolist() == [-1]


def test_a_kink_that_is_outside_still_is_told_of_too() -> None:
    engine = follower()
    engine.watch(TICKS_PER_SAMPLE // 4)
    engine.run(1, edges((0.0, 10.0)))
    engine.advance(TICKS_PER_SAMPLE * 3 // 10)
    assert engine.overdue_ticks.tolist() == [TICKS_PER_SAMPLE // 4]
    engine.watch(TICKS_PER_SAMPLE // 20)
    assert engine.overdue_ticks.tolist() == [-1]
    engine.run(1)
    assert engine.overdue_ticks.tolist() == [TICKS_PER_SAMPLE * 3 // 10 + TICKS_PER_SAMPLE // 20]
