"""Emulated analogue computer and its card, as a rig, and its description."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.errors import AnalogrigError, ConfigurationError, RigError
from analogrig.plant import Plant
from analogrig.program import Program
from analogrig.rigs.rig import BLOCK_SAMPLES, Block, Hindsight, Performance, Rig, RigDescription
from analogrig.run import OUTPUT, Channel
from analogrig.scenario import Scenario
from analogrig_emulator import (
    ABSOLUTE_ZERO_C,
    CARDS,
    COMPONENTS,
    FINE_OP_AMP_GRADES,
    MULTIPLIER_GRADES,
    MULTIPLIERS,
    OP_AMP_GRADES,
    Capacitor,
    Card,
    CircuitError,
    Components,
    Courses,
    EmulatorError,
    Excitation,
    NoisySuspension,
    NormalStream,
    OpAmp,
    OpAmpGrade,
    Pot,
    PotTurn,
    ProgramCircuit,
    Resistor,
    Sampler,
    Supply,
    SuspensionComputer,
    WideProgram,
    Wired,
    acquired,
    preset,
    probes_per_sample,
)

MOST_VOLTS, LEAST_SPAN_V, MOST_OFFSET_V, MOST_HUM_V = 1000.0, 1e-3, 1.0, 10.0
MOST_RATE_HZ, MOST_NOISE_LSB = 1e9, 1e5
MOST_DEVIATION = 0.9

CHANNEL_FIELDS = ("noise_lsb", "skew_s", "gain_error", "offset_lsb")
"""Fields of a card with one number for each channel, or none."""

WHOLE_RANGE_V = (-12.5, 12.5)
"""Range of the channels of programs that ``range_v`` does not name: what amplifiers can put out."""


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
        for table in ("deviation", "offset_v", "bandwidth", "slew"):
            most = MOST_OFFSET_V if table == "offset_v" else MOST_DEVIATION
            for name, value in getattr(self, table).items():
                if not abs(value) <= most:
                    raise ValueError(f"{table}.{name} must be within +-{most:g}, not {value:g}")

    def check_names(self, program: ProgramCircuit) -> None:
        """:raises CircuitError: a value is that of no element of the program."""
        for table in ("deviation", "offset_v", "bandwidth", "slew"):
            if given := getattr(self, table):
                kinds = (Resistor, Capacitor, Pot) if table == "deviation" else (OpAmp,)
                known = program.element_names(*kinds)
                if unknown := [name for name in given if name not in known]:
                    raise CircuitError(f"values: {table}: unknown key {unknown[0]!r} (known: {', '.join(known)})")

    def put_in(self, stock: Components) -> Components:
        """Components of the machine: the stock's, overridden by the measured values."""
        given = {**self.deviation, **self.offset_v}
        return dataclasses.replace(
            stock.without_draws(), given=given, given_bandwidth=self.bandwidth, given_slew=self.slew
        )


