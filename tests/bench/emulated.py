"""Runs that the emulated computer and its card play, with disturbances between the two."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.rigs.emulator import Stream
from analogrig.run import missing_samples
from analogrig_emulator import (
    NOMINAL,
    Card,
    Components,
    Excitation,
    PotTurn,
    ProgramCircuit,
    Sampler,
    SuspensionComputer,
    acquired,
    probes_per_sample,
)

from .played import CARD, DISPLACEMENT, FORCE, Array, Change, Played, accumulate

DISTURBANCE_STREAM = 10
"""First random stream of a seed beside those of the emulated rig."""

OFFSET_V = 0.003
"""Amplifiers' offsets of the shipped rig: drawn within plus and minus this."""

Draw = Callable[[np.random.Generator, int], Excitation]
"""Function from a random generator and the number of samples to an excitation."""

Disturbance = Callable[[Array, np.random.Generator], Array]
"""Function from the card's inputs (n, channels) in LSB to the disturbed ones."""

Validity = Callable[[int, np.random.Generator], NDArray[np.bool_]]
"""Function from the number of samples to a mask of those that arrive."""

Wander = Callable[[int], Sequence[PotTurn]]
"""Function from a number of samples to the turns of the pots of a healthy machine in these."""


@dataclass(frozen=True)
class Emulated:
    """Condition that the emulated computer and its card play."""

    draw: Draw
    card: Card = CARD
    program: ProgramCircuit | str = "front"
    components: Callable[[int], Components] = lambda seed: NOMINAL  # noqa: ARG005
    """Components of the machine of a seed."""
    disturb: Disturbance | None = None
    arrives: Validity | None = None
    wander: Wander | None = None
    """It ends at the change."""
    correlation: float = 0.0
    """Correlation of successive noise samples, if that of the displacement is autoregressive instead of the card's."""

    def play(self, seeds: Sequence[int], samples: int, changes: Sequence[Change | None]) -> Iterator[Played]:
        for seed, change in zip(seeds, changes, strict=True):
            yield self._run(seed, samples, change)

    def _run(self, seed: int, samples: int, change: Change | None) -> Played:
        turns = [] if self.wander is None else [*self.wander(samples if change is None else change.sample)]
        lsb = self._inputs_lsb(seed, samples, turns, change)
        codes, clipped = self._sampled(lsb, seed)
        valid = ~missing_samples(clipped)
        if self.arrives is not None:
            valid &= self.arrives(samples, self._rng(seed, 1))
        information = np.zeros(samples)
        if change is not None:
            seen = lsb[:, DISPLACEMENT] - self._inputs_lsb(seed, samples, turns, None)[:, DISPLACEMENT]
            first = change.sample + 1
            variance = self.card.noise_lsb[DISPLACEMENT] ** 2
            information[first:] = accumulate(seen[first:] * valid[first:], variance, self.correlation)
        return Played(codes[:, FORCE].astype(np.float64), codes[:, DISPLACEMENT].astype(np.float64), valid, information)

    def _inputs_lsb(self, seed: int, samples: int, turns: Sequence[PotTurn], change: Change | None) -> Array:
        """Inputs of the card without its noise, (samples, channels) LSB."""
        card = self.card
        machine = SuspensionComputer(
            self.program,
            rng=Stream.COMPONENTS.generator(seed),
            offset_v=OFFSET_V,
            components=self.components(seed),
            sample_rate_hz=card.true_rate_hz * probes_per_sample(card),
        )
        if change is not None:
            values = machine.program.values.items()  # of the sprung mass first: M2 for M
            setting, value = next((name, value) for name, value in values if name.startswith(change.parameter))
            turns = [*turns, PotTurn(change.sample, {setting: value * change.factor})]
        excitation = self.draw(Stream.EXCITATION.generator(seed), samples)
        jitter = Stream.APERTURE.generator(seed)
        (volts,) = acquired(machine, card, excitation, samples, turns, rng=jitter, block_samples=samples)
        lsb = (volts - card.low_v) / card.lsb_v
        return lsb if self.disturb is None else self.disturb(lsb, self._rng(seed, 0))

    def _sampled(self, lsb: Array, seed: int) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
        """Codes and clipping flags. The card's noise on the displacement may be autoregressive."""
        card, rng = self.card, Stream.CARD.generator(seed)
        volts = card.low_v + lsb * card.lsb_v
        if not self.correlation:
            return Sampler(card, rng).sample(volts)
        normals = rng.standard_normal(lsb.shape)
        normals[:, DISPLACEMENT] = autoregressive(normals[:, DISPLACEMENT], self.correlation)
        return Sampler(card, rng).sample(volts, normals)

    @staticmethod
    def _rng(seed: int, part: int) -> np.random.Generator:
        return np.random.default_rng([seed, DISTURBANCE_STREAM + part])


def autoregressive(white: Array, correlation: float) -> Array:
    """First-order autoregressive noise of variance 1 from white noise of variance 1, (n,)."""
    from scipy.signal import lfilter

    driven = white * math.sqrt(1.0 - correlation**2)
    driven[0] = white[0]
    return np.asarray(lfilter([1.0], [1.0, -correlation], driven))
