"""Simulated instrument: a Red Pitaya STEMlab 125-14 behind its SCPI server, with a box of digital pots beside it.

Generator and acquisition of two channels follow https://redpitaya.readthedocs.io (SCPI commands, OS 2.0). The rate is
125 MHz divided by a decimation. Records have 16,384 samples, with the trigger in their middle plus a delay. Ranges are
+-1 V (LV) or +-20 V (HV) on 14 bits. Numbers come in braces, or as float32 and int16 in a block, most significant byte
first unless ACQ:DATA:BYTE:ORDER LEND is set. Unknown commands are refused; a real instrument has many more.

    GEN:RST  ACQ:RST  SOUR1:FUNC SQUARE  SOUR1:FREQ:FIX 100  SOUR1:VOLT .5  SOUR1:VOLT:OFFS .5  ACQ:DEC:Factor 6250
    ACQ:AVG ON  ACQ:DATA:Units VOLTS  ACQ:DATA:FORMAT ASCII  ACQ:SOUR1:GAIN HV  ACQ:TRig:DLY 8192  ACQ:START
    ACQ:TRig AWG_PE  OUTPUT1:STATE ON  SOUR1:TRig:INT  ACQ:TRig:STAT?  ACQ:TRig:FILL?  ACQ:SOUR1:DATA?

Pots have the numbers of their places in POT:CATalog?:

    POT:CATalog?                     names of the pots
    POT<n>:DIAL 0.25    POT<n>:DIAL?    set a pot at once; its position, 0 to 1
    POT:SCHedule <n>,<dial>,<s>      set it this long after each SOUR1:TRig:INT; at most 64 entries
    POT:SCHedule:CLEar    POT:SCHedule:COUNt?
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Program
from analogrig.config import build, locate, read_toml
from analogrig.links import Clock
from analogrig.rigs import EmulatorDescription, Stream, emulator_errors
from analogrig_emulator import CHANNELS, Card, EmulatorError, Excitation, SuspensionComputer
from analogrig_instruments.instrument import DialChange
from analogrig_instruments.simulator.acquisition_buffer import (
    BUFFER_N,
    CLOCK_HZ,
    LEAST_DECIMATION,
    LEAST_DELAY_N,
    MOST_DECIMATION,
    MOST_DELAY_N,
    TRIGGERS,
    Acquisition,
    AcquisitionFaults,
)
from analogrig_instruments.simulator.analogue_inputs import RANGES_V, Codes, InputFaults, Inputs
from analogrig_instruments.simulator.computer import MEASURED_AT, WiredComputer, Wiring
from analogrig_instruments.simulator.scpi import HERTZ, VOLTS, Call, Command, DropOut, Response, ScpiError

MOST_SCHEDULED = 64
MOST_DELAY_S = 1e4
MOST_OUTPUT_V = 1.0
MOST_LEVEL_V = max(RANGES_V.values())
_ROUNDING_V = 1e-9
_ORDERS = {"BEND": ">", "LEND": "<"}
_IDENTITY = "analogrig,emulated STEMlab 125-14,0,0"

Keys = dict[str, Any]

_ON_BOTH = {"noise_lsb", "gain_error", "offset_lsb", "skew_s", "clock_drift_ppm"}
_OF_THE_CARD = {"bits", "rate_hz", "ranges_v", "throughput_hz"}

Commands = dict[str, tuple[int, Command]]
"""By pattern: the largest number of arguments, and the action."""


def _number(low: float, high: float, suffixes: Mapping[str, float] | None = None) -> Callable[[Call], float]:
    return lambda call: call.number(0, low, high, suffixes)


def _word(*allowed: str) -> Callable[[Call], str]:
    return lambda call: call.word(0, allowed)


_Settings = tuple[tuple[str, str, Callable[[Call], Any]], ...]
"""Pattern, field of the dataclass, and the value of an argument."""

_GENERATOR_SETTINGS: _Settings = (
    ("OUTPUT#:STATE", "on", lambda call: call.switch(0)),
    ("SOUR#:FUNC", "shape", _word("SQUARE", "PWM", "DC")),
    ("SOUR#:FREQ[:FIX]", "frequency_hz", _number(1e-3, 1e6, HERTZ)),
    ("SOUR#:VOLT", "amplitude_v", _number(0.0, MOST_OUTPUT_V, VOLTS)),
    ("SOUR#:VOLT:OFFS", "offset_v", _number(-MOST_OUTPUT_V, MOST_OUTPUT_V, VOLTS)),
    ("SOUR#:PHAS", "phase_deg", _number(-360.0, 360.0)),
    ("SOUR#:DCYC", "duty", _number(0.001, 0.999)),
)

_ACQUISITION_SETTINGS: _Settings = (
    ("ACQ:DEC[:Factor]", "decimation", lambda call: call.whole(0, LEAST_DECIMATION, MOST_DECIMATION)),
    ("ACQ:AVG", "averages", lambda call: call.switch(0)),
    ("ACQ:TRig:LEV", "level_v", _number(-MOST_LEVEL_V, MOST_LEVEL_V, VOLTS)),
    ("ACQ:TRig:DLY", "delay_n", lambda call: call.whole(0, LEAST_DELAY_N, MOST_DELAY_N)),
    ("ACQ:DATA:Units", "units", _word("VOLTS", "RAW")),
    ("ACQ:DATA:FORMAT", "form", _word("ASCII", "BIN")),
    ("ACQ:DATA:BYTE:ORDER", "order", _word(*_ORDERS)),
)


@dataclass(frozen=True)
class InstrumentDescription:
    """Table ``[instrument]`` of a served rig: its leads and its faults, none by default."""

    wiring: Wiring = field(default_factory=Wiring)
    inputs: InputFaults = field(default_factory=InputFaults)
    acquisition: AcquisitionFaults = field(default_factory=AcquisitionFaults)


@dataclass(frozen=True)
class Generator:
    """Settings of the generator, with the values after GEN:RST."""

    shape: str = "SQUARE"
    frequency_hz: float = 1000.0
    amplitude_v: float = 1.0
    """Half the distance between the two levels."""
    offset_v: float = 0.0
    phase_deg: float = 0.0
    duty: float = 0.5
    """Duty cycle of the shape PWM."""
    on: bool = False

    def waveform(self) -> Excitation:
        """Waveform of the generator once it is triggered.

        :raises ScpiError: it exceeds the range of the output.
        """
        low_v, high_v = self.offset_v - self.amplitude_v, self.offset_v + self.amplitude_v
        if max(-low_v, high_v) > MOST_OUTPUT_V + _ROUNDING_V:
            raise ScpiError(-221, f"{low_v:g} V to {high_v:g} V exceeds +-{MOST_OUTPUT_V:g} V")
        if not self.on:
            low_v = high_v = 0.0
        elif self.shape == "DC":
            low_v = high_v
        shape, duty = ("pulse", self.duty) if self.shape == "PWM" else ("square", 0.5)
        phase = self.phase_deg / 360.0 % 1.0 % 1.0
        return Excitation(shape, low_v, high_v, self.frequency_hz, phase, duty, clock="free")


class ServedRedPitaya:
    """Instrument with a computer in operation. All clients share its state."""

    def __init__(
        self,
        make: Callable[[float], SuspensionComputer],
        rng: np.random.Generator,
        description: InstrumentDescription | None = None,
        clock: Clock | None = None,
    ) -> None:
        """``make`` returns the machine for a rate in Hz; ``rng`` draws the noise of the inputs.

        With a ``clock`` a record takes its real time, and a pot set meanwhile changes within the record.

        :raises EmulatorError: the computer cannot be made.
        """
        described = description or InstrumentDescription()
        self._computer = WiredComputer(make, described.wiring)
        self._acquisition = Acquisition(Inputs(self._computer, described.inputs, rng), described.acquisition, clock)
        self._generator = Generator()
        self._pots = tuple(self._computer.dials)
        self._scheduled: list[DialChange] = []

    @property
    def live(self) -> bool:
        """True if the generator's output is on."""
        return self._generator.on

    def silence(self) -> None:
        """Switch the output off."""
        self._generator = replace(self._generator, on=False)
        self._computer.silence()

    @property
    def commands(self) -> Commands:
        acquisition, scheduled = self._acquisition, self._scheduled
        commands: Commands = {
            "*IDN?": (0, lambda _: _IDENTITY),
            "*OPC?": (0, lambda _: "1"),
            "*RST": (0, lambda _: self._reset()),
            "GEN:RST": (0, lambda _: self._reset_generator()),
            "SOUR#:TRig:INT": (0, self._trigger_generator),
            "ACQ:RST": (0, lambda _: acquisition.reset()),
            "ACQ:START": (0, lambda _: acquisition.start()),
            "ACQ:STOP": (0, lambda _: acquisition.stop()),
            "ACQ:TRig": (1, lambda call: acquisition.arm(call.word(0, TRIGGERS))),
            "ACQ:TRig:STAT?": (0, lambda _: self._trigger_state()),
            "ACQ:TRig:FILL?": (0, lambda _: self._fill_state()),
            "ACQ:BUF:SIZE?": (0, lambda _: str(BUFFER_N)),
            "ACQ:SRATe?": (0, lambda _: f"{_show(CLOCK_HZ / acquisition.settings.decimation)} Hz"),
            "ACQ:SOUR#:GAIN": (1, self._set_range),
            "ACQ:SOUR#:GAIN?": (0, lambda call: acquisition.settings.switches[_channel(call)]),
            "ACQ:SOUR#:DATA?": (0, lambda call: self._data(call, slice(None))),
            "ACQ:SOUR#:DATA:STArt:N?": (2, self._part_of_data),
            "ACQ:SOUR#:DATA:Old:N?": (1, lambda call: self._data(call, slice(call.whole(0, 1, BUFFER_N)))),
            "ACQ:SOUR#:DATA:LATest:N?": (1, lambda call: self._data(call, slice(-call.whole(0, 1, BUFFER_N), None))),
            "POT:CATalog?": (0, lambda _: ",".join(self._pots)),
            "POT#:DIAL": (1, self._turn),
            "POT#:DIAL?": (0, lambda call: _show(self._computer.dials[self._pot(call.numbers[0])])),
            "POT:SCHedule": (3, self._schedule),
            "POT:SCHedule:CLEar": (0, lambda _: scheduled.clear()),
            "POT:SCHedule:COUNt?": (0, lambda _: str(len(scheduled))),
        }
        for pattern, name, parse in _GENERATOR_SETTINGS:
            commands |= _setting(pattern, name, self._output, self._set_generator, parse)
        for pattern, name, parse in _ACQUISITION_SETTINGS:
            commands |= _setting(pattern, name, lambda _: acquisition.settings, acquisition.change, parse)
        return {pattern: (most, functools.partial(_run, command)) for pattern, (most, command) in commands.items()}

    def _reset(self) -> None:
        self._reset_generator()
        self._acquisition.reset()
        self._scheduled.clear()

    # ---- generator

    def _output(self, call: Call) -> Generator:
        if call.numbers[0] != 1:
            raise ScpiError(-114, "only OUT1 is wired")
        return self._generator

    def _set_generator(self, changed: Generator) -> None:
        """Change settings; a running generator continues with them from the beginning of a period."""
        waveform = changed.waveform()
        if self._computer.generates:
            self._computer.generate(waveform)
        self._generator = changed

    def _trigger_generator(self, call: Call) -> None:
        self._computer.generate(self._output(call).waveform())
        self._computer.schedule(self._scheduled)
        self._acquisition.notice_generator_start()

    def _reset_generator(self) -> None:
        self._generator = Generator()
        self._computer.silence()

    # ---- acquisition

    def _set_range(self, call: Call) -> None:
        settings = self._acquisition.settings
        switches = list(settings.switches)
        switches[_channel(call)] = call.word(0, tuple(RANGES_V))
        self._acquisition.change(replace(settings, switches=tuple(switches)))

    def _trigger_state(self) -> str:
        self._acquisition.wait()
        return "TD" if self._acquisition.triggered else "WAIT"

    def _fill_state(self) -> str:
        self._acquisition.wait()
        return str(int(self._acquisition.filled))

    def _part_of_data(self, call: Call) -> Response:
        first, count = call.whole(0, 0, BUFFER_N - 1), call.whole(1, 1, BUFFER_N)
        if first + count > BUFFER_N:
            raise ScpiError(-222, f"{first} + {count} exceeds the buffer of {BUFFER_N}")
        return self._data(call, slice(first, first + count))

    def _data(self, call: Call, part: slice) -> Response:
        """Samples of the record, in the chosen units and format."""
        channel, record = _channel(call), self._acquisition.record
        if record is None:
            raise ScpiError(-230, "no record is complete")
        data = self._format(record.codes[part, channel], record.lsb_v[channel])
        if drop_out := self._acquisition.drop_out():
            raise DropOut(data, hangs_up=drop_out == "hang up")
        return data

    def _format(self, codes: Codes, lsb_v: float) -> str | bytes:
        settings = self._acquisition.settings
        order, binary = _ORDERS[settings.order], settings.form == "BIN"
        if settings.units == "RAW":
            return codes.astype(f"{order}i2").tobytes() if binary else _braces(map(str, codes.tolist()))
        volts: NDArray[np.float64] = codes.astype(np.float64) * lsb_v
        return volts.astype(f"{order}f4").tobytes() if binary else _braces(f"{v:.6g}" for v in volts.tolist())

    # ---- pots

    def _pot(self, number: int) -> str:
        if not 1 <= number <= len(self._pots):
            raise ScpiError(-114, f"the pots are 1 to {len(self._pots)}")
        return self._pots[number - 1]

    def _turn(self, call: Call) -> None:
        """Set a pot now; samples that are due by now are taken before."""
        pot, dial = self._pot(call.numbers[0]), call.number(0, 0.0, 1.0)
        if self._acquisition.triggered:
            self._acquisition.wait()
        self._computer.turn(pot, dial)

    def _schedule(self, call: Call) -> None:
        if len(self._scheduled) == MOST_SCHEDULED:
            raise ScpiError(-223, f"at most {MOST_SCHEDULED} changes can be scheduled")
        pot = self._pots[call.whole(0, 1, len(self._pots)) - 1]
        self._scheduled.append(DialChange(call.number(2, 0.0, MOST_DELAY_S), pot, call.number(1, 0.0, 1.0)))