@dataclass(frozen=True)
class ComputerDescription:
    """The ``[computer]`` table: components of the machine, its temperature and its age."""

    op_amp: str = "tl07x"
    offset_v: float = 0.0
    """Each amplifier's input offset is drawn from the seed, within plus and minus this."""
    components: Literal["nominal", "polyester", "polypropylene"] = "nominal"
    """Kind of components. Real ones are drawn from the seed, as are the grades of amplifiers (offset, drift, bias,
    bandwidth) and multipliers (scale error, offsets, non-linearity)."""
    multiplier: Literal["ideal", "ad633"] | None = None
    """Bandwidth, slew rate, swing and noise of the multipliers. Default: ``ad633`` with real components, ``ideal`` with
    nominal ones."""
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
    fine_effects: bool = False
    """Also the effects of the amplifiers that are below 0.1 LSB on the suspension: 1/f noise, and for real components
    input capacitance, common mode and limit of the output current. A play takes up to three times as long."""
    supply_hum_v: float = 0.0
    """Amplitude of a sine of 100 Hz on the amplifiers' supply, of which their rejection lets a part through."""

    @property
    def _grades(self) -> Mapping[str, OpAmpGrade]:
        return FINE_OP_AMP_GRADES if self.fine_effects else OP_AMP_GRADES

    @property
    def multiplier_name(self) -> str:
        """Name of the multipliers' model and grade."""
        return self.multiplier or ("ideal" if self.components == "nominal" else "ad633")

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
        if self.components != "nominal":
            op_amps = self._grades.get(self.op_amp, stock.op_amps)
            stock = dataclasses.replace(stock, op_amps=op_amps, multipliers=MULTIPLIER_GRADES[self.multiplier_name])
        return stock if self.values is None else self.values.put_in(stock)

    def machine(self, program: ProgramCircuit, seed: int, sample_rate_hz: float) -> SuspensionComputer:
        """Machine drawn from the seed of a run, wired as a program, with the program's pots.

        :raises EmulatorError: it cannot be.
        """
        specimen = seed if self.specimen is None else self.specimen
        if self.values is not None:
            self.values.check_names(program)
        return SuspensionComputer(
            program,
            opamp=preset(self.op_amp),
            multiplier=MULTIPLIERS[self.multiplier_name],
            rng=Stream.COMPONENTS.generator(specimen),
            offset_v=self.offset_v,
            components=self.components_for(specimen),
            sample_rate_hz=sample_rate_hz,
        )

    def add_noise(self, computer: SuspensionComputer, seed: int) -> SuspensionComputer | NoisySuspension:
        """The machine, with the noise of its components and the hum of its supply if they are described."""
        if not (self.noise or self.supply_hum_v):
            return computer
        grade, temperature_c = self._grades.get(self.op_amp, OpAmpGrade()), self.temperature_c
        if not self.noise:
            grade, temperature_c = OpAmpGrade(psrr=grade.psrr), ABSOLUTE_ZERO_C
        rng, supply = Stream.NOISE.generator(seed), Supply(self.supply_hum_v)
        return NoisySuspension(computer, rng, op_amps=grade, temperature_c=temperature_c, supply=supply)

    def __post_init__(self) -> None:
        config.check_range(self, "offset_v", 0.0, MOST_OFFSET_V)
        config.check_range(self, "supply_hum_v", 0.0, MOST_HUM_V)
        if self.specimen is not None and self.specimen < 0:
            raise ValueError(f"specimen must be 0 to 2^63 - 1, not {self.specimen}")
        if self.values is not None and (self.offset_v or self.specimen is not None):
            raise ValueError("offset_v and specimen are for what is drawn: with values nothing is")


@dataclass(frozen=True)
class CardDescription:
    """The ``[card]`` table.

    ``range_v`` gives the ends of a channel's range, by the channel's name; WHOLE_RANGE_V if it is not named.
    """

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
        for name, (low, high) in self.range_v.items():
            if not -MOST_VOLTS <= low < high <= MOST_VOLTS or high - low < LEAST_SPAN_V:
                raise ValueError(
                    f"range_v.{name} must be (low, high) within +-{MOST_VOLTS:g} V, not ({low:g}, {high:g})"
                )
        config.check_range(self, "rate_hz", 1.0, MOST_RATE_HZ)
        given = self.noise_lsb
        if isinstance(given, Mapping) and set(given) != set(self.range_v):
            raise ValueError(f"noise_lsb must give the channels {', '.join(self.range_v)}, not {', '.join(given)}")
        for noise_lsb in given.values() if isinstance(given, Mapping) else () if given is None else (given,):
            if not 0.0 <= noise_lsb <= MOST_NOISE_LSB:
                raise ValueError(f"noise_lsb must be 0 to {MOST_NOISE_LSB:g}, not {noise_lsb:g}")

    def _faults(self) -> dict[str, Any]:
        """``faults`` in the types of the card's fields.

        :raises ConfigurationError: one is of another type.
        """
        hints = typing.get_type_hints(Card) if self.faults else {}  # evaluating them takes a millisecond
        return {name: config.convert(hints[name], value, f"faults: {name}") for name, value in self.faults.items()}

    def card(self, channels: Sequence[str]) -> Card:
        """Card with these channels.

        :raises SamplerError: a value is out of range.
        """
        model, given = CARDS[self.model], self.noise_lsb
        fields: dict[str, Any] = {name: getattr(model, name) for name in CHANNEL_FIELDS}
        if isinstance(given, Mapping):
            fields["noise_lsb"] = tuple(given.get(channel, max(given.values())) for channel in channels)
        elif given is not None:
            fields["noise_lsb"] = (given,) * len(channels)
        fields |= self._faults()
        fields |= {name: fields[name][: len(channels)] for name in CHANNEL_FIELDS}
        ranges_v = tuple(self.range_v.get(channel, WHOLE_RANGE_V) for channel in channels)
        return dataclasses.replace(model, bits=self.bits, rate_hz=self.rate_hz, ranges_v=ranges_v, **fields)


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


