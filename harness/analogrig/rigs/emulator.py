"""Emulated analogue computer and its card, as a rig, and its description."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.errors import AnalogrigError, ConfigurationError, RigError
from analogrig.plant import Plant, Segment
from analogrig.rigs.rig import BLOCK_SAMPLES, CHANNEL_UNITS, Block, Hindsight, Performance, Rig, RigDescription
from analogrig.run import CHANNELS, Channel
from analogrig.scenario import Scenario
from analogrig_emulator import (
    CARDS,
    COMPONENTS,
    OP_AMP_GRADES,
    PROGRAMS,
    Capacitor,
    Card,
    Components,
    EmulatorError,
    Excitation,
    NoisySuspension,
    OpAmp,
    OpAmpGrade,
    Pot,
    PotTurn,
    RepeatedPlay,
    Resistor,
    Sampler,
    SuspensionComputer,
    acquired,
    ahead_ticks,
    drawn_offsets_v,
    is_repeatable,
    preset,
    probes_per_sample,
)

MOST_VOLTS, LEAST_SPAN_V, MOST_OFFSET_V = 1000.0, 1e-3, 1.0
MOST_RATE_HZ, MOST_NOISE_LSB = 1e9, 1e5
MOST_DEVIATION = 0.9


@dataclass(frozen=True)
class MeasuredValues:
    """The ``[computer.values]`` table: measured values of one machine, by the names of its elements.

    Elements that are not named have the values of the diagram and the amplifiers' datasheet; nothing is drawn.
    ``analogrig calibrate`` writes this table.
    """

    deviation: Mapping[str, float] = field(default_factory=dict)
    """Relative deviation of a resistor, capacitor or pot track from the diagram's value."""
    offset_v: Mapping[str, float] = field(default_factory=dict)
    """Input offset of an amplifier."""
    bandwidth: Mapping[str, float] = field(default_factory=dict)
    """Relative deviation of an amplifier's bandwidth from the model's."""
    slew: Mapping[str, float] = field(default_factory=dict)
    """Relative deviation of an amplifier's slew rate from the model's."""

    def __post_init__(self) -> None:
        parts, amplifiers = _element_names()
        for table, known, most in (
            ("deviation", parts, MOST_DEVIATION),
            ("offset_v", amplifiers, MOST_OFFSET_V),
            ("bandwidth", amplifiers, MOST_DEVIATION),
            ("slew", amplifiers, MOST_DEVIATION),
        ):
            for name, value in getattr(self, table).items():
                if name not in known:
                    raise ValueError(f"{table}: unknown key {name!r} (known: {', '.join(known)})")
                if not abs(value) <= most:
                    raise ValueError(f"{table}.{name} must be within +-{most:g}, not {value:g}")

    def put_in(self, stock: Components) -> Components:
        """Components of the machine: the stock's, overridden by the measured values."""
        given = {**self.deviation, **self.offset_v}
        return dataclasses.replace(
            stock.without_draws(), given=given, given_bandwidth=self.bandwidth, given_slew=self.slew
        )


