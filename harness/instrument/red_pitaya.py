"""The instrument: a Red Pitaya STEMlab 125-14 as its SCPI server shows it, with a box of digital pots beside it.

Generator and acquisition of two channels, after https://redpitaya.readthedocs.io (SCPI commands, OS 2.0). What is here
behaves as there: 125 MHz through a decimation, records of 16,384 samples with the trigger in their middle plus a delay,
+-1 V (LV) or +-20 V (HV) on 14 bits, numbers in braces or as big-endian float32 and int16 in a block. Commands that it
does not have are refused; a real one has many more.

    GEN:RST  ACQ:RST  SOUR1:FUNC SQUARE  SOUR1:FREQ:FIX 100  SOUR1:VOLT .5  SOUR1:VOLT:OFFS .5  ACQ:DEC:Factor 6250
    ACQ:AVG ON  ACQ:DATA:Units VOLTS  ACQ:DATA:FORMAT ASCII  ACQ:SOUR1:GAIN HV  ACQ:TRig:DLY 8192  ACQ:START
    ACQ:TRig AWG_PE  OUTPUT1:STATE ON  SOUR1:TRig:INT  ACQ:TRig:STAT?  ACQ:TRig:FILL?  ACQ:SOUR1:DATA?

The pots are numbered as POT:CATalog? lists them:

    POT:CATalog?                     their names
    POT<n>:DIAL 0.25    POT<n>:DIAL?    turn one at once; where it stands, 0 to 1
    POT:SCHedule <n>,<dial>,<s>      turn it so long after each SOUR1:TRig:INT; up to 64 of them
    POT:SCHedule:CLEar    POT:SCHedule:COUNt?
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from emulator.excitation import Excitation
from emulator.sampler import Card, Sampler
from harness.instrument.scpi import Call, Command, ScpiError, conflict, out_of_range
from harness.instrument.table import Table, Turn

CLOCK_HZ = 125_000_000
BUFFER_N = 16_384
MIDDLE_N = BUFFER_N // 2
BITS = 14
RANGES_V = {"LV": 1.0, "HV": 20.0}
MOST_VOLTS = 1.0
"""Of the generator's output, either way."""
LEAST_DECIMATION, MOST_DECIMATION = 125, 65_536
"""A real one goes down to 1; the computer's slowest amplifier needs no more than a sample a microsecond."""
MOST_SCHEDULED = 64
LOOKS_PER_SAMPLE = 8
"""The computer is looked at so often while the instrument averages over one of its samples."""
PAUSE_N = 2000
"""Samples that go by, unseen, between the end of a record and the next ACQ:START."""
PATIENCE_N = 10 * BUFFER_N
"""So long a level is waited for. A real instrument waits for ever, in a time that we do not have."""

_SHAPES = ("SQUARE", "PWM", "DC")
_TRIGGERS = ("DISABLED", "NOW", "CH1_PE", "CH1_NE", "CH2_PE", "CH2_NE", "AWG_PE")


class _State(enum.Enum):
    IDLE = "idle"
    ARMED = "started, and waiting for its trigger"
    TRIGGERED = "a record is there"


@dataclass(frozen=True)
class Defects:
    """What instruments of this kind are known for; none by default."""

    noise_lsb: tuple[float, float] = (0.5, 0.5)
    gain_error: tuple[float, float] = (0.0, 0.0)
    offset_lsb: tuple[float, float] = (0.0, 0.0)
    late_looks: int = 0
    """By so many eighths of a sample IN2 is late: the channels of OS 2.05 are not synchronous."""
    half_filled: bool = False
    """A record ends in the middle, and the rest of the buffer holds zeros."""


@dataclass
class _Generator:
    shape: str = "SQUARE"
    frequency_hz: float = 1000.0
    amplitude_v: float = 1.0
    offset_v: float = 0.0
    phase_deg: float = 0.0
    duty: float = 0.5
    on: bool = False

    def waveform(self) -> Excitation:
        """:raises ScpiError: it would leave the range of the output."""
        low_v, high_v = self.offset_v - self.amplitude_v, self.offset_v + self.amplitude_v
        if max(abs(low_v), abs(high_v)) > MOST_VOLTS + 1e-9:
            raise conflict(f"{low_v:g} V to {high_v:g} V leaves +-{MOST_VOLTS:g} V")
        if not self.on:
            low_v = high_v = 0.0
        elif self.shape == "DC":
            low_v = high_v = self.offset_v
        shape, duty = ("pulse", self.duty) if self.shape == "PWM" else ("square", 0.5)
        phase = (self.phase_deg / 360.0) % 1.0
        return Excitation(shape, low_v, high_v, self.frequency_hz, phase, duty, clock="free")