class EmulatorRig(Rig):
    """The emulated analogue computer and its card."""

    capabilities = frozenset({"change", "excite"})
    computes_circuit = True

    def __init__(self, description: EmulatorDescription, block_samples: int = BLOCK_SAMPLES) -> None:
        """:raises EmulatorError: the card or the amplifiers cannot be."""
        self.described = description
        description.card.card(
            tuple(description.card.range_v) or ("input",)
        )  # refused here, and not when it is first played
        self.amplifier = preset(description.computer.op_amp)  # refused here, and not when it is first played
        self._cards: dict[tuple[str, ...], Card] = {}
        self._block_samples = block_samples

    def description(self) -> Mapping[str, Any]:
        return self._table

    @functools.cached_property
    def _table(self) -> Mapping[str, Any]:
        return dataclasses.asdict(self.described)  # to write it takes as long as to play a thousand samples

    def card(self, program: Program) -> Card:
        """Card with the channels of a program."""
        if program.channels not in self._cards:
            self._cards[program.channels] = self.described.card.card(program.channels)
        return self._cards[program.channels]

    def set_up(self, scenario: Scenario, seed: int) -> SetUp:
        """Machine as the scenario starts it, with the excitation and the changes to play on it.

        :raises ConfigurationError: the scenario cannot be played on this rig.
        """
        with emulator_errors(f"scenario {scenario.name}: "):
            card, program = self.card(scenario.program), scenario.program
            rate_hz = card.true_rate_hz * probes_per_sample(card)
            computer = drawn_machine(self.described.computer, program.circuit, seed, rate_hz, anew=True)
            computer.set(**self.pot_settings(scenario.plant, program.parameters))
            excitation = scenario.draw_excitation(Stream.EXCITATION.generator(seed))
        changes: list[PotTurn] = []
        plant = scenario.plant
        for i, change in enumerate(scenario.changes):
            plant = plant.changed(change.set)
            with emulator_errors(f"scenario {scenario.name}: changes[{i}] at sample {change.sample}: "):
                settings = self.pot_settings(plant, change.set)
                computer.dials_for(**settings)  # refuses here what play() would, so that the change can be named
            changes.append(PotTurn(change.sample, settings, change.ramp_n))
        return SetUp(computer, excitation, tuple(changes))

    def courses(self, scenario: Scenario, seed: int, samples: int) -> Courses:
        """Noise-free courses of the output on the machine of a play, for so many samples.

        :raises EmulatorError: the machine cannot be, or not play the excitation.
        """
        program, card = scenario.program, self.card(scenario.program)
        rate_hz = card.true_rate_hz * probes_per_sample(card)

        def wired(gain: float) -> Wired:
            machine = drawn_machine(self.described.computer, _with_gain(program, gain), seed, rate_hz)
            is_digital = self.described.computer.pots == "dial"
            return Wired(machine, nominal_machine(program, gain) if is_digital else machine)

        excitation = scenario.draw_excitation(Stream.EXCITATION.generator(seed))
        return Courses(wired, card, excitation, samples, OUTPUT)

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        computer, excitation, changes = self.set_up(scenario, seed)
        card = self.card(scenario.program)
        with emulator_errors(f"scenario {scenario.name}: "):
            machine = self.described.computer.add_noise(computer, seed)
            jitter = Stream.APERTURE.generator(seed)
            volts = acquired(
                machine,
                card,
                excitation,
                scenario.samples,
                changes,
                rng=jitter,
                block_samples=self._block_samples,
            )
        return Performance(
            sample_period_s=1.0 / card.rate_hz,
            time_scale=computer.scales.time,
            channels=channels_of(card, computer, scenario.program),
            blocks=sampled(volts, Sampler(card, NormalStream(seed, Stream.CARD))),
            hindsight=lambda: Hindsight(
                scenario.segments(), lit_lamps(computer.machine.lamps, probes_per_sample(card))
            ),
        )

    def pot_settings(self, plant: Plant, changed: Iterable[str]) -> dict[str, float]:
        """Pot settings for a plant in which these parameters have changed, as coefficients or as dials.

        :raises PotError: a pot cannot show them.
        """
        names = {plant.program.names[name] for name in changed}
        values = plant.parameters()
        if self.described.computer.pots == "coefficient":
            return {name: value for name, value in values.items() if name in names}
        dials = nominal_machine(plant.program).dials_for(**values)
        pots = plant.program.circuit.pots
        return {f"{pot}_dial": dial for pot, dial in dials.items() if names.intersection(pots[pot].settings)}