@functools.cache
def _element_names() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the resistors, capacitors and pots, and names of the amplifiers, of all programs, in diagram order."""
    programs = PROGRAMS.values()
    parts = [name for program in programs for name in program.element_names(Resistor, Capacitor, Pot)]
    amplifiers = [name for program in programs for name in program.element_names(OpAmp)]
    return tuple(dict.fromkeys(parts)), tuple(dict.fromkeys(amplifiers))


@dataclass(frozen=True)
class ComputerDescription:
    """The ``[computer]`` table: components of the machine, its temperature and its age."""

    op_amp: str = "tl07x"
    offset_v: float = 0.0
    """Each amplifier's input offset is drawn from the seed, within plus and minus this."""
    components: Literal["nominal", "polyester", "polypropylene"] = "nominal"
    """Kind of components. Real ones are drawn from the seed, as is the amplifiers' grade: offset, drift, bias,
    bandwidth."""
    specimen: int | None = None
    """Seed from which the machine is drawn, instead of the run's: all runs then use the same machine."""
    pots: Literal["coefficient", "dial"] = "coefficient"
    """Quantity to which the pots are set.

    ``coefficient``: the coefficient, read under the real load (pot-set mode). ``dial``: the dial at which a nominal
    machine would have that coefficient (digital pots).
    """
    values: MeasuredValues | None = None
    """Measured values of the machine; if given, no component is drawn."""
    temperature_c: float = 25.0
    age_h: float = 0.0
    wiper_noise_ohm: float = 0.0
    """Largest rise of a wiper's resistance while its pot is turned (``ramp_n``)."""
    noise: bool = False
    """Thermal noise of resistors and noise of the amplifiers; costs about 0.2 us a sample."""

    def components_for(self, seed: int) -> Components:
        """Components of the machine: as measured, or drawn from the seed.

        :raises CircuitError: a value is out of range.
        """
        stock = dataclasses.replace(
            COMPONENTS[self.components], temperature_c=self.temperature_c, age_h=self.age_h, seed=seed
        )
        if self.wiper_noise_ohm:
            stock = dataclasses.replace(
                stock, pots=dataclasses.replace(stock.pots, wiper_noise_ohm=self.wiper_noise_ohm)
            )
        graded = self.components != "nominal" and self.op_amp in OP_AMP_GRADES
        stock = dataclasses.replace(stock, op_amps=OP_AMP_GRADES[self.op_amp]) if graded else stock
        return stock if self.values is None else self.values.put_in(stock)

    def machine(self, program: str, seed: int, sample_rate_hz: float) -> SuspensionComputer:
        """Machine drawn from the seed of a run, wired as a program, with the program's pots.

        :raises EmulatorError: it cannot be.
        """
        specimen = seed if self.specimen is None else self.specimen
        return SuspensionComputer(
            program,
            opamp=preset(self.op_amp),
            rng=Stream.COMPONENTS.generator(specimen),
            offset_v=self.offset_v,
            components=self.components_for(specimen),
            sample_rate_hz=sample_rate_hz,
        )

    def add_noise(self, computer: SuspensionComputer, seed: int) -> SuspensionComputer | NoisySuspension:
        """The machine, with the noise of its components if that is described."""
        if not self.noise:
            return computer
        grade = OP_AMP_GRADES.get(self.op_amp, OpAmpGrade())
        return NoisySuspension(computer, Stream.NOISE.generator(seed), op_amps=grade, temperature_c=self.temperature_c)

    def __post_init__(self) -> None:
        config.check_range(self, "offset_v", 0.0, MOST_OFFSET_V)
        if self.specimen is not None and self.specimen < 0:
            raise ValueError(f"specimen must be 0 to 2^63 - 1, not {self.specimen}")
        if self.values is not None and (self.offset_v or self.specimen is not None):
            raise ValueError("offset_v and specimen are for what is drawn: with values nothing is")


