"""Emulated rig that computes plays of one scenario together: those whose seeds draw offsets and phase alone."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import RigError
from analogrig.plant import Segment
from analogrig.rigs.emulator import (
    EmulatorRig,
    Stream,
    channels_of,
    drawn_machine,
    emulator_errors,
    lit_lamps,
    nominal_machine,
)
from analogrig.rigs.rig import Block, Hindsight, Performance
from analogrig.run import OUTPUT, Channel
from analogrig.scenario import Scenario
from analogrig_emulator import (
    Card,
    RepeatedCourses,
    RepeatedPlay,
    SuspensionComputer,
    Wired,
    ahead_ticks,
    drawn_offsets_v,
    is_repeatable,
    normals,
    probes_per_sample,
    sample_plays,
    uniforms,
)

DIRECT_BLOCK_SAMPLES = 131_072
"""Longest play that is computed together. The circuit of a longer one is prepared anew for each seed."""


class _Prepared(NamedTuple):
    """Data that all plays of one scenario share, for every seed."""

    key: tuple[object, ...]
    """Parts of the scenario on which the data depend."""
    computer: SuspensionComputer
    card: Card
    play: RepeatedPlay | None
    """Repeated play; None where more than offsets and phase depends on the seed."""
    channels: Mapping[str, Channel]
    segments: tuple[Segment, ...]


class RepeatedRig(EmulatorRig):
    """Emulated rig whose plays are those of ``EmulatorRig`` to the bit, in blocks of DIRECT_BLOCK_SAMPLES.

    Data for a scenario that fits in one block are prepared once for all seeds.
    """

    def __init__(self, rig: EmulatorRig) -> None:
        """Rig of the description of ``rig``."""
        super().__init__(rig.described, DIRECT_BLOCK_SAMPLES)
        self._last_prepared: _Prepared | None = None

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        return (self._repeat(scenario, [seed]) or [super().perform(scenario, seed)])[0]

    def perform_all(self, scenario: Scenario, seeds: Sequence[int]) -> list[Performance]:
        """Performance of each seed, as of ``perform``; their blocks are computed together where they can be."""
        return self._repeat(scenario, seeds) or [self.perform(scenario, seed) for seed in seeds]

    def courses_together(self, scenario: Scenario, seeds: Sequence[int], samples: int) -> RepeatedCourses | None:
        """Courses without ramps of the machines of several plays; None where these differ in more than offsets.

        :raises EmulatorError: as ``courses``.
        """
        program, card = scenario.program, self.card(scenario.program)
        if not self._draws_offsets_and_phase_alone(scenario):
            return None
        machine = drawn_machine(self.described.computer, program.circuit, seeds[0], card.true_rate_hz)
        if not is_repeatable(machine, ()):
            return None
        wired = Wired(machine, nominal_machine(program) if self.described.computer.pots == "dial" else machine)
        phases, offsets_v = self._draw(scenario, seeds, machine)
        return RepeatedCourses(wired, scenario.excitation, phases, offsets_v, samples, OUTPUT)

    def _draw(
        self, scenario: Scenario, seeds: Sequence[int], computer: SuspensionComputer
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Phases (seeds,) and offsets of the amplifiers (seeds, amplifiers) in volts."""
        numbers = uniforms(seeds, Stream.COMPONENTS, computer.program.amplifiers)
        offsets_v = drawn_offsets_v(self.amplifier, numbers, self.described.computer.offset_v)
        if scenario.random_phase:
            return uniforms(seeds, Stream.EXCITATION, 1)[:, 0], offsets_v
        return np.full(len(seeds), scenario.excitation.phase), offsets_v

    def _prepare(self, scenario: Scenario, seed: int) -> _Prepared:
        """Prepared data of the scenario; the last set is reused for the same key."""
        key = (scenario.samples, scenario.plant, scenario.changes, scenario.excitation)
        if self._last_prepared is None or self._last_prepared.key != key:
            computer, excitation, changes = self.set_up(scenario, seed)
            card = self.card(scenario.program)
            with emulator_errors(f"scenario {scenario.name}: "):
                excitation.check_rate(computer.sample_rate_hz)
                able = self._draws_offsets_and_phase_alone(scenario) and is_repeatable(computer, changes)
                play = RepeatedPlay(computer, scenario.samples, changes) if able else None
            channels = channels_of(card, computer, scenario.program)
            self._last_prepared = _Prepared(key, computer, card, play, channels, scenario.segments())
        return self._last_prepared

    def _draws_offsets_and_phase_alone(self, scenario: Scenario) -> bool:
        """True if plays of the scenario differ in the amplifiers' offsets and the phase of their edges alone."""
        card, drawn = self.card(scenario.program), self.described.computer
        is_nominal = drawn.components == "nominal" and not drawn.wiper_noise_ohm
        is_nominal &= not drawn.noise and not drawn.supply_hum_v
        is_nominal &= drawn.specimen is None and drawn.values is None
        is_on_time = probes_per_sample(card) == 1 and not ahead_ticks(card) and card.clock_drift_ppm == 0
        return is_nominal and is_on_time and not scenario.excitation.is_smooth

    def _repeat(self, scenario: Scenario, seeds: Sequence[int]) -> list[Performance]:
        """Performances whose blocks are computed together with the first one; none if there is no repeated play."""
        if scenario.samples > self._block_samples:
            return []
        prepared = self._prepare(scenario, seeds[0])
        if (play := prepared.play) is None:
            return []
        taken: list[tuple[Block, Mapping[str, int]]] = []

        def blocks(i: int) -> Iterator[Block]:
            if not taken:
                taken.extend(self._repeated_blocks(prepared, play, scenario, seeds))
            yield taken[i][0]

        def hindsight(i: int) -> Hindsight:
            return Hindsight(prepared.segments, taken[i][1] if taken else {})

        return [
            Performance(
                sample_period_s=1.0 / prepared.card.rate_hz,
                time_scale=prepared.computer.scales.time,
                channels=prepared.channels,
                blocks=blocks(i),
                hindsight=functools.partial(hindsight, i),
            )
            for i in range(len(seeds))
        ]

    def _repeated_blocks(
        self, prepared: _Prepared, play: RepeatedPlay, scenario: Scenario, seeds: Sequence[int]
    ) -> Iterator[tuple[Block, Mapping[str, int]]]:
        """Samples and lit lamps of each seed."""
        phases, offsets_v = self._draw(scenario, seeds, prepared.computer)
        with emulator_errors(as_error=RigError):
            volts, lamps = play.play_all(scenario.excitation, phases, offsets_v)
            codes, clipped = sample_plays(prepared.card, volts, normals(seeds, Stream.CARD, volts.shape[1:]))
        for each, *samples in zip(lamps, volts, codes, clipped, strict=True):
            yield Block(0, *samples), lit_lamps(each, 1)