def channels_of(card: Card, computer: SuspensionComputer, program: Program) -> dict[str, Channel]:
    """Channels of the card by name, with their ranges, units and gains."""
    return {
        name: Channel(
            low_v=card.ranges_v[i][0],
            lsb_v=float(card.lsb_v[i]),
            unit=program.unit(name),
            unit_per_v=1.0 / computer.scales.volts(name),
            noise_lsb=card.noise_lsb[i],
            codes=1 << card.bits,
        )
        for i, name in enumerate(program.channels)
    }


def is_emulated(rig: Rig) -> TypeGuard[EmulatorRig]:
    """True for the emulated rig, the only one with a circuit, exact components and block sizes."""
    return rig.computes_circuit


def lit_lamps(lamps: Mapping[str, int | None], probes: int) -> dict[str, int]:
    """Lit lamps, with the card's sample; the machine takes `probes` for each of those."""
    return {amplifier: -(-probe // probes) for amplifier, probe in lamps.items() if probe is not None}


def sampled(volts: Iterator[NDArray[np.float64]], sampler: Sampler) -> Iterator[Block]:
    """Blocks of a card from the volts of a machine.

    :raises RigError: the machine cannot play on.
    """
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


_last_machine: tuple[tuple[object, ...], SuspensionComputer] | None = None
"""Machine drawn last, with what it was drawn from."""


def drawn_machine(
    computer: ComputerDescription, program: ProgramCircuit, seed: int, rate_hz: float, *, anew: bool = False
) -> SuspensionComputer:
    """Machine of a seed; the last one unless ``anew``. Courses leave a machine as it is, and drawing takes long."""
    global _last_machine  # noqa: PLW0603 - a cache of one entry
    key, last = (computer, program, seed, rate_hz), _last_machine
    if anew or last is None or last[0] != key:
        last = _last_machine = key, computer.machine(program, seed, rate_hz)  # another thread may draw at this time
    return last[1]


@functools.lru_cache(maxsize=8)
def nominal_machine(program: Program, gain: float = 1.0) -> SuspensionComputer:
    """Nominal machine, used only to compute dials."""
    return SuspensionComputer(_with_gain(program, gain), opamp="ideal")


def _with_gain(program: Program, gain: float) -> ProgramCircuit:
    """Circuit whose pots feed inputs of so many times the gain."""
    return program.circuit if gain == 1.0 else WideProgram(program.circuit, gain)
