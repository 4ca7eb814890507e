"""Rigs: what plays a scenario and yields samples. The emulated analogue computer, and a recording of a run.

A rig is opened by name, performs scenarios, and is closed. Whatever else a bench instrument will be, it is another
class with these methods; nothing behind this module asks which one it has.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from emulator import Card, EmulatorError, Excitation, Sampler, SuspensionComputer
from emulator.opamp import preset
from harness import config
from harness.errors import AnalogrigError, ConfigurationError, RigError
from harness.run import CHANNELS, Channel, Run, Segment
from harness.scenario import Scenario

BLOCK_SAMPLES = 256
"""Samples that pass from rig to device at a time: enough to be fast, few enough to show progress and to lose little."""

CHANNEL_UNITS = {"force": "N", "displacement": "m", "velocity": "m/s", "net_force": "N"}

_SETTINGS = {"mass_kg": "M_kg", "damping_n_s_per_m": "B_n_s_per_m", "stiffness_n_per_m": "K_n_per_m"}
"""Scenario's names of the parameters to the emulator's."""


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive samples, each taken on all channels at the same instant; columns as ``CHANNELS``."""

    first: int
    """Index of the first sample."""
    volts: NDArray[np.float64]
    """(n, 4): at the computer's outputs."""
    codes: NDArray[np.uint16]
    """(n, 4)"""
    clipped: NDArray[np.bool_]
    """(n, 4): the code is the end of the range, not a measurement."""


@dataclass(frozen=True, eq=False)
class Performance:
    """A scenario being played: what is known beforehand, and the samples as they come."""

    sample_period_s: float
    time_scale: float
    channels: Mapping[str, Channel]
    segments: tuple[Segment, ...]
    """The truth; empty if the rig does not know it."""
    blocks: Iterator[Block]


class Rig(Protocol):
    """Something that can play a scenario."""

    capabilities: frozenset[str]
    """What it can do beyond sampling: ``tweak``, ``excite``."""

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        """Begin to play; the blocks are produced as they are asked for.

        :raises ConfigurationError: the scenario cannot be played on this rig.
        :raises RigError: the rig failed; also while the blocks are taken.
        """

    def description(self) -> Mapping[str, Any]:
        """Its name and settings in plain values, for the record."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave it safe: outputs off, connections closed."""


def open_rig(name: str) -> Rig:
    """The rig of a shipped or own description, or ``recording:FILE``.

    :raises ConfigurationError: there is none, or its description is wrong.
    :raises RecordingError: the recording cannot be read.
    """
    kind, _, rest = name.partition(":")
    if kind == "recording" and rest:
        return RecordingRig.open(Path(rest))
    path = config.locate("rigs", name)
    description = config.build(EmulatorDescription, {"name": path.stem, **config.read_toml(path)}, str(path))
    with _emulator_errors(f"{path}: "):
        return EmulatorRig(description)


@dataclass(frozen=True)
class ComputerDescription:
    """The ``[computer]`` table: which amplifiers the machine has."""

    op_amp: str = "tl07x"
    offset_v: float = 0.0
    """Each amplifier's input offset is drawn from the seed, within plus and minus this."""


@dataclass(frozen=True)
class CardDescription:
    """The ``[card]`` table. ``range_v`` gives the ends of each channel's range, by the channel's name."""

    range_v: Mapping[str, tuple[float, float]]
    bits: int = 12
    rate_hz: float = 20e3
    noise_lsb: float = 0.0
    """rms on every channel, before quantisation."""

    def __post_init__(self) -> None:
        if set(self.range_v) != set(CHANNELS):
            raise ValueError(f"range_v must give the channels {', '.join(CHANNELS)}, not {', '.join(self.range_v)}")

    def card(self) -> Card:
        """:raises SamplerError: a value is out of range."""
        ranges_v = tuple(self.range_v[channel] for channel in CHANNELS)
        return Card(self.bits, self.rate_hz, ranges_v, (self.noise_lsb,) * len(CHANNELS))


@dataclass(frozen=True)
class EmulatorDescription:
    """``fixtures/rigs/*.toml``, or a user's own file."""

    card: CardDescription
    kind: Literal["emulator"] = "emulator"
    computer: ComputerDescription = field(default_factory=ComputerDescription)
    description: str = ""
    name: str = ""


class _Stream(enum.IntEnum):
    """Independent streams of random numbers that one seed gives: to draw more of one changes none of the others."""

    EXCITATION = 0
    COMPONENTS = 1
    CARD = 2

    def generator(self, seed: int) -> np.random.Generator:
        return np.random.default_rng([seed, int(self)])


class SetUp(NamedTuple):
    """A computer, and what is to be played on it."""

    computer: SuspensionComputer
    excitation: Excitation
    tweaks: tuple[tuple[int, dict[str, float]], ...]


