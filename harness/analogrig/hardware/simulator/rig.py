"""The emulated rig that is served: that of a shipped or own description, seen through an instrument."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.hardware.simulator.description import InstrumentDescription, left_out
from analogrig.hardware.simulator.red_pitaya import ServedRedPitaya
from analogrig.links.wire import Clock
from analogrig.rigs.emulator import EmulatorDescription, Stream, emulator_errors

Keys = dict[str, Any]


@dataclass(frozen=True)
class ServedDescription(EmulatorDescription):
    """An emulated rig's description, and how the instrument is connected to it."""

    instrument: InstrumentDescription = field(default_factory=InstrumentDescription)

    @classmethod
    def load(cls, name: str, defects: Sequence[str] = ()) -> ServedDescription:
        """Of a shipped rig or a .toml file; ``defects``: lines of TOML that its table ``[instrument]`` gets besides.

        :raises ConfigurationError: there is none, or something in it is wrong.
        """
        path = config.locate("rigs", name)
        table: Keys = {"name": path.stem, **config.read_toml(path)}
        for defect in defects:
            table = _merged(table, {"instrument": _parsed(defect)})
        return config.build(cls, table, str(path))

    def laid(self, program: str, seed: int, clock: Clock | None = None) -> ServedRedPitaya:
        """The instrument, and on its table the very computer that an EmulatorRig plays on with that seed.

        With a ``clock`` its records take the time that they last.

        :raises ConfigurationError: the computer or the instrument cannot be.
        """
        with emulator_errors(f"{self.name}: "):
            try:
                described = self.instrument.beside(self.card.card())
            except ValueError as error:
                raise ConfigurationError(f"{self.name}: card and instrument together: {error}") from error
            return ServedRedPitaya(
                lambda rate_hz: self.computer.wired(program, seed, rate_hz),
                Stream.CARD.generator(seed),
                described,
                clock,
            )

    @property
    def left_out(self) -> tuple[str, ...]:
        """What the description has and the served instrument has not."""
        of_card = tuple(f"card.{name}" for name in left_out(self.card.card()))
        return (*of_card, "computer.noise") if self.computer.noise else of_card


def _parsed(defect: str) -> Keys:
    try:
        return tomllib.loads(defect)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(
            f"--defect {defect[:80]}: {error}; it is a line of TOML such as wiring.swapped=true"
        ) from error


def _merged(table: Keys, more: Keys) -> Keys:
    """Table with the keys of another, tables in it likewise."""
    out = dict(table)
    for key, value in more.items():
        both = isinstance(value, dict) and isinstance(out.get(key), dict)
        out[key] = _merged(out[key], value) if both else value
    return out
