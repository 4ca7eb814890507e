"""What a real computer can play, as it is wired to its instrument: scenarios become plans, and records codes."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError
from analogrig.hardware.by_hand import Tweak
from analogrig.hardware.instrument import Instrument, Record
from analogrig.hardware.pots import NoPots
from analogrig.hardware.wiring import InstrumentPots, RealDescription, check_wiring
from analogrig.rigs.emulator import Stream, emulator_errors, settings_of
from analogrig.rigs.rig import CHANNEL_UNITS
from analogrig.run import CHANNELS, MEASURED, Channel, Segment
from analogrig.scenario import Scenario
from analogrig_emulator import Excitation, SuspensionComputer

LEAD_N = 500
"""A record begins at least so long before a tweak, so that the device knows the plant that changes."""

_MOST_CODE = 0xFFFF


@dataclass(frozen=True)
class Plan:
    """What will be played, all of it checked."""

    scenario: Scenario
    computer: SuspensionComputer
    """Nominal, as the scenario starts it."""
    excitation: Excitation
    """At the computer."""
    start: Mapping[str, float]
    """Dials."""
    tweaks: tuple[Tweak, ...]
    doubts: list[str]
    """What the samples say against the instants of the instrument's own pots."""
    dated: list[Segment] | None
    """The truth as the samples tell it, where nothing else does."""

    def truth(self) -> tuple[Segment, ...]:
        return self.scenario.segments() if self.dated is None else tuple(self.dated)