class EmulatorRig:
    """The emulated analogue computer and its card."""

    capabilities = frozenset({"tweak", "excite"})

    def __init__(self, description: EmulatorDescription) -> None:
        """:raises EmulatorError: the card or the amplifiers cannot be."""
        self._description = description
        self._card = description.card.card()
        self._amplifier = preset(description.computer.op_amp)

    def description(self) -> Mapping[str, Any]:
        return dataclasses.asdict(self._description)

    def set_up(self, scenario: Scenario, seed: int) -> SetUp:
        """The machine as the scenario starts it, and what will be played on it.

        :raises ConfigurationError: the scenario cannot be played on this rig.
        """
        with _emulator_errors(f"scenario {scenario.name}: "):
            computer = self._computer(scenario, seed)
            excitation = scenario.excitation_drawn(_Stream.EXCITATION.generator(seed))
        tweaks = []
        for i, tweak in enumerate(scenario.tweaks):
            with _emulator_errors(f"scenario {scenario.name}: tweaks[{i}] at sample {tweak.sample}: "):
                settings = _settings(tweak.given())
                computer.dials_for(**settings)  # refuses here what play() would, so that the tweak can be named
            tweaks.append((tweak.sample, settings))
        return SetUp(computer, excitation, tuple(tweaks))

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        computer, excitation, tweaks = self.set_up(scenario, seed)
        with _emulator_errors(f"scenario {scenario.name}: "):
            volts = computer.play(excitation, scenario.samples, tweaks, BLOCK_SAMPLES)
        return Performance(
            sample_period_s=1.0 / self._card.rate_hz,
            time_scale=computer.scales.time,
            channels=self._channels(computer),
            segments=scenario.segments(),
            blocks=_sampled(volts, Sampler(self._card, _Stream.CARD.generator(seed))),
        )

    def _computer(self, scenario: Scenario, seed: int) -> SuspensionComputer:
        drawn = self._description.computer
        computer = SuspensionComputer(
            scenario.plant.set,
            opamp=self._amplifier,
            rng=_Stream.COMPONENTS.generator(seed),
            offset_v=drawn.offset_v,
            sample_rate_hz=self._card.rate_hz,
        )
        computer.set(**_settings(scenario.plant.given()))
        return computer

    def _channels(self, computer: SuspensionComputer) -> dict[str, Channel]:
        return {
            name: Channel(
                low_v=self._card.ranges_v[i][0],
                lsb_v=float(self._card.lsb_v[i]),
                unit=CHANNEL_UNITS[name],
                unit_per_v=1.0 / computer.scales.volts(name),
                noise_lsb=self._card.noise_lsb[i],
            )
            for i, name in enumerate(CHANNELS)
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class RecordingRig:
    """A recorded run, played again; it knows one scenario, its own."""

    capabilities: frozenset[str] = frozenset()

    def __init__(self, run: Run, path: Path) -> None:
        self.run = run
        self.path = path
        self._name = f"recording:{path}"

    @classmethod
    def open(cls, path: Path) -> RecordingRig:
        """:raises RecordingError: the file cannot be read."""
        return cls(Run.load(path), path)

    def description(self) -> Mapping[str, Any]:
        return {**self.run.conditions.rig, "name": self._name}

    def scenario(self) -> Scenario:
        """The scenario that was recorded, as long as the recording is."""
        scenario = Scenario.from_table(self.run.conditions.scenario, self._name)
        return dataclasses.replace(
            scenario,
            samples=self.run.samples,
            tweaks=tuple(tweak for tweak in scenario.tweaks if tweak.sample < self.run.samples),
        )

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        conditions = self.run.conditions
        if scenario != self.scenario():
            raise ConfigurationError(f"{self._name}: holds the scenario {self.scenario().name!r} and can play no other")
        if seed != conditions.seed:
            raise ConfigurationError(f"{self._name}: was recorded with seed {conditions.seed}, not {seed}")
        return Performance(
            conditions.sample_period_s, conditions.time_scale, conditions.channels, conditions.segments, self._blocks()
        )

    def _blocks(self) -> Iterator[Block]:
        channels = [self.run.conditions.channels[name] for name in CHANNELS]
        for first in range(0, self.run.samples, BLOCK_SAMPLES):
            codes = self.run.codes[first : first + BLOCK_SAMPLES]
            volts = np.stack([channel.volts(codes[:, i]) for i, channel in enumerate(channels)], axis=1)
            yield Block(first, volts, codes, self.run.clipped[first : first + BLOCK_SAMPLES])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def _sampled(volts: Iterator[NDArray[np.float64]], sampler: Sampler) -> Iterator[Block]:
    first = 0
    with _emulator_errors(as_error=RigError):
        for block in volts:
            codes, clipped = sampler.sample(block)
            yield Block(first, block, codes, clipped)
            first += len(block)


@contextlib.contextmanager
def _emulator_errors(prefix: str = "", as_error: type[AnalogrigError] = ConfigurationError) -> Iterator[None]:
    """What the emulator raises becomes an error of the harness, here and nowhere else."""
    try:
        yield
    except EmulatorError as error:
        raise as_error(f"{prefix}{error}") from error


def _settings(given: Mapping[str, float]) -> dict[str, float]:
    return {_SETTINGS[name]: value for name, value in given.items()}
