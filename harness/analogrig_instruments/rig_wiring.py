"""Descriptions of real rigs: tables of a rigs file, the check for contradictions, and conversions by the wiring."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Program, Rig
from analogrig.config import check_range
from analogrig.rigs import RigDescription
from analogrig.run import Channel
from analogrig.scenario import DEFAULT_PROGRAM
from analogrig.trust import Thing, absolute_path
from analogrig_emulator import Excitation, SuspensionComputer
from analogrig_instruments.instrument import InputRecord, Instrument, InstrumentDatasheet, find_driver
from analogrig_instruments.pots import PotsDescription

_MOST_CODE = 0xFFFF
_MOST_GAIN, _MOST_OFFSET_V, _MOST_VOLTS = 1e4, 100.0, 1e3


@dataclass(frozen=True)
class Stage:
    """Amplifier between instrument and computer: out = gain in + offset_v, in the direction of the signal."""

    gain: float = 1.0
    offset_v: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < abs(self.gain) <= _MOST_GAIN:
            raise ValueError(f"gain must be within +-{_MOST_GAIN:g} and not 0, not {self.gain:g}")
        check_range(self, "offset_v", -_MOST_OFFSET_V, _MOST_OFFSET_V)

    def input_v(self, output_v: float) -> float:
        """Input voltage that gives an output voltage."""
        return (output_v - self.offset_v) / self.gain


@dataclass(frozen=True, kw_only=True)
class Input(Stage):
    """Path of a channel from the computer to an input of the instrument."""

    input: int
    """Number of the input, as printed on the instrument."""
    range: str
    """The instrument's own name of the range."""
    least_v: float = -1.0
    """Lowest voltage at the computer that is not clipped. Codes count from here: the larger the code of 0 V, the larger
    the offset that the estimator has to learn."""
    noise_lsb: float = 1.0
    """rms noise before quantisation; the self-test measures it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "least_v", -_MOST_VOLTS, _MOST_VOLTS)
        check_range(self, "noise_lsb", 0.0, 1e5)

    def ends_v(self, instrument: InstrumentDatasheet) -> list[float]:
        """Lowest and highest voltage at the computer within the range of the input."""
        return sorted(self.input_v(end_v) for end_v in instrument.ranges_v[self.range])


@dataclass(frozen=True)
class Limits:
    """Limits that no scenario may exceed."""

    input_v: tuple[float, float] = (-1.0, 11.0)
    """Lowest and highest voltage at the input of the computer that the generator drives."""
    dials: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Least and greatest position by pot, within 0 to 1; the default is the whole range."""

    def __post_init__(self) -> None:
        low_v, high_v = self.input_v
        if not -_MOST_VOLTS <= low_v < high_v <= _MOST_VOLTS:
            raise ValueError(f"input_v must be (low, high), not ({low_v:g}, {high_v:g})")
        for pot, (least, most) in self.dials.items():
            if not 0.0 <= least <= most <= 1.0:
                raise ValueError(f"dials.{pot} must be (least, most) within 0 to 1, not ({least:g}, {most:g})")


@dataclass(frozen=True)
class Scaling:
    """Scales of the computer that override those of the program."""

    time: float | None = None
    """Speed of the machine relative to the system that it models."""
    full: Mapping[str, float] = field(default_factory=dict)
    """Value at 10 V by channel, in the channel's unit."""

    def __post_init__(self) -> None:
        named = {f"full.{channel}": value for channel, value in self.full.items()}
        for name, value in {"time": self.time, **named}.items():
            if value is not None and not 1e-9 < value < 1e9:
                raise ValueError(f"{name} must be more than 0, not {value:g}")