def _setting(
    pattern: str, name: str, get: Callable[[Call], Any], put: Callable[[Any], None], parse: Callable[[Call], Any]
) -> Commands:
    """Commands that set and query the field ``name`` of a dataclass, which ``get`` returns and ``put`` stores."""
    return {
        pattern: (1, lambda call: put(replace(get(call), **{name: parse(call)}))),
        f"{pattern}?": (0, lambda call: _show(getattr(get(call), name))),
    }


def _show(value: object) -> str:
    if isinstance(value, bool):
        return "ON" if value else "OFF"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _run(command: Command, call: Call) -> Response:
    """Run a command; convert errors of the emulator to those of the instrument."""
    try:
        return command(call)
    except EmulatorError as error:
        raise ScpiError(-221, str(error).replace('"', "'")) from error


def _channel(call: Call) -> int:
    if not 1 <= call.numbers[0] <= 2:
        raise ScpiError(-114, "the inputs are IN1 and IN2")
    return call.numbers[0] - 1


def _braces(numbers: Iterable[str]) -> str:
    return "{" + ",".join(numbers) + "}"


@dataclass(frozen=True)
class ServedDescription(EmulatorDescription):
    """Description of an emulated rig and of the instrument at its connectors."""

    instrument: InstrumentDescription = field(default_factory=InstrumentDescription)

    @classmethod
    def load(cls, name: str, defects: Sequence[str] = ()) -> ServedDescription:
        """Load a shipped rig or a .toml file, and add ``defects``, lines of TOML, to its table ``[instrument]``.

        :raises ConfigurationError: it does not exist, or is wrong.
        """
        path = locate("rigs", name)
        table: Keys = {"name": path.stem, **read_toml(path)}
        for defect in defects:
            table = merge(table, {"instrument": parse_defect(defect)})
        return build(cls, table, str(path))

    def set_up(self, program: Program, seed: int, clock: Clock | None = None) -> ServedRedPitaya:
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
                lambda rate_hz: self.computer.machine(program.circuit, seed, rate_hz),
                Stream.CARD.generator(seed),
                described,
                clock,
            )

    def combined_instrument(self) -> InstrumentDescription:
        """The instrument with the faults of the card, where it can have them, in addition to its own.

        :raises ValueError: together they are too large.
        """
        card, own, acquisition = self.card.card(CHANNELS), self.instrument.inputs, self.instrument.acquisition
        measured = list(MEASURED_AT)
        gain_error, skew_s = card.per_channel("gain_error")[measured], card.per_channel("skew_s")[measured]
        offset_v, noise_v = ((card.per_channel(name) * card.lsb_v)[measured] for name in ("offset_lsb", "noise_lsb"))
        inputs = replace(
            own,
            noise_v=_pair(np.hypot(own.noise_v, noise_v)),
            gain_error=_pair(own.gain_error + gain_error),
            offset_v=_pair(own.offset_v + offset_v),
            skew_s=own.skew_s + float(skew_s[1] - skew_s[0]),
        )
        acquisition = replace(acquisition, clock_ppm=acquisition.clock_ppm + card.clock_drift_ppm)
        return replace(self.instrument, inputs=inputs, acquisition=acquisition)

    @property
    def unsupported(self) -> tuple[str, ...]:
        """Keys of the description that the served instrument does not simulate."""
        card = self.card.card(CHANNELS)
        others = [each for each in fields(Card) if each.name not in _ON_BOTH | _OF_THE_CARD]
        of_card = tuple(f"card.{each.name}" for each in others if getattr(card, each.name) != each.default)
        of_computer = [f"computer.{key}" for key in ("noise", "supply_hum_v") if getattr(self.computer, key)]
        return (*of_card, *of_computer)


def _pair(values: NDArray[np.float64]) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def parse_defect(defect: str) -> Keys:
    """Keys of a line of TOML.

    :raises ConfigurationError: it is none.
    """
    try:
        return tomllib.loads(defect)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(
            f"--defect {defect[:80]}: {error}; it is a line of TOML such as wiring.swapped=true"
        ) from error


def merge(table: Keys, more: Keys) -> Keys:
    """The table with the keys of another; nested tables are merged likewise."""
    out = dict(table)
    for key, value in more.items():
        both = isinstance(value, dict) and isinstance(out.get(key), dict)
        out[key] = merge(out[key], value) if both else value
    return out
