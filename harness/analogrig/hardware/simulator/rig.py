"""Emulated rig that is served as an instrument."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.hardware.simulator.computer import MEASURED_AT
from analogrig.hardware.simulator.red_pitaya import InstrumentDescription, ServedRedPitaya
from analogrig.links.wire import Clock
from analogrig.rigs.emulator import EmulatorDescription, Stream, emulator_errors
from analogrig_emulator import Card

Keys = dict[str, Any]

_ON_BOTH = {"noise_lsb", "gain_error", "offset_lsb", "skew_s", "clock_drift_ppm"}
_OF_THE_CARD = {"bits", "rate_hz", "ranges_v", "throughput_hz"}


@dataclass(frozen=True)
class ServedDescription(EmulatorDescription):
    """Description of an emulated rig and of the instrument at its connectors."""

    instrument: InstrumentDescription = field(default_factory=InstrumentDescription)

    @classmethod
    def load(cls, name: str, defects: Sequence[str] = ()) -> ServedDescription:
        """Load a shipped rig or a .toml file, and add ``defects``, lines of TOML, to its table ``[instrument]``.

        :raises ConfigurationError: it does not exist, or is wrong.
        """
        path = config.locate("rigs", name)
        table: Keys = {"name": path.stem, **config.read_toml(path)}
        for defect in defects:
            table = _merge(table, {"instrument": _parse(defect)})
        return config.build(cls, table, str(path))

    def set_up(self, program: str, seed: int, clock: Clock | None = None) -> ServedRedPitaya:
        """The instrument with the computer that an EmulatorRig plays with the same seed.

        With a ``clock`` its records take their real time.

        :raises ConfigurationError: computer and instrument contradict each other.
        """
        with emulator_errors(f"{self.name}: "):
            try:
                described = self.combined_instrument()
            except ValueError as error:
                raise ConfigurationError(f"{self.name}: card and instrument together: {error}") from error
            return ServedRedPitaya(
                lambda rate_hz: self.computer.wired(program, seed, rate_hz),
                Stream.CARD.generator(seed),
                described,
                clock,
            )

    def combined_instrument(self) -> InstrumentDescription:
        """The instrument with the faults of the card, where it can have them, in addition to its own.

        :raises ValueError: together they are too large.
        """
        card, instrument = self.card.card(), self.instrument
        own = instrument.inputs
        lsb_v = card.lsb_v
        gain_error, offset_v, noise_v, skew_s = (
            [float(values[at]) for at in MEASURED_AT]
            for values in (
                card.per_channel("gain_error"),
                card.per_channel("offset_lsb") * lsb_v,
                card.per_channel("noise_lsb") * lsb_v,
                card.per_channel("skew_s"),
            )
        )
        inputs = replace(
            own,
            noise_v=(math.hypot(own.noise_v[0], noise_v[0]), math.hypot(own.noise_v[1], noise_v[1])),
            gain_error=(own.gain_error[0] + gain_error[0], own.gain_error[1] + gain_error[1]),
            offset_v=(own.offset_v[0] + offset_v[0], own.offset_v[1] + offset_v[1]),
            skew_s=own.skew_s + skew_s[1] - skew_s[0],
        )
        clock_ppm = instrument.acquisition.clock_ppm + card.clock_drift_ppm
        return replace(instrument, inputs=inputs, acquisition=replace(instrument.acquisition, clock_ppm=clock_ppm))

    @property
    def left_out(self) -> tuple[str, ...]:
        """Keys of the description that the served instrument does not simulate."""
        card = self.card.card()
        others = [each for each in fields(Card) if each.name not in _ON_BOTH | _OF_THE_CARD]
        of_card = tuple(f"card.{each.name}" for each in others if getattr(card, each.name) != each.default)
        return (*of_card, "computer.noise") if self.computer.noise else of_card


def _parse(defect: str) -> Keys:
    try:
        return tomllib.loads(defect)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(
            f"--defect {defect[:80]}: {error}; it is a line of TOML such as wiring.swapped=true"
        ) from error


def _merge(table: Keys, more: Keys) -> Keys:
    """The table with the keys of another; nested tables are merged likewise."""
    out = dict(table)
    for key, value in more.items():
        both = isinstance(value, dict) and isinstance(out.get(key), dict)
        out[key] = _merge(out[key], value) if both else value
    return out
