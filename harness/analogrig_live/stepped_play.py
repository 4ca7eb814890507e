"""Play of the emulated rig in steps: between two blocks a hand operates the computer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Program
from analogrig.rigs import (
    EmulatorRig,
    Hindsight,
    Performance,
    SetUp,
    Stream,
    channels_of,
    emulator_errors,
    lit_lamps,
    sampled,
)
from analogrig_emulator import (
    Excitation,
    NormalStream,
    PotTurn,
    Sampler,
    SuspensionComputer,
    acquired,
    probes_per_sample,
)


@dataclass(frozen=True)
class _SteppedMachine:
    """Computer that is played in steps, for ``acquired``."""

    computer: SuspensionComputer
    lengths: Iterable[int]
    """Samples of the card in each block."""
    probes_per_sample: int
    nodes: Sequence[str]

    @property
    def sample_rate_hz(self) -> float:
        return self.computer.sample_rate_hz

    def play(
        self,
        excitation: Excitation,
        samples: int,  # noqa: ARG002 - the lengths decide
        changes: Sequence[PotTurn] = (),  # noqa: ARG002 - the caller makes them
        block_samples: int = 0,  # noqa: ARG002
        ahead_ticks: int = 0,
    ) -> Iterator[NDArray[np.float64]]:
        lengths = (length * self.probes_per_sample for length in self.lengths)
        return self.computer.play_in_steps(excitation, lengths, self.nodes, ahead_ticks)


def perform_in_steps(
    rig: EmulatorRig,
    set_up: SetUp,
    program: Program,
    seed: int,
    lengths: Iterable[int],
    probes: Sequence[str],
    alter: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> Performance:
    """Play a set-up without its changes, in blocks of these lengths, each drawn when its block is requested.

    Between two blocks the caller operates ``set_up.computer``, whose ``probed`` has the volts of the nodes ``probes``.
    ``alter`` changes the volts on their way to the card. The hindsight knows the lamps alone.

    :raises ConfigurationError: the rig cannot be played in steps.
    """
    if rig.described.computer.noise:
        raise ConfigurationError(f"{rig.described.name}: computer.noise: a play in steps has no such noise")
    computer, card = set_up.computer, rig.card(program)
    with emulator_errors():
        machine = _SteppedMachine(computer, lengths, probes_per_sample(card), probes)
        volts = acquired(machine, card, set_up.excitation, 0, rng=Stream.APERTURE.generator(seed))
    return Performance(
        sample_period_s=1.0 / card.rate_hz,
        time_scale=computer.scales.time,
        channels=channels_of(card, computer, program),
        blocks=sampled(map(alter, volts), Sampler(card, NormalStream(seed, Stream.CARD))),
        hindsight=lambda: Hindsight((), lit_lamps(computer.machine.lamps, probes_per_sample(card))),
    )