@dataclass
class _Acquisition:
    decimation: int = 6250
    averages: bool = True
    delay_n: int = 0
    level_v: float = 0.0
    gains: list[str] = field(default_factory=lambda: ["LV", "LV"])
    units: str = "VOLTS"
    form: str = "ASCII"
    trigger: str = "DISABLED"
    state: _State = _State.IDLE


class RedPitaya:
    """The instrument on a table. One at a time speaks to it; its state is the same for all."""

    def __init__(
        self, table: Callable[[float], Table], rng: np.random.Generator, defects: Defects | None = None
    ) -> None:
        """``table`` lays one for a rate of looks in Hz; ``rng`` gives the noise of the converters."""
        self._lay = table
        self._rng = rng
        self._defects = defects or Defects()
        self._table = table(self._rate_hz(_Acquisition()))
        self._pots = tuple(self._table.dials)
        self._generator = _Generator()
        self._acquisition = _Acquisition()
        self._scheduled: list[Turn] = []
        self._codes: NDArray[np.int16] = np.zeros((BUFFER_N, 2), np.int16)

    def silence(self) -> None:
        """The generator off: what a bench should be left as."""
        self._generator.on = False
        self._table.silence()

    @property
    def commands(self) -> Mapping[str, Command]:
        """What it understands."""
        return {
            "*IDN?": lambda _: "analogrig,emulated STEMlab 125-14,0,0",
            "*RST": self._reset_all,
            "*OPC?": lambda _: "1",
            "GEN:RST": self._reset_generator,
            "SOUR#:FUNC": self._set_shape,
            "SOUR#:FUNC?": lambda call: self._of(call).shape,
            "SOUR#:FREQ[:FIX]": self._setter("frequency_hz", 1e-3, 1e6),
            "SOUR#:FREQ[:FIX]?": lambda call: f"{self._of(call).frequency_hz:.9g}",
            "SOUR#:VOLT": self._setter("amplitude_v", 0.0, MOST_VOLTS),
            "SOUR#:VOLT?": lambda call: f"{self._of(call).amplitude_v:.9g}",
            "SOUR#:VOLT:OFFS": self._setter("offset_v", -MOST_VOLTS, MOST_VOLTS),
            "SOUR#:VOLT:OFFS?": lambda call: f"{self._of(call).offset_v:.9g}",
            "SOUR#:PHAS": self._setter("phase_deg", -360.0, 360.0),
            "SOUR#:PHAS?": lambda call: f"{self._of(call).phase_deg:.9g}",
            "SOUR#:DCYC": self._setter("duty", 0.001, 0.999),
            "SOUR#:DCYC?": lambda call: f"{self._of(call).duty:.9g}",
            "SOUR#:TRig:INT": self._start_generator,
            "OUTPUT#:STATE": self._switch_output,
            "OUTPUT#:STATE?": lambda call: "ON" if self._of(call).on else "OFF",
            "ACQ:RST": self._reset_acquisition,
            "ACQ:DEC[:Factor]": self._set_decimation,
            "ACQ:DEC[:Factor]?": lambda _: str(self._acquisition.decimation),
            "ACQ:SRATe?": lambda _: f"{CLOCK_HZ / self._acquisition.decimation:.9g} Hz",
            "ACQ:AVG": self._set_averaging,
            "ACQ:AVG?": lambda _: "ON" if self._acquisition.averages else "OFF",
            "ACQ:DATA:Units": self._set_units,
            "ACQ:DATA:Units?": lambda _: self._acquisition.units,
            "ACQ:DATA:FORMAT": self._set_form,
            "ACQ:SOUR#:GAIN": self._set_gain,
            "ACQ:SOUR#:GAIN?": lambda call: self._acquisition.gains[self._channel(call)],
            "ACQ:TRig": self._arm,
            "ACQ:TRig:STAT?": lambda _: "TD" if self._acquisition.state is _State.TRIGGERED else "WAIT",
            "ACQ:TRig:FILL?": lambda _: "1" if self._acquisition.state is _State.TRIGGERED else "0",
            "ACQ:TRig:LEV": self._set_level,
            "ACQ:TRig:LEV?": lambda _: f"{self._acquisition.level_v:.9g}",
            "ACQ:TRig:DLY": self._set_delay,
            "ACQ:TRig:DLY?": lambda _: str(self._acquisition.delay_n),
            "ACQ:START": self._start,
            "ACQ:STOP": self._stop,
            "ACQ:BUF:SIZE?": lambda _: str(BUFFER_N),
            "ACQ:SOUR#:DATA?": self._data,
            "ACQ:SOUR#:DATA:STArt:N?": self._part_of_data,
            "POT:CATalog?": lambda _: ",".join(self._pots),
            "POT#:DIAL": self._turn,
            "POT#:DIAL?": lambda call: f"{self._table.dials[self._pot(call.numbers[0])]:.9g}",
            "POT:SCHedule": self._schedule,
            "POT:SCHedule:CLEar": self._clear_schedule,
            "POT:SCHedule:COUNt?": lambda _: str(len(self._scheduled)),
        }

    # ---- generator

    def _of(self, call: Call) -> _Generator:
        if call.numbers[0] != 1:
            raise ScpiError(-114, "Header suffix out of range: OUT1 is the one that is wired")
        return self._generator

    def _setter(self, name: str, low: float, high: float) -> Command:
        def set_it(call: Call) -> None:
            changed = replace(self._of(call), **{name: call.number(0, low, high)})
            changed.waveform()
            self._change(changed)

        return set_it

    def _set_shape(self, call: Call) -> None:
        self._change(replace(self._of(call), shape=call.word(0, _SHAPES)))

    def _switch_output(self, call: Call) -> None:
        self._change(replace(self._of(call), on=call.word(0, ("ON", "OFF", "1", "0")) in ("ON", "1")))

    def _change(self, generator: _Generator) -> None:
        """One that runs goes on with the new settings, from the beginning of a period."""
        waveform = generator.waveform()
        self._generator = generator
        if self._table.generates:
            self._table.generate(waveform, [])

    def _start_generator(self, call: Call) -> None:
        waveform = self._of(call).waveform()
        if self._acquisition.state is _State.ARMED and self._acquisition.trigger == "AWG_PE":
            before, after = self._around_trigger()
            early = self._samples(before)
            self._table.generate(waveform, self._scheduled)
            self._keep(early, after)
        else:
            self._table.generate(waveform, self._scheduled)

    def _reset_generator(self, call: Call) -> None:
        call.expect(0)
        self._generator = _Generator()
        self._table.silence()

    # ---- acquisition

    def _rate_hz(self, acquisition: _Acquisition) -> float:
        return LOOKS_PER_SAMPLE * CLOCK_HZ / acquisition.decimation

    def _set_decimation(self, call: Call) -> None:
        decimation = call.whole(0, LEAST_DECIMATION, MOST_DECIMATION)
        if decimation != self._acquisition.decimation:
            self._acquisition.decimation = decimation
            self._table.look_at(self._rate_hz(self._acquisition))

    def _set_averaging(self, call: Call) -> None:
        self._acquisition.averages = call.word(0, ("ON", "OFF")) == "ON"

    def _set_units(self, call: Call) -> None:
        self._acquisition.units = call.word(0, ("VOLTS", "RAW"))

    def _set_form(self, call: Call) -> None:
        self._acquisition.form = call.word(0, ("ASCII", "BIN"))

    def _channel(self, call: Call) -> int:
        if call.numbers[0] > 2:
            raise ScpiError(-114, "Header suffix out of range: there are IN1 and IN2")
        return call.numbers[0] - 1

    def _set_gain(self, call: Call) -> None:
        self._acquisition.gains[self._channel(call)] = call.word(0, tuple(RANGES_V))

    def _set_level(self, call: Call) -> None:
        self._acquisition.level_v = call.number(0, -max(RANGES_V.values()), max(RANGES_V.values()))

    def _set_delay(self, call: Call) -> None:
        self._acquisition.delay_n = call.whole(0, -MIDDLE_N, 10 * BUFFER_N)

    def _start(self, call: Call) -> None:
        call.expect(0)
        if self._acquisition.state is _State.TRIGGERED:
            self._table.look(PAUSE_N * LOOKS_PER_SAMPLE)
        self._acquisition.state = _State.ARMED
        self._acquisition.trigger = "DISABLED"

    def _stop(self, call: Call) -> None:
        call.expect(0)
        self._acquisition.state = _State.IDLE

    def _reset_acquisition(self, call: Call) -> None:
        call.expect(0)
        before, self._acquisition = self._acquisition, _Acquisition()
        if before.decimation != self._acquisition.decimation:
            self._table.look_at(self._rate_hz(self._acquisition))

    def _reset_all(self, call: Call) -> None:
        self._reset_generator(call)
        self._reset_acquisition(call)
        self._scheduled.clear()

    def _arm(self, call: Call) -> None:
        trigger = call.word(0, _TRIGGERS)
        if self._acquisition.state is not _State.ARMED:
            raise conflict("ACQ:TRIG before ACQ:START")
        self._acquisition.trigger = trigger
        before, after = self._around_trigger()
        if trigger == "NOW":
            self._keep(self._samples(before), after)
        elif trigger == "AWG_PE" and self._table.generates:
            early = self._samples(before)
            self._keep(np.concatenate((early, self._samples(self._table.until_edge_n() // LOOKS_PER_SAMPLE))), after)
        elif trigger.startswith("CH"):
            self._wait_for_level(int(trigger[2]) - 1, rising=trigger.endswith("PE"))

    def _wait_for_level(self, channel: int, *, rising: bool) -> None:
        before, after = self._around_trigger()
        history = self._samples(before + 1)
        while len(history) < PATIENCE_N:
            sign = 1.0 if rising else -1.0
            above = sign * history[:, channel] >= sign * self._acquisition.level_v
            crossed = np.flatnonzero(above[1:] & ~above[:-1]) + 1
            crossed = crossed[crossed >= before]
            if crossed.size:
                self._keep(history[: crossed[0]], after, later=history[crossed[0] :])
                return
            history = np.concatenate((history, self._samples(BUFFER_N)))

    def _around_trigger(self) -> tuple[int, int]:
        """Samples of a record before its trigger, and after it; more than a record if the delay is longer."""
        after = MIDDLE_N + self._acquisition.delay_n
        return max(BUFFER_N - after, 0), after

    def _samples(self, count: int) -> NDArray[np.float64]:
        """The next samples, (count, 2) volts at the inputs."""
        looks = self._table.look(count * LOOKS_PER_SAMPLE)
        late = self._defects.late_looks
        if late:
            looks[:, 1] = np.concatenate((np.repeat(looks[:1, 1], late), looks[:-late, 1])) if count else looks[:, 1]
        by_sample = looks.reshape(count, LOOKS_PER_SAMPLE, 2)
        return np.asarray(by_sample.mean(axis=1) if self._acquisition.averages else by_sample[:, 0])

    def _keep(
        self, early: NDArray[np.float64], after: int, later: NDArray[np.float64] | None = None
    ) -> None:
        """The record: what came before its trigger, and what comes after it."""
        later = np.empty((0, 2)) if later is None else later
        volts = np.concatenate((early, later, self._samples(max(after - len(later), 0))))[: len(early) + after]
        self._codes = self._converted(volts[-BUFFER_N:])
        if self._defects.half_filled:
            self._codes[MIDDLE_N:] = 0
        self._acquisition.state = _State.TRIGGERED

    def _converted(self, volts: NDArray[np.float64]) -> NDArray[np.int16]:
        ranges = tuple((-RANGES_V[gain], RANGES_V[gain]) for gain in self._acquisition.gains)
        defects = self._defects
        card = Card(
            bits=BITS,
            ranges_v=ranges,
            noise_lsb=defects.noise_lsb,
            gain_error=defects.gain_error,
            offset_lsb=defects.offset_lsb,
        )
        codes, _ = Sampler(card, self._rng).sample(volts)
        return (codes.astype(np.int32) - (1 << (BITS - 1))).astype(np.int16)

    def _data(self, call: Call) -> str | bytes:
        call.expect(0)
        return self._form(self._codes[:, self._channel(call)], self._channel(call))

    def _part_of_data(self, call: Call) -> str | bytes:
        start, count = call.whole(0, 0, BUFFER_N - 1), call.whole(1, 1, BUFFER_N)
        if start + count > BUFFER_N:
            raise out_of_range(f"{start} + {count} is beyond the buffer of {BUFFER_N}")
        return self._form(self._codes[start : start + count, self._channel(call)], self._channel(call))

    def _form(self, codes: NDArray[np.int16], channel: int) -> str | bytes:
        if self._acquisition.state is not _State.TRIGGERED:
            raise ScpiError(-230, "Data corrupt or stale: no record has been taken")
        if self._acquisition.units == "RAW":
            return codes.astype(">i2").tobytes() if self._acquisition.form == "BIN" else _braces(map(str, codes.tolist()))
        lsb_v = 2.0 * RANGES_V[self._acquisition.gains[channel]] / (1 << BITS)
        volts = codes * lsb_v
        if self._acquisition.form == "BIN":
            return volts.astype(">f4").tobytes()
        return _braces(f"{volt:.6g}" for volt in volts.tolist())

    # ---- pots

    def _pot(self, number: int) -> str:
        if number > len(self._pots):
            raise ScpiError(-114, f"Header suffix out of range: there are {len(self._pots)} pots")
        return self._pots[number - 1]

    def _turn(self, call: Call) -> None:
        self._table.turn(self._pot(call.numbers[0]), call.number(0, 0.0, 1.0))

    def _schedule(self, call: Call) -> None:
        if len(self._scheduled) == MOST_SCHEDULED:
            raise ScpiError(-223, f"Too much data: {MOST_SCHEDULED} turns are scheduled")
        pot = self._pot(call.whole(0, 1, len(self._pots)))
        self._scheduled.append(Turn(call.number(2, 0.0, 1e4), pot, call.number(1, 0.0, 1.0)))

    def _clear_schedule(self, call: Call) -> None:
        call.expect(0)
        self._scheduled.clear()


def _braces(numbers: map[str] | object) -> str:
    return "{" + ",".join(numbers) + "}"  # type: ignore[call-overload]