@dataclass(frozen=True)
class CardDescription:
    """The ``[card]`` table. ``range_v`` gives the ends of each channel's range, by the channel's name."""

    range_v: Mapping[str, tuple[float, float]]
    bits: int = 12
    rate_hz: float = 20e3
    noise_lsb: float | Mapping[str, float] | None = None
    """Noise before quantisation, rms, on every channel or by channel name; by default the model's."""
    model: Literal["ideal", "dt2821", "skewed"] = "ideal"
    faults: Mapping[str, Any] = field(default_factory=dict)
    """Fields of ``analogrig_emulator.Card`` that differ from the model's: ``skew_s``, ``stuck_high``,
    ``clock_drift_ppm``, ..."""

    def __post_init__(self) -> None:
        known = {field.name for field in dataclasses.fields(Card)} - {"bits", "rate_hz", "ranges_v", "noise_lsb"}
        for fault in self.faults:
            if fault not in known:
                raise ValueError(f"faults: unknown key {fault!r} (known: {', '.join(sorted(known))})")
        self._faults()
        if set(self.range_v) != set(CHANNELS):
            raise ValueError(f"range_v must give the channels {', '.join(CHANNELS)}, not {', '.join(self.range_v)}")
        for name, (low, high) in self.range_v.items():
            if not -MOST_VOLTS <= low < high <= MOST_VOLTS or high - low < LEAST_SPAN_V:
                raise ValueError(
                    f"range_v.{name} must be (low, high) within +-{MOST_VOLTS:g} V, not ({low:g}, {high:g})"
                )
        config.check_range(self, "rate_hz", 1.0, MOST_RATE_HZ)
        if isinstance(self.noise_lsb, Mapping) and set(self.noise_lsb) != set(CHANNELS):
            raise ValueError(f"noise_lsb must give the channels {', '.join(CHANNELS)}, not {', '.join(self.noise_lsb)}")
        for noise_lsb in self._noises_lsb() or ():
            if not 0.0 <= noise_lsb <= MOST_NOISE_LSB:
                raise ValueError(f"noise_lsb must be 0 to {MOST_NOISE_LSB:g}, not {noise_lsb:g}")

    def _faults(self) -> dict[str, Any]:
        """``faults`` in the types of the card's fields.

        :raises ConfigurationError: one is of another type.
        """
        hints = typing.get_type_hints(Card)
        return {name: config.convert(hints[name], value, f"faults: {name}") for name, value in self.faults.items()}

    def _noises_lsb(self) -> tuple[float, ...] | None:
        """Noise of each channel in LSB; None if not given."""
        if isinstance(self.noise_lsb, Mapping):
            return tuple(self.noise_lsb[channel] for channel in CHANNELS)
        return None if self.noise_lsb is None else (self.noise_lsb,) * len(CHANNELS)

    def card(self) -> Card:
        """:raises SamplerError: a value is out of range."""
        model = CARDS[self.model]
        noises_lsb = self._noises_lsb()
        fields: dict[str, Any] = {
            "bits": self.bits,
            "rate_hz": self.rate_hz,
            "ranges_v": tuple(self.range_v[channel] for channel in CHANNELS),
            "noise_lsb": model.noise_lsb if noises_lsb is None else noises_lsb,
        }
        return dataclasses.replace(model, **(fields | self._faults()))


@dataclass(frozen=True)
class EmulatorDescription(RigDescription):
    """``fixtures/rigs/*.toml``, or a user's own file."""

    card: CardDescription
    kind: Literal["emulator"] = "emulator"
    computer: ComputerDescription = field(default_factory=ComputerDescription)
    description: str = ""
    name: str = ""

    def open(self, *, self_test: bool = True) -> EmulatorRig:  # noqa: ARG002 - for real rigs
        with emulator_errors():
            return EmulatorRig(self)


class Stream(enum.IntEnum):
    """Independent random streams of one seed: drawing more from one changes none of the others."""

    EXCITATION = 0
    COMPONENTS = 1
    CARD = 2
    APERTURE = 3
    NOISE = 4

    def generator(self, seed: int) -> np.random.Generator:
        return np.random.default_rng([seed, int(self)])


class SetUp(NamedTuple):
    """Computer, with the excitation and changes to play on it."""

    computer: SuspensionComputer
    excitation: Excitation
    changes: tuple[PotTurn, ...]


class _Prepared(NamedTuple):
    """Data that all plays of one scenario share, for every seed."""

    key: tuple[object, ...]
    """Parts of the scenario on which the data depend."""
    computer: SuspensionComputer
    play: RepeatedPlay | None
    """Repeated play; None where more than offsets and phase depends on the seed."""
    channels: Mapping[str, Channel]
    segments: tuple[Segment, ...]


