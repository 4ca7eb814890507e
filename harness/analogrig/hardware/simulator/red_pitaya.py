"""The instrument: a Red Pitaya STEMlab 125-14 as its SCPI server shows it, with a box of digital pots beside it.

Generator and acquisition of two channels, after https://redpitaya.readthedocs.io (SCPI commands, OS 2.0). What is here
behaves as there: 125 MHz through a decimation, records of 16,384 samples with the trigger in their middle plus a delay,
+-1 V (LV) or +-20 V (HV) on 14 bits, numbers in braces or as float32 and int16 in a block, the highest byte first
unless ACQ:DATA:BYTE:ORDER LEND says otherwise. Commands that it does not have are refused; a real one has many more.

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

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.hardware.simulator.acquisition import (
    BUFFER_N,
    CLOCK_HZ,
    LARGEST_V,
    LEAST_DECIMATION,
    LEAST_DELAY_N,
    MOST_DECIMATION,
    MOST_DELAY_N,
    TRIGGERS,
    Acquisition,
    Settings,
    with_switch,
)
from analogrig.hardware.simulator.description import InstrumentDescription
from analogrig.hardware.simulator.generator import MOST_VOLTS, SHAPES, Generator
from analogrig.hardware.simulator.inputs import RANGES_V, Codes
from analogrig.hardware.simulator.scpi import HERTZ, VOLTS, Broken, Call, Command, Response, ScpiError
from analogrig.hardware.simulator.table import DueTurn, Table
from analogrig.links.wire import Clock
from analogrig_emulator import EmulatorError, SuspensionComputer

MOST_SCHEDULED = 64
MOST_DELAY_S = 1e4
_ORDERS = {"BEND": ">", "LEND": "<"}
_IDENTITY = "analogrig,emulated STEMlab 125-14,0,0"


class ServedRedPitaya:
    """The instrument on a table, with a computer that is switched on. Its state is the same for all who speak to it."""

    def __init__(
        self,
        computer: Callable[[float], SuspensionComputer],
        rng: np.random.Generator,
        description: InstrumentDescription | None = None,
        clock: Clock | None = None,
    ) -> None:
        """``computer`` makes the machine for a rate of looks in Hz; ``rng`` gives the noise of the inputs.

        With a ``clock`` a record takes the time that it lasts, and a pot turns where in the record it was turned.

        :raises EmulatorError: the computer cannot be made.
        """
        described = description or InstrumentDescription()
        self._table = Table(computer, described.wiring)
        self._acquisition = Acquisition(self._table, (described.inputs, rng), described.acquisition, clock)
        self._generator = Generator()
        self._pots = tuple(self._table.dials)
        self._scheduled: list[DueTurn] = []

    @property
    def live(self) -> bool:
        """Whether the generator's output is switched on."""
        return self._generator.on

    def silence(self) -> None:
        """The output off: what a bench should be left as."""
        self._generator = dataclasses.replace(self._generator, on=False)
        self._table.silence()

    @property
    def commands(self) -> Mapping[str, tuple[int, Command]]:
        """By pattern the number of arguments, and what is done."""
        commands = self._general() | self._of_generator() | self._of_acquisition() | self._of_pots()
        return {pattern: (most, functools.partial(_refusing, command)) for pattern, (most, command) in commands.items()}

    def _general(self) -> dict[str, tuple[int, Command]]:
        return {
            "*IDN?": (0, lambda _: _IDENTITY),
            "*OPC?": (0, lambda _: "1"),
            "*RST": (0, lambda _: self._reset()),
        }

    def _reset(self) -> None:
        self._reset_generator()
        self._acquisition.reset()
        self._scheduled.clear()

    # ---- generator

    def _of_generator(self) -> dict[str, tuple[int, Command]]:
        return {
            "GEN:RST": (0, lambda _: self._reset_generator()),
            "SOUR#:FUNC": (1, lambda call: self._generate_with(self._out(call), shape=call.word(0, SHAPES))),
            "SOUR#:FUNC?": (0, lambda call: self._out(call).shape),
            "OUTPUT#:STATE": (1, lambda call: self._generate_with(self._out(call), on=call.switch(0))),
            "OUTPUT#:STATE?": (0, lambda call: _on_off(self._out(call).on)),
            "SOUR#:TRig:INT": (0, self._trigger_generator),
            **self._quantity("SOUR#:FREQ[:FIX]", "frequency_hz", 1e-3, 1e6, HERTZ),
            **self._quantity("SOUR#:VOLT", "amplitude_v", 0.0, MOST_VOLTS, VOLTS),
            **self._quantity("SOUR#:VOLT:OFFS", "offset_v", -MOST_VOLTS, MOST_VOLTS, VOLTS),
            **self._quantity("SOUR#:PHAS", "phase_deg", -360.0, 360.0),
            **self._quantity("SOUR#:DCYC", "duty", 0.001, 0.999),
        }

    def _quantity(
        self, pattern: str, name: str, low: float, high: float, suffixes: Mapping[str, float] | None = None
    ) -> dict[str, tuple[int, Command]]:
        """A number of the generator's, set and asked for."""
        return {
            pattern: (
                1,
                lambda call: self._generate_with(self._out(call), **{name: call.number(0, low, high, suffixes)}),
            ),
            f"{pattern}?": (0, lambda call: _number(getattr(self._out(call), name))),
        }

    def _out(self, call: Call) -> Generator:
        if call.numbers[0] != 1:
            raise ScpiError(-114, "OUT1 is the one that is wired")
        return self._generator

    def _generate_with(self, generator: Generator, **changes: Any) -> None:
        """A generator that runs goes on with the new settings, from the beginning of a period."""
        changed = dataclasses.replace(generator, **changes)
        waveform = changed.waveform()
        if self._table.generates:
            self._table.generate(waveform)
        self._generator = changed

    def _trigger_generator(self, call: Call) -> None:
        self._table.generate(self._out(call).waveform())
        self._table.schedule(self._scheduled)
        self._acquisition.generator_started()

    def _reset_generator(self) -> None:
        self._generator = Generator()
        self._table.silence()

    # ---- acquisition

    def _of_acquisition(self) -> dict[str, tuple[int, Command]]:
        acquisition = self._acquisition
        return {
            "ACQ:RST": (0, lambda _: acquisition.reset()),
            "ACQ:START": (0, lambda _: acquisition.start()),
            "ACQ:STOP": (0, lambda _: acquisition.stop()),
            "ACQ:TRig": (1, lambda call: acquisition.arm(call.word(0, TRIGGERS))),
            "ACQ:TRig:STAT?": (0, lambda _: self._triggered()),
            "ACQ:TRig:FILL?": (0, lambda _: self._filled()),
            "ACQ:BUF:SIZE?": (0, lambda _: str(BUFFER_N)),
            "ACQ:SOUR#:DATA?": (0, lambda call: self._data(call, 0, BUFFER_N)),
            "ACQ:SOUR#:DATA:STArt:N?": (2, self._part_of_data),
            "ACQ:SOUR#:DATA:Old:N?": (1, lambda call: self._data(call, 0, call.whole(0, 1, BUFFER_N))),
            "ACQ:SOUR#:DATA:LATest:N?": (1, self._latest_data),
            **self._settings_of_time(),
            **self._settings_of_data(),
        }

    def _settings_of_time(self) -> dict[str, tuple[int, Command]]:
        def settings() -> Settings:
            return self._acquisition.settings

        return {
            "ACQ:DEC[:Factor]": (
                1,
                lambda call: self._acquire_with(decimation=call.whole(0, LEAST_DECIMATION, MOST_DECIMATION)),
            ),
            "ACQ:DEC[:Factor]?": (0, lambda _: str(settings().decimation)),
            "ACQ:SRATe?": (0, lambda _: f"{_number(CLOCK_HZ / settings().decimation)} Hz"),
            "ACQ:AVG": (1, lambda call: self._acquire_with(averages=call.switch(0))),
            "ACQ:AVG?": (0, lambda _: _on_off(settings().averages)),
            "ACQ:TRig:LEV": (1, lambda call: self._acquire_with(level_v=call.number(0, -LARGEST_V, LARGEST_V, VOLTS))),
            "ACQ:TRig:LEV?": (0, lambda _: _number(settings().level_v)),
            "ACQ:TRig:DLY": (1, lambda call: self._acquire_with(delay_n=call.whole(0, LEAST_DELAY_N, MOST_DELAY_N))),
            "ACQ:TRig:DLY?": (0, lambda _: str(settings().delay_n)),
        }

    def _settings_of_data(self) -> dict[str, tuple[int, Command]]:
        def settings() -> Settings:
            return self._acquisition.settings

        return {
            "ACQ:SOUR#:GAIN": (1, self._set_range),
            "ACQ:SOUR#:GAIN?": (0, lambda call: settings().switches[_channel(call)]),
            "ACQ:DATA:Units": (1, lambda call: self._acquire_with(units=call.word(0, ("VOLTS", "RAW")))),
            "ACQ:DATA:Units?": (0, lambda _: settings().units),
            "ACQ:DATA:FORMAT": (1, lambda call: self._acquire_with(form=call.word(0, ("ASCII", "BIN")))),
            "ACQ:DATA:FORMAT?": (0, lambda _: settings().form),
            "ACQ:DATA:BYTE:ORDER": (1, lambda call: self._acquire_with(order=call.word(0, tuple(_ORDERS)))),
            "ACQ:DATA:BYTE:ORDER?": (0, lambda _: settings().order),
        }

    def _acquire_with(self, **changes: Any) -> None:
        self._acquisition.change(dataclasses.replace(self._acquisition.settings, **changes))

    def _set_range(self, call: Call) -> None:
        changed = with_switch(self._acquisition.settings, _channel(call), call.word(0, tuple(RANGES_V)))
        self._acquisition.change(changed)

    def _triggered(self) -> str:
        self._acquisition.wait()
        return "TD" if self._acquisition.triggered else "WAIT"

    def _filled(self) -> str:
        self._acquisition.wait()
        return str(int(self._acquisition.filled))

    def _part_of_data(self, call: Call) -> Response:
        first, count = call.whole(0, 0, BUFFER_N - 1), call.whole(1, 1, BUFFER_N)
        if first + count > BUFFER_N:
            raise ScpiError(-222, f"{first} + {count} is beyond the buffer of {BUFFER_N}")
        return self._data(call, first, count)

    def _latest_data(self, call: Call) -> Response:
        count = call.whole(0, 1, BUFFER_N)
        return self._data(call, BUFFER_N - count, count)

    def _data(self, call: Call, first: int, count: int) -> Response:
        """Samples of the record, in the units and the form that are set."""
        channel, record = _channel(call), self._acquisition.record
        if record is None:
            raise ScpiError(-230, "no record is complete")
        data = self._formed(record.codes[first : first + count, channel], record.lsb_v[channel])
        return Broken(data, hangs_up=self._acquisition.hangs_up) if self._acquisition.drops_out() else data

    def _formed(self, codes: Codes, lsb_v: float) -> str | bytes:
        settings = self._acquisition.settings
        order, binary = _ORDERS[settings.order], settings.form == "BIN"
        if settings.units == "RAW":
            return codes.astype(f"{order}i2").tobytes() if binary else _braces(map(str, codes.tolist()))
        volts: NDArray[np.float64] = codes.astype(np.float64) * lsb_v
        return volts.astype(f"{order}f4").tobytes() if binary else _braces(f"{v:.6g}" for v in volts.tolist())

    # ---- pots

    def _of_pots(self) -> dict[str, tuple[int, Command]]:
        return {
            "POT:CATalog?": (0, lambda _: ",".join(self._pots)),
            "POT#:DIAL": (1, self._turn),
            "POT#:DIAL?": (0, lambda call: _number(self._table.dials[self._pot(call.numbers[0])])),
            "POT:SCHedule": (3, self._schedule),
            "POT:SCHedule:CLEar": (0, lambda _: self._scheduled.clear()),
            "POT:SCHedule:COUNt?": (0, lambda _: str(len(self._scheduled))),
        }

    def _pot(self, number: int) -> str:
        if not 1 <= number <= len(self._pots):
            raise ScpiError(-114, f"there are pots 1 to {len(self._pots)}")
        return self._pots[number - 1]

    def _turn(self, call: Call) -> None:
        """At this instant: what has been recorded by now was taken before."""
        pot, dial = self._pot(call.numbers[0]), call.number(0, 0.0, 1.0)
        if self._acquisition.triggered:
            self._acquisition.wait()
        self._table.turn(pot, dial)

    def _schedule(self, call: Call) -> None:
        if len(self._scheduled) == MOST_SCHEDULED:
            raise ScpiError(-223, f"{MOST_SCHEDULED} turns are scheduled")
        pot = self._pots[call.whole(0, 1, len(self._pots)) - 1]
        self._scheduled.append(DueTurn(call.number(2, 0.0, MOST_DELAY_S), pot, call.number(1, 0.0, 1.0)))


def _refusing(command: Command, call: Call) -> Response:
    """What the emulator refuses, the instrument does."""
    try:
        return command(call)
    except EmulatorError as error:
        raise ScpiError(-221, str(error).replace('"', "'")) from error


def _channel(call: Call) -> int:
    if not 1 <= call.numbers[0] <= 2:
        raise ScpiError(-114, "there are IN1 and IN2")
    return call.numbers[0] - 1


def _number(value: float) -> str:
    return f"{value:.9g}"


def _on_off(on: object) -> str:
    return "ON" if on else "OFF"


def _braces(numbers: Iterable[str]) -> str:
    return "{" + ",".join(numbers) + "}"