class Wired:
    """A description, and the kind of instrument that it names; nothing of it has to be there."""

    def __init__(self, description: RealDescription, kind: type[Instrument]) -> None:
        """:raises ConfigurationError: they do not fit, or the description contradicts itself."""
        check_wiring(description, kind.datasheet)
        self._description = description
        self._kind = kind
        self._datasheet = kind.datasheet

    def plan(self, scenario: Scenario, seed: int) -> Plan:
        """:raises ConfigurationError: the scenario cannot be played on this rig, or would exceed its limits."""
        where = f"scenario {scenario.name}: "
        if scenario.plant.set != self._description.plant:
            raise ConfigurationError(
                f"{where}wants the program {scenario.plant.set!r}; {self._description.name or 'the rig'} has"
                f" {self._description.plant!r} patched"
            )
        computer = SuspensionComputer(scenario.plant.set)
        with emulator_errors(where):
            computer.set(**settings_of(computer, scenario.plant.overrides()))
            excitation = scenario.draw_excitation(Stream.EXCITATION.generator(seed))
        self._check_force(excitation, where)
        start = dict(computer.dials)
        self._check_dials(start, where)
        tweaks: list[Tweak] = []
        plant = scenario.plant.plant()
        for i, tweak in enumerate(scenario.tweaks):
            place = f"{where}tweaks[{i}] at sample {tweak.sample}: "
            if isinstance(self._description.pots, NoPots):
                raise ConfigurationError(f'{place}nobody turns the pots of this rig: its pots have kind = "none"')
            if tweak.ramp_n:
                raise ConfigurationError(f"{place}the pots of this rig jump, they do not turn evenly: leave out ramp_n")
            with emulator_errors(place):
                dials = computer.dials_for(**settings_of(computer, tweak.overrides()))
            self._check_dials(dials, place)
            before, plant = plant, dataclasses.replace(plant, **tweak.overrides())
            tweaks.append(Tweak(tweak.sample, dials, before, plant))
        truth = None if isinstance(self._description.pots, InstrumentPots) else [Segment(0, scenario.plant.plant())]
        return Plan(scenario, computer, excitation, start, tuple(tweaks), [], truth)

    def _check_force(self, excitation: Excitation, where: str) -> None:
        low_v, high_v = self._description.limits.force_v
        if excitation.low_v < low_v or excitation.high_v > high_v:
            raise ConfigurationError(
                f"{where}the force of {excitation.low_v:g} V to {excitation.high_v:g} V exceeds limits.force_v,"
                f" {low_v:g} V to {high_v:g} V"
            )
        try:
            self._kind.check(self.at_generator(excitation))
        except ConfigurationError as error:
            raise ConfigurationError(f"{where}{error}") from error

    def at_generator(self, excitation: Excitation) -> Excitation:
        """The waveform at the instrument that is ``excitation`` at the computer."""
        stage = self._description.generator
        low_v, high_v = ((volts - stage.offset_v) / stage.gain for volts in (excitation.low_v, excitation.high_v))
        if low_v <= high_v:
            return dataclasses.replace(excitation, low_v=low_v, high_v=high_v)
        if excitation.shape != "square":
            raise ConfigurationError(f"generator: a stage that inverts cannot give the shape {excitation.shape!r}")
        return dataclasses.replace(excitation, low_v=high_v, high_v=low_v, phase=(excitation.phase + 0.5) % 1.0)

    def _check_dials(self, dials: Mapping[str, float], where: str) -> None:
        for pot, dial in dials.items():
            least, most = self._description.limits.dials.get(pot, (0.0, 1.0))
            if not least <= dial <= most:
                raise ConfigurationError(
                    f"{where}pot {pot} would stand at {dial:.4g}, and limits.dials allow {least:g} to {most:g}"
                )

    def channels(self, computer: SuspensionComputer, noise_lsb: Mapping[str, float]) -> dict[str, Channel]:
        """Volts at the computer, whatever the stages do to them.

        :param noise_lsb: of the channels of which it was measured.
        """
        scaling = self._description.scaling
        full = {"force": scaling.force_n, "displacement": scaling.displacement_m}
        out = {}
        for name in MEASURED:
            wired = self._description.inputs[name]
            ends_v = sorted((end - wired.offset_v) / wired.gain for end in self._datasheet.ranges_v[wired.range])
            low_v, lsb_v = max(ends_v[0], wired.least_v), (ends_v[1] - ends_v[0]) / (1 << self._datasheet.bits)
            out[name] = Channel(
                low_v=low_v,
                lsb_v=lsb_v,
                unit=CHANNEL_UNITS[name],
                unit_per_v=(full[name] or computer.scales.full(name)) / 10.0,
                noise_lsb=noise_lsb.get(name, wired.noise_lsb),
                codes=math.ceil((ends_v[1] - low_v) / lsb_v),
            )
        return out

    def time_scale(self, computer: SuspensionComputer) -> float:
        return self._description.scaling.time or computer.scales.time

    def converted(
        self, taken: Record, channels: Mapping[str, Channel]
    ) -> tuple[NDArray[np.float64], NDArray[np.uint16], NDArray[np.bool_]]:
        """Volts at the computer, codes and clipping, (n, 4) each."""
        n = len(taken.volts)
        volts = np.full((n, len(CHANNELS)), np.nan)
        codes = np.zeros((n, len(CHANNELS)), np.uint16)
        clipped = np.zeros((n, len(CHANNELS)), np.bool_)
        for column, name in enumerate(MEASURED):
            wired, channel, at = self._description.inputs[name], channels[name], CHANNELS.index(name)
            volts[:, at] = (taken.volts[:, column] - wired.offset_v) / wired.gain
            exact = np.rint((volts[:, at] - channel.low_v) / channel.lsb_v)
            codes[:, at] = np.clip(exact, 0.0, _MOST_CODE)
            clipped[:, at] = taken.clipped[:, column] | (exact < 0.0) | (exact > _MOST_CODE)
        return volts, codes, clipped


def records(samples: int, most_n: int, tweaks: list[int]) -> list[tuple[int, int]]:
    """The records (start, end) in which so many samples are taken, none longer than ``most_n``, and as few as can be
    with LEAD_N samples between the beginning of one and a tweak."""
    cuts = [0]
    while samples - cuts[-1] > most_n:
        start, end = cuts[-1], cuts[-1] + most_n
        for tweak in sorted(tweaks, reverse=True):
            if start + LEAD_N < tweak - LEAD_N < end <= tweak + LEAD_N:
                end = tweak - LEAD_N
        cuts.append(end)
    return list(itertools.pairwise([*cuts, samples]))
