"""Sampling instants of the card: skew, aperture delay, jitter and clock drift.

The machine runs at a multiple of the card's rate. Each channel takes one of these *probes*, so skew costs no accuracy.
Aperture delay and jitter, tens of nanoseconds, lie between two probes at most PROBE_S apart. There the voltage is
interpolated linearly: an error below 0.003 LSB on the displacement of the suspension.
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
from analogrig_emulator.engine import library
from analogrig_emulator.engine.system import Edges
from analogrig_emulator.errors import SamplerError

PROBE_S = 1e-6
"""Longest time between probes, in s, with an aperture delay or jitter."""

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
    ) -> Iterator[NDArray[np.float64]]: ...


def probes_per_sample(card: Card) -> int:
    """Number of probes per sample: the machine runs at so many times the card's rate.

    Raises SamplerError for a skew that is no multiple of a thousandth of the sample period.
    """
    parts = card.per_channel("skew_s") * card.rate_hz
    count = next((n for n in range(1, _MAX_PROBES + 1) if np.abs(parts * n - np.rint(parts * n)).max() < 1e-6), None)
    if count is None:
        raise SamplerError(f"card: skew_s {card.skew_s!r}: no grid of {_MAX_PROBES} instants a sample holds them")
    if card.aperture_delay_s or card.aperture_jitter_s:
        count *= math.ceil(1.0 / (card.rate_hz * count * PROBE_S))
    return count


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
    count = probes_per_sample(card)
    _check_rate(machine, card, count)
    if count == 1 and card.clock_drift_ppm == 0:
        return machine.play(excitation, samples, changes, block_samples)
    clock_hz = card.rate_hz if excitation.clock == "card" else card.true_rate_hz
    slow = _OnCardClock(**dataclasses.asdict(excitation), probes=count, clock_hz=clock_hz)
    slow_changes = [PotTurn(k * count, values, ramp_n * count) for k, values, ramp_n in changes]
    probed = machine.play(slow, samples * count, slow_changes, block_samples * count)
    return _take_samples(probed, card, count, rng)


def _check_rate(machine: Playable, card: Card, count: int) -> None:
    wanted_hz = card.true_rate_hz * count
    if not math.isclose(machine.sample_rate_hz, wanted_hz, rel_tol=1e-9):
        raise SamplerError(
            f"card: the machine has sample_rate_hz {machine.sample_rate_hz:g}, and this card needs {wanted_hz:g}: "
            f"{count} times its own rate"
        )


def _offsets(card: Card, count: int) -> NDArray[np.float64]:
    """Delay of each channel after the nominal instant, without jitter, in probes: (channels,)."""
    per_s = card.rate_hz * count
    return np.asarray(np.rint(card.per_channel("skew_s") * per_s) + card.aperture_delay_s * per_s)


def _take_samples(
    probed: Iterator[NDArray[np.float64]], card: Card, count: int, rng: np.random.Generator
) -> Iterator[NDArray[np.float64]]:
    """Yield the sample voltages of each block; keep its last probe for early jitter in the next."""
    before: NDArray[np.float64] | None = None
    offsets = _offsets(card, count)
    jitter_probes = card.aperture_jitter_s * card.rate_hz * count
    for block in probed:
        probes = np.ascontiguousarray(block, np.float64)
        before = probes[0] if before is None else before
        late = rng.standard_normal((len(probes) // count, card.channels))
        late *= jitter_probes
        late += offsets
        np.clip(late, -1.0, count - 1.0, out=late)
        volts = np.empty_like(late)
        addresses = [array.ctypes.data for array in (before, probes, late, volts)]
        library.load().engine_interpolate(*late.shape, count, *addresses)
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

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Edges:
        del sample_rate_hz  # the machine's rate; the generator follows clock_hz
        slow = super().edges(-(-start_tick // self.probes), -(-stop_tick // self.probes), self.clock_hz)
        return Edges(slow.ticks * self.probes, slow.levels_v)
