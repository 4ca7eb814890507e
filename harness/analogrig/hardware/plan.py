"""Plans: scenarios checked and converted for a computer as it is wired to its instrument."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError
from analogrig.hardware.by_hand import PlannedChange
from analogrig.hardware.instrument import InputRecord, Instrument
from analogrig.hardware.wiring import RealDescription, check_wiring
from analogrig.plant import Segment
from analogrig.rigs.emulator import Stream, emulator_errors, settings_of
from analogrig.rigs.rig import CHANNEL_UNITS
from analogrig.run import CHANNELS, MEASURED, Channel
from analogrig.scenario import Scenario
from analogrig_emulator import Excitation, SuspensionComputer

LEAD_N = 500
"""Least number of samples in a record before a change, in which the device learns the plant."""

_MOST_CODE = 0xFFFF


@dataclass(frozen=True)
class PlayPlan:
    """A checked scenario, and what its play has shown so far."""

    scenario: Scenario
    computer: SuspensionComputer
    """Nominal computer with the pots of the first sample."""
    excitation: Excitation
    """Waveform at the computer."""
    changes: tuple[PlannedChange, ...]
    contradictions: list[str]
    """Evidence of the samples against the instants of the instrument's own pots."""
    dated: list[Segment] | None
    """Segments dated by the samples; None if the instrument's instants are exact."""

    def truth(self) -> tuple[Segment, ...]:
        return self.scenario.segments() if self.dated is None else tuple(self.dated)


class Planner:
    """Plans scenarios and converts records for a description and a kind of instrument; connects to nothing."""

    def __init__(self, description: RealDescription, kind: type[Instrument]) -> None:
        """:raises ConfigurationError: the description contradicts itself or the datasheet."""
        check_wiring(description, kind.datasheet)
        self._description = description
        self._kind = kind
        self._datasheet = kind.datasheet

    def plan(self, scenario: Scenario, seed: int) -> PlayPlan:
        """:raises ConfigurationError: the rig cannot play the scenario, or it would exceed the limits."""
        description, where = self._description, f"scenario {scenario.name}: "
        if scenario.plant.set != description.plant:
            raise ConfigurationError(
                f"{where}wants the program {scenario.plant.set!r}; {description.name or 'the rig'} has"
                f" {description.plant!r} patched"
            )
        computer = SuspensionComputer(scenario.plant.set)
        with emulator_errors(where):
            computer.set(**settings_of(computer, scenario.plant.overrides()))
            excitation = scenario.draw_excitation(Stream.EXCITATION.generator(seed))
        self._check_force(excitation, where)
        self._check_dials(computer.dials, where)
        changes: list[PlannedChange] = []
        plant = scenario.plant.plant()
        for i, tweak in enumerate(scenario.tweaks):
            place = f"{where}tweaks[{i}] at sample {tweak.sample}: "
            if not description.pots.changeable:
                raise ConfigurationError(f'{place}the pots of this rig cannot be changed: they have kind = "none"')
            if tweak.ramp_n:
                raise ConfigurationError(f"{place}the pots of this rig jump, they do not turn evenly: leave out ramp_n")
            with emulator_errors(place):
                dials = computer.dials_for(**settings_of(computer, tweak.overrides()))
            self._check_dials(dials, place)
            before, plant = plant, dataclasses.replace(plant, **tweak.overrides())
            changes.append(PlannedChange(tweak.sample, dials, before, plant))
        dated = None if description.pots.exact else [Segment(0, scenario.plant.plant())]
        return PlayPlan(scenario, computer, excitation, tuple(changes), [], dated)

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
        """Waveform at the instrument that becomes ``excitation`` at the computer."""
        stage = self._description.generator
        low_v, high_v = (stage.input_v(volts) for volts in (excitation.low_v, excitation.high_v))
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
        """Measured channels, in volts at the computer.

        :param noise_lsb: measured noise by channel; for others that of the description is used.
        """
        scaling = self._description.scaling
        full = {"force": scaling.force_n, "displacement": scaling.displacement_m}
        out = {}
        for name in MEASURED:
            wired = self._description.inputs[name]
            ends_v = wired.ends_v(self._datasheet)
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

    def convert(
        self, taken: InputRecord, channels: Mapping[str, Channel]
    ) -> tuple[NDArray[np.float64], NDArray[np.uint16], NDArray[np.bool_]]:
        """Volts at the computer, codes and clipping of a record, each (n, 4)."""
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


def split_records(samples: int, most_n: int, changes: list[int]) -> list[tuple[int, int]]:
    """Divide samples into as few records (start, end) as possible, none longer than ``most_n``.

    Where possible, a record starts LEAD_N samples or more before a change.
    """
    cuts = [0]
    while samples - cuts[-1] > most_n:
        start, end = cuts[-1], cuts[-1] + most_n
        for change in sorted(changes, reverse=True):
            if start + LEAD_N < change - LEAD_N < end <= change + LEAD_N:
                end = change - LEAD_N
        cuts.append(end)
    return list(itertools.pairwise([*cuts, samples]))