class EmulatorRig(Rig):
    """The emulated analogue computer and its card."""

    capabilities = frozenset({"tweak", "excite"})
    computes_circuit = True

    def __init__(self, description: EmulatorDescription, block_samples: int = BLOCK_SAMPLES) -> None:
        """:raises EmulatorError: the card or the amplifiers cannot be."""
        self._description = description
        self._card = description.card.card()
        self._amplifier = preset(description.computer.op_amp)  # refused here, and not when it is first played
        self._last_prepared: _Prepared | None = None
        self._table = dataclasses.asdict(description)  # to write it takes as long as to play a thousand samples
        self._block_samples = block_samples

    def description(self) -> Mapping[str, Any]:
        return self._table

    def in_blocks(self, samples: int) -> EmulatorRig:
        """The same rig with blocks of at most ``samples`` samples. Only the speed differs.

        Data for a scenario that fits in one block are prepared once for all seeds.
        """
        return EmulatorRig(self._description, samples)

    def sampler(self, rng: np.random.Generator) -> Sampler:
        """Sampler of the rig's card with its own noise, to convert again what the circuit has played."""
        return Sampler(self._card, rng)

    def set_up(self, scenario: Scenario, seed: int) -> SetUp:
        """Machine as the scenario starts it, with the excitation and the changes to play on it.

        :raises ConfigurationError: the scenario cannot be played on this rig.
        """
        with emulator_errors(f"scenario {scenario.name}: "):
            computer = self._computer(scenario, seed)
            excitation = scenario.draw_excitation(Stream.EXCITATION.generator(seed))
        changes: list[PotTurn] = []
        for i, tweak in enumerate(scenario.tweaks):
            with emulator_errors(f"scenario {scenario.name}: tweaks[{i}] at sample {tweak.sample}: "):
                settings = self._pot_settings(settings_of(computer, tweak.overrides()), scenario.plant.set)
                computer.dials_for(**settings)  # refuses here what play() would, so that the tweak can be named
            changes.append(PotTurn(tweak.sample, settings, tweak.ramp_n))
        return SetUp(computer, excitation, tuple(changes))

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        if repeated := self._repeat(scenario, [seed]):
            return repeated[0]
        computer, excitation, changes = self.set_up(scenario, seed)
        with emulator_errors(f"scenario {scenario.name}: "):
            machine = self._description.computer.add_noise(computer, seed)
            jitter = Stream.APERTURE.generator(seed)
            volts = acquired(
                machine,
                self._card,
                excitation,
                scenario.samples,
                changes,
                rng=jitter,
                block_samples=self._block_samples,
            )
        return Performance(
            sample_period_s=1.0 / self._card.rate_hz,
            time_scale=computer.scales.time,
            channels=self._channels(computer),
            blocks=_sample(volts, self.sampler(Stream.CARD.generator(seed))),
            hindsight=lambda: Hindsight(
                scenario.segments(), _lit_lamps(computer.machine.lamps, probes_per_sample(self._card))
            ),
        )

    def perform_all(self, scenario: Scenario, seeds: Sequence[int]) -> list[Performance]:
        return self._repeat(scenario, seeds) or super().perform_all(scenario, seeds)

    def _prepare(self, scenario: Scenario, seed: int) -> _Prepared:
        """Prepared data of the scenario; the last set is reused for the same key."""
        key = (scenario.samples, scenario.plant, scenario.tweaks, scenario.excitation)
        if self._last_prepared is None or self._last_prepared.key != key:
            computer, excitation, changes = self.set_up(scenario, seed)
            with emulator_errors(f"scenario {scenario.name}: "):
                excitation.edges(0, 1, computer.sample_rate_hz)
                able = self._draws_offsets_alone and is_repeatable(computer, changes)
                play = RepeatedPlay(computer, scenario.samples, changes) if able else None
            self._last_prepared = _Prepared(key, computer, play, self._channels(computer), scenario.segments())
        return self._last_prepared

    @property
    def _draws_offsets_alone(self) -> bool:
        drawn, card = self._description.computer, self._card
        is_nominal = drawn.components == "nominal" and not drawn.wiper_noise_ohm and not drawn.noise
        is_nominal &= drawn.specimen is None and drawn.values is None
        is_on_time = probes_per_sample(card) == 1 and not ahead_ticks(card) and card.clock_drift_ppm == 0
        return is_nominal and is_on_time

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
                sample_period_s=1.0 / self._card.rate_hz,
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
        count, offset_v = prepared.computer.program.amplifiers, self._description.computer.offset_v
        generators = (Stream.COMPONENTS.generator(seed) for seed in seeds)
        offsets_v = np.stack([drawn_offsets_v(self._amplifier, count, rng, offset_v) for rng in generators])
        phases = np.array([scenario.draw_phase(Stream.EXCITATION.generator(seed)) for seed in seeds])
        with emulator_errors(as_error=RigError):
            for seed, (volts, lamps) in zip(seeds, play.play_all(scenario.excitation, phases, offsets_v), strict=True):
                codes, clipped = self.sampler(Stream.CARD.generator(seed)).sample(volts)
                yield Block(0, volts, codes, clipped), _lit_lamps(lamps, 1)

    def _computer(self, scenario: Scenario, seed: int) -> SuspensionComputer:
        rate_hz = self._card.true_rate_hz * probes_per_sample(self._card)
        computer = self._description.computer.machine(scenario.plant.set, seed, rate_hz)
        start = settings_of(computer, scenario.plant.overrides())
        computer.set(**self._pot_settings({**computer.program.values, **start}, scenario.plant.set))
        return computer

    def _pot_settings(self, settings: dict[str, float], program: str) -> dict[str, float]:
        """Pot settings for these parameters, as coefficients or as dials."""
        if self._description.computer.pots == "coefficient":
            return settings
        dials = _nominal(program).dials_for(**settings)
        return {f"{pot}_dial": dial for pot, dial in dials.items()}

    def _channels(self, computer: SuspensionComputer) -> dict[str, Channel]:
        return {
            name: Channel(
                low_v=self._card.ranges_v[i][0],
                lsb_v=float(self._card.lsb_v[i]),
                unit=CHANNEL_UNITS[name],
                unit_per_v=1.0 / computer.scales.volts(name),
                noise_lsb=self._card.noise_lsb[i],
                codes=1 << self._card.bits,
            )
            for i, name in enumerate(CHANNELS)
        }