@dataclass(frozen=True)
class RealDescription(RigDescription):
    """A rig of the kind ``real``: a table of a rigs file, or a file of its own."""

    kind: Literal["real"]
    instrument: str
    """URL: ``redpitaya://HOST``."""
    inputs: Mapping[str, Input]
    """Inputs by channel: those of the program's input and output, ``force`` and ``displacement`` of ``front``."""
    pots: PotsDescription
    generator: Stage = field(default_factory=Stage)
    program: str = DEFAULT_PROGRAM
    """Program that is patched on the computer: a shipped name or a .toml file."""
    limits: Limits = field(default_factory=Limits)
    scaling: Scaling = field(default_factory=Scaling)
    settle_s: float = 0.1
    """Machine time with the generator off before each record, in which the computer comes to rest."""
    timeout_s: float = 5.0
    self_test: bool = True
    """True: test the rig before the first run."""
    description: str = ""
    name: str = ""

    def __post_init__(self) -> None:
        numbers = [wired.input for wired in self.inputs.values()]
        if len(set(numbers)) < len(numbers):
            raise ValueError(f"inputs: {' and '.join(self.inputs)} cannot both be at input {numbers[0]}")
        check_range(self, "settle_s", 0.0, 10.0)
        check_range(self, "timeout_s", 0.01, 3600.0)

    @property
    def driver(self) -> type[Instrument]:
        """Driver of the instrument.

        :raises ConfigurationError: the URL of the instrument is wrong.
        """
        return find_driver(self.instrument)[0]

    @property
    def only_one(self) -> str:
        return self.instrument

    @functools.cached_property
    def patched(self) -> Program:
        """Program that is patched on the computer.

        :raises ConfigurationError: it is absent, or not a program.
        """
        return Program.load(self.program)

    @property
    def pot_names(self) -> tuple[str, ...]:
        """Names of the pots of the program."""
        return tuple(self.patched.circuit.pots)

    @property
    def things(self) -> tuple[Thing, ...]:
        """Things that playing on it would run or connect to.

        :raises ConfigurationError: the URL of the instrument is wrong.
        """
        kind, address = find_driver(self.instrument)
        return (Thing("address", kind.place(address), "the rig connects to"), *self.pots.things)

    def placed(self, folder: Path) -> Self:
        """The same with absolute paths, where its own are relative to ``folder``."""
        program = absolute_path(self.program, folder) if self.program.endswith(".toml") else self.program
        return dataclasses.replace(self, pots=self.pots.placed(folder), program=program)

    def check(self) -> None:
        self.pots.check()

    def open(self, *, self_test: bool = True) -> Rig:
        from analogrig_instruments.real import RealRig

        return RealRig(dataclasses.replace(self, self_test=self.self_test and self_test))

    def check_wiring(self) -> None:
        """Check the description against the datasheet of its instrument.

        :raises ConfigurationError: they contradict each other; the message names the key.
        """
        instrument = self.driver.datasheet
        _check_channels(self)
        for name, wired in self.inputs.items():
            if wired.input not in instrument.inputs:
                has = " and ".join(map(str, instrument.inputs))
                raise ConfigurationError(f"inputs.{name}: input must be {has}, not {wired.input}")
            if wired.range not in instrument.ranges_v:
                has = " or ".join(map(repr, instrument.ranges_v))
                raise ConfigurationError(f"inputs.{name}: range must be {has}, not {wired.range!r}")
            low_v, high_v = wired.ends_v(instrument)
            if not low_v < 0.0 < high_v or wired.least_v > 0.0:
                raise ConfigurationError(
                    f"inputs.{name}: 0 V at the computer must be within the measured range: {low_v:g} V to {high_v:g} V"
                    f" by gain and offset_v, from least_v, {wired.least_v:g} V, on"
                )
        pots = self.pot_names
        named = {"limits.dials": self.limits.dials, "pots.names": getattr(self.pots, "names", {})}
        for key, table in named.items():
            if unknown := sorted(set(table) - set(pots)):
                raise ConfigurationError(f"{key}: there is no pot {unknown[0]!r}: there are {', '.join(pots)}")
        stage = self.generator
        if not self.limits.input_v[0] <= stage.offset_v <= self.limits.input_v[1]:
            raise ConfigurationError(
                f"generator: when it is off, the computer's input stands at offset_v, {stage.offset_v:g} V, and"
                f" limits.input_v allow {self.limits.input_v[0]:g} V to {self.limits.input_v[1]:g} V"
            )
        ends_v = sorted(stage.gain * volts + stage.offset_v for volts in instrument.output_v)
        low_v, high_v = self.limits.input_v
        if ends_v[0] >= high_v or ends_v[1] <= low_v:
            raise ConfigurationError(
                f"generator: with gain and offset it gives {ends_v[0]:g} V to {ends_v[1]:g} V, and limits.input_v allow"
                f" {low_v:g} V to {high_v:g} V"
            )

    def at_generator(self, excitation: Excitation) -> Excitation:
        """Waveform at the instrument that becomes ``excitation`` at the computer.

        :raises ConfigurationError: the stage between them cannot give the shape.
        """
        if excitation.is_smooth:
            raise ConfigurationError(
                f"generator: a real rig plays the shapes square, pulse and prbs, not {excitation.shape!r}"
            )
        stage = self.generator
        low_v, high_v = (stage.input_v(volts) for volts in (excitation.low_v, excitation.high_v))
        if low_v <= high_v:
            return dataclasses.replace(excitation, low_v=low_v, high_v=high_v)
        if excitation.shape != "square":
            raise ConfigurationError(f"generator: a stage that inverts cannot give the shape {excitation.shape!r}")
        return dataclasses.replace(excitation, low_v=high_v, high_v=low_v, phase=(excitation.phase + 0.5) % 1.0)

    def check_dials(self, dials: Mapping[str, float], where: str) -> None:
        """:raises ConfigurationError: a dial exceeds the limits; ``where`` begins the message."""
        for pot, dial in dials.items():
            least, most = self.limits.dials.get(pot, (0.0, 1.0))
            if not least <= dial <= most:
                raise ConfigurationError(
                    f"{where}pot {pot} would stand at {dial:.4g}, and limits.dials allow {least:g} to {most:g}"
                )

    def channels(self, computer: SuspensionComputer, noise_lsb: Mapping[str, float]) -> dict[str, Channel]:
        """Measured channels, in volts at the computer.

        :param noise_lsb: measured noise by channel; for others that of the description is used.
        """
        datasheet = self.driver.datasheet
        out = {}
        for name in self.patched.measured:
            wired = self.inputs[name]
            ends_v = wired.ends_v(datasheet)
            low_v, lsb_v = max(ends_v[0], wired.least_v), (ends_v[1] - ends_v[0]) / (1 << datasheet.bits)
            out[name] = Channel(
                low_v=low_v,
                lsb_v=lsb_v,
                unit=self.patched.unit(name),
                unit_per_v=self.scaling.full.get(name, computer.scales.full(name)) / 10.0,
                noise_lsb=noise_lsb.get(name, wired.noise_lsb),
                codes=math.ceil((ends_v[1] - low_v) / lsb_v),
            )
        return out

    def time_scale(self, computer: SuspensionComputer) -> float:
        """Speed of the machine relative to the system that it models."""
        return self.scaling.time or computer.scales.time

    def convert(
        self, taken: InputRecord, channels: Mapping[str, Channel]
    ) -> tuple[NDArray[np.float64], NDArray[np.uint16], NDArray[np.bool_]]:
        """Volts at the computer, codes and clipping of a record, each (n, channels of the program)."""
        shape = len(taken.volts), len(self.patched.channels)
        volts = np.full(shape, np.nan)
        codes = np.zeros(shape, np.uint16)
        clipped = np.zeros(shape, np.bool_)
        for at, name in enumerate(self.patched.measured):
            wired, channel = self.inputs[name], channels[name]
            volts[:, at] = (taken.volts[:, at] - wired.offset_v) / wired.gain
            exact = np.rint((volts[:, at] - channel.low_v) / channel.lsb_v)
            codes[:, at] = np.clip(exact, 0.0, _MOST_CODE)
            clipped[:, at] = taken.clipped[:, at] | (exact < 0.0) | (exact > _MOST_CODE)
        return volts, codes, clipped


def _check_channels(description: RealDescription) -> None:
    """:raises ConfigurationError: inputs or scales are not those of the program's input and output."""
    measured = description.patched.measured
    if set(description.inputs) != set(measured):
        given = ", ".join(description.inputs) or "none"
        raise ConfigurationError(
            f"inputs must be {' and '.join(measured)}, input and output of the program {description.patched.name},"
            f" not {given}"
        )
    if unknown := sorted(set(description.scaling.full) - set(measured)):
        raise ConfigurationError(
            f"scaling.full: there is no channel {unknown[0]!r}: there are {' and '.join(measured)}"
        )
