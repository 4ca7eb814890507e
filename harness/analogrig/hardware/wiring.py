"""How a real computer is wired to its instrument: the tables of a rigs file, and what contradicts itself in them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Self

from analogrig.errors import ConfigurationError
from analogrig.hardware.instrument import Datasheet, located
from analogrig.hardware.pots import Harmless, PotsDescription
from analogrig.run import MEASURED
from analogrig.trust import Thing
from analogrig_emulator import SuspensionComputer

_MOST_GAIN, _MOST_OFFSET_V, _MOST_VOLTS = 1e4, 100.0, 1e3


@dataclass(frozen=True)
class Stage:
    """What is between instrument and computer: out = gain in + offset_v, in the direction in which the signal goes."""

    gain: float = 1.0
    offset_v: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < abs(self.gain) <= _MOST_GAIN:
            raise ValueError(f"gain must be within +-{_MOST_GAIN:g} and not 0, not {self.gain:g}")
        if not abs(self.offset_v) <= _MOST_OFFSET_V:
            raise ValueError(f"offset_v must be within +-{_MOST_OFFSET_V:g} V, not {self.offset_v:g}")


@dataclass(frozen=True)
class Input:
    """A channel's way from the computer to an input of the instrument."""

    input: int
    """Its number, as printed on the instrument."""
    range: str
    """In the instrument's own words."""
    gain: float = 1.0
    offset_v: float = 0.0
    least_v: float = -1.0
    """At the computer; what is below counts as clipped. Codes count from here: the larger the code of 0 V, the larger
    the offset that the estimator has to learn."""
    noise_lsb: float = 1.0
    """rms before quantisation, as far as it is known; the self-test measures it."""

    def __post_init__(self) -> None:
        Stage(self.gain, self.offset_v)
        if not abs(self.least_v) <= _MOST_VOLTS:
            raise ValueError(f"least_v must be within +-{_MOST_VOLTS:g} V, not {self.least_v:g}")
        if not 0.0 <= self.noise_lsb <= 1e5:
            raise ValueError(f"noise_lsb must be 0 to 1e5, not {self.noise_lsb:g}")


@dataclass(frozen=True)
class Limits:
    """What must never be exceeded, whatever a scenario asks."""

    force_v: tuple[float, float] = (-1.0, 11.0)
    """At the computer's force input."""
    dials: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Of each pot by its name: least and most, 0 to 1; others may stand anywhere."""

    def __post_init__(self) -> None:
        low_v, high_v = self.force_v
        if not -_MOST_VOLTS <= low_v < high_v <= _MOST_VOLTS:
            raise ValueError(f"force_v must be (low, high), not ({low_v:g}, {high_v:g})")
        for pot, (least, most) in self.dials.items():
            if not 0.0 <= least <= most <= 1.0:
                raise ValueError(f"dials.{pot} must be (least, most) within 0 to 1, not ({least:g}, {most:g})")


@dataclass(frozen=True)
class Scaling:
    """What the computer's volts mean, where it is not as the program has it."""

    time: float | None = None
    """How much faster the machine runs than what it models."""
    force_n: float | None = None
    """10 V of force."""
    displacement_m: float | None = None
    """10 V of displacement."""

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if value is not None and not 1e-9 < value < 1e9:
                raise ValueError(f"{name} must be more than 0, not {value:g}")


@dataclass(frozen=True)
class InstrumentPots(Harmless):
    """The instrument turns the pots itself, at exact instants."""

    kind: Literal["instrument"]


@dataclass(frozen=True)
class RealDescription:
    """A rig of the kind ``real``: a table of a rigs file, or a file of its own."""

    kind: Literal["real"]
    instrument: str
    """URL: ``redpitaya://HOST``."""
    inputs: Mapping[str, Input]
    """Of ``force`` and ``displacement``."""
    pots: InstrumentPots | PotsDescription
    generator: Stage = field(default_factory=Stage)
    plant: Literal["front", "shock"] = "front"
    """The program that is patched."""
    limits: Limits = field(default_factory=Limits)
    scaling: Scaling = field(default_factory=Scaling)
    settle_s: float = 0.1
    """Machine time with the generator off before each record: the computer is then at rest."""
    timeout_s: float = 5.0
    self_test: bool = True
    """Before anything is judged."""
    description: str = ""
    name: str = ""

    def __post_init__(self) -> None:
        if set(self.inputs) != set(MEASURED):
            raise ValueError(f"inputs must be {' and '.join(MEASURED)}, not {', '.join(self.inputs) or 'none'}")
        numbers = [wired.input for wired in self.inputs.values()]
        if len(set(numbers)) < len(numbers):
            raise ValueError(f"inputs: force and displacement cannot both be at input {numbers[0]}")
        for name, least, most in (("settle_s", 0.0, 10.0), ("timeout_s", 0.01, 3600.0)):
            if not least <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be {least:g} to {most:g}, not {getattr(self, name):g}")

    @property
    def things(self) -> tuple[Thing, ...]:
        """Things that playing on it would run or connect to.

        :raises ConfigurationError: the instrument has no such address.
        """
        kind, address = located(self.instrument)
        return (Thing("address", kind.place(address), "the rig connects to"), *self.pots.things)

    def placed(self, folder: Path) -> Self:
        """The same with absolute paths, where its own are relative to ``folder``."""
        return dataclasses.replace(self, pots=self.pots.placed(folder))


def check_wiring(description: RealDescription, instrument: Datasheet) -> None:
    """That the description fits what the instrument has.

    :raises ConfigurationError: it does not; names the key.
    """
    for name, wired in description.inputs.items():
        if wired.input not in instrument.inputs:
            has = " and ".join(map(str, instrument.inputs))
            raise ConfigurationError(f"inputs.{name}: input must be {has}, not {wired.input}")
        if wired.range not in instrument.ranges_v:
            has = " or ".join(map(repr, instrument.ranges_v))
            raise ConfigurationError(f"inputs.{name}: range must be {has}, not {wired.range!r}")
        low_v, high_v = sorted((end - wired.offset_v) / wired.gain for end in instrument.ranges_v[wired.range])
        if not low_v < 0.0 < high_v or wired.least_v > 0.0:
            raise ConfigurationError(
                f"inputs.{name}: 0 V at the computer must be within what is seen of it, {low_v:g} V to {high_v:g} V"
                f" by gain and offset_v, from least_v, {wired.least_v:g} V, on"
            )
    pots = tuple(SuspensionComputer(description.plant).dials)
    named = {"limits.dials": description.limits.dials, "pots.names": getattr(description.pots, "names", {})}
    for key, table in named.items():
        if unknown := sorted(set(table) - set(pots)):
            raise ConfigurationError(f"{key}: there is no pot {unknown[0]!r}: there are {', '.join(pots)}")
    stage = description.generator
    if not description.limits.force_v[0] <= stage.offset_v <= description.limits.force_v[1]:
        raise ConfigurationError(
            f"generator: when it is off, the force input stands at offset_v, {stage.offset_v:g} V, and limits.force_v"
            f" allow {description.limits.force_v[0]:g} V to {description.limits.force_v[1]:g} V"
        )
    ends_v = sorted(stage.gain * volts + stage.offset_v for volts in instrument.output_v)
    low_v, high_v = description.limits.force_v
    if ends_v[0] >= high_v or ends_v[1] <= low_v:
        raise ConfigurationError(
            f"generator: with gain and offset it gives {ends_v[0]:g} V to {ends_v[1]:g} V, and limits.force_v allow"
            f" {low_v:g} V to {high_v:g} V"
        )
