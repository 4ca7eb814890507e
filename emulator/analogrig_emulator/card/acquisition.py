"""Sampling instants of the card: skew, aperture delay, jitter and clock drift.

The machine runs at a multiple of the card's rate. Each channel takes one of these *probes*, so skew costs no accuracy.
For aperture delay and jitter, tens of nanoseconds, the machine also gives the voltages a little later than each probe.
In between they lie on a straight line. With delay and jitter below 0.2 us the error is below 0.003 LSB on the
displacement of the suspension. Before a probe, the line goes back to the probe before.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.card.sampler import Card
from analogrig_emulator.circuit.pot import PotTurn
from analogrig_emulator.engine import binding
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Edges
from analogrig_emulator.exceptions import SamplerError

JITTERS = 4.0
"""Standard deviations of a jitter without delay that the later voltages cover; beyond, the straight line goes on."""

_MAX_PROBES = 1000


class Playable(Protocol):
    """Machine with a fixed sample rate that plays excitations, such as SuspensionComputer."""

    @property
    def sample_rate_hz(self) -> float: ...

    def play(
        self,
        excitation: Excitation,
        samples: int,
        changes: Sequence[PotTurn] = ...,
        block_samples: int = ...,
        ahead_ticks: int = ...,
    ) -> Iterator[NDArray[np.float64]]: ...


def probes_per_sample(card: Card) -> int:
    """Number of probes per sample: the machine runs at so many times the card's rate.

    Raises SamplerError for a skew that is no multiple of a thousandth of the sample period.
    """
    parts = card.per_channel("skew_s") * card.rate_hz
    count = next((n for n in range(1, _MAX_PROBES + 1) if np.abs(parts * n - np.rint(parts * n)).max() < 1e-6), None)
    if count is None:
        raise SamplerError(f"card: skew_s {card.skew_s!r}: no grid of {_MAX_PROBES} instants a sample holds them")
    return count


def ahead_ticks(card: Card) -> int:
    """Ticks from a probe to the later voltages, at most one probe; 0 without aperture delay and jitter."""
    latest_s = max(card.aperture_delay_s, JITTERS * card.aperture_jitter_s)
    ticks = math.ceil(latest_s * card.rate_hz * probes_per_sample(card) * TICKS_PER_SAMPLE)
    return min(ticks, TICKS_PER_SAMPLE)


def acquired(
    machine: Playable,
    card: Card,
    excitation: Excitation,
    samples: int,
    changes: Sequence[PotTurn] = (),
    *,
    rng: np.random.Generator,
    block_samples: int = 256,
) -> Iterator[NDArray[np.float64]]:
    """Play a machine made with sample_rate_hz = card.true_rate_hz probes_per_sample(card).

    Yields the voltages at the sample-and-holds in blocks: float64 (block_samples or, last, fewer; channels), V.
    rng: generator of the jitter. Excitation and changes refer to the nominal instants, so a channel with skew can show
    a change after sample k in sample k already. Raises SamplerError for a machine of another rate, and what play
    raises.
    """
    count, ahead = probes_per_sample(card), ahead_ticks(card)
    _check_rate(machine, card, count)
    if count == 1 and card.clock_drift_ppm == 0 and not ahead:
        return machine.play(excitation, samples, changes, block_samples)
    slow = on_card_clock(card, excitation)
    slow_changes = [PotTurn(k * count, values, ramp_n * count) for k, values, ramp_n in changes]
    if not ahead:
        probed = machine.play(slow, samples * count, slow_changes, block_samples * count)
        rows, channels = _rows(card, count), np.arange(card.channels)
        return (block.reshape(-1, count, card.channels)[:, rows, channels] for block in probed)
    probed = machine.play(slow, samples * count, slow_changes, block_samples * count, ahead)
    return _take_samples(probed, card, count, ahead / TICKS_PER_SAMPLE, rng)


def on_card_clock(card: Card, excitation: Excitation) -> Excitation:
    """Excitation as a machine with sample_rate_hz = card.true_rate_hz probes_per_sample(card) is to play it."""
    clock_hz = card.rate_hz if excitation.clock == "card" else card.true_rate_hz
    return _OnCardClock(**dataclasses.asdict(excitation), probes=probes_per_sample(card), clock_hz=clock_hz)


def probe_of_channel(card: Card, channel: int) -> int:
    """Probe within a sample at which a channel is taken."""
    return int(_rows(card, probes_per_sample(card))[channel])


def _check_rate(machine: Playable, card: Card, count: int) -> None:
    wanted_hz = card.true_rate_hz * count
    if not math.isclose(machine.sample_rate_hz, wanted_hz, rel_tol=1e-9):
        raise SamplerError(
            f"card: the machine has sample_rate_hz {machine.sample_rate_hz:g}, and this card needs {wanted_hz:g}: "
            f"{count} times its own rate"
        )


def _rows(card: Card, count: int) -> NDArray[np.int64]:
    """Probe of each channel within a sample: (channels,)."""
    return np.rint(card.per_channel("skew_s") * card.rate_hz * count).astype(np.int64)


def _take_samples(
    probed: Iterator[NDArray[np.float64]], card: Card, count: int, ahead: float, rng: np.random.Generator
) -> Iterator[NDArray[np.float64]]:
    """Yield the sample voltages of each block of probes with later voltages; keep its last probe for the next."""
    before: NDArray[np.float64] | None = None
    rows, per_s = _rows(card, count), card.rate_hz * count
    for block in probed:
        probes = np.ascontiguousarray(block, np.float64)
        before = probes[0] if before is None else before
        late = rng.standard_normal((len(probes) // count, card.channels))
        late *= card.aperture_jitter_s * per_s
        late += card.aperture_delay_s * per_s
        volts = np.empty_like(late)
        addresses = [array.ctypes.data for array in (before, probes, late, volts)]
        binding.load().engine_take(*late.shape, count, rows.ctypes.data, ahead, *addresses)
        before = probes[-1].copy()
        yield volts


@dataclass(frozen=True)
class _OnCardClock(Excitation):
    """Excitation with the edges of a machine at the card's rate, `probes` times slower.

    clock_hz: card's rate by the clock of the generator.
    """

    probes: int = 1
    clock_hz: float = 20e3

    def period_ticks(self, sample_rate_hz: float) -> float:
        del sample_rate_hz
        return super().period_ticks(self.clock_hz)

    def check_rate(self, sample_rate_hz: float) -> None:
        del sample_rate_hz
        super().check_rate(self.clock_hz)

    def smooth_v(self, at: NDArray[np.float64], sample_rate_hz: float) -> NDArray[np.float64]:
        del sample_rate_hz
        return super().smooth_v(at / self.probes, self.clock_hz)

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Edges:
        del sample_rate_hz  # the machine's rate; the generator follows clock_hz
        slow = super().edges(-(-start_tick // self.probes), -(-stop_tick // self.probes), self.clock_hz)
        return Edges(slow.ticks * self.probes, slow.levels_v)