def is_emulated(rig: Rig) -> TypeGuard[EmulatorRig]:
    """True for the emulated rig, the only one with a circuit, exact components and block sizes."""
    return rig.computes_circuit


def _lit_lamps(lamps: Mapping[str, int | None], probes: int) -> dict[str, int]:
    """Lit lamps, with the card's sample; the machine takes `probes` for each of those."""
    return {amplifier: -(-probe // probes) for amplifier, probe in lamps.items() if probe is not None}


def _sample(volts: Iterator[NDArray[np.float64]], sampler: Sampler) -> Iterator[Block]:
    first = 0
    with emulator_errors(as_error=RigError):
        for block in volts:
            codes, clipped = sampler.sample(block)
            yield Block(first, block, codes, clipped)
            first += len(block)


@contextlib.contextmanager
def emulator_errors(prefix: str = "", as_error: type[AnalogrigError] = ConfigurationError) -> Iterator[None]:
    """Convert errors of the emulator to errors of the harness; no other code does so."""
    try:
        yield
    except EmulatorError as error:
        raise as_error(f"{prefix}{error}") from error


@functools.cache
def _nominal(program: str) -> SuspensionComputer:
    """Nominal machine, used only to compute dials."""
    return SuspensionComputer(program, opamp="ideal")


def settings_of(computer: SuspensionComputer, given: Mapping[str, float]) -> dict[str, float]:
    """Parameter settings, renamed from the scenario's names to the program's."""
    names = {
        field.name: setting for field, setting in zip(dataclasses.fields(Plant), computer.program.values, strict=False)
    }
    return {names[name]: value for name, value in given.items()}
