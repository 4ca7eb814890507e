"""A Red Pitaya STEMlab 125-14 by its SCPI server: generator OUT1, inputs IN1 and IN2, 20 kS/s.

Commands after https://redpitaya.readthedocs.io (OS 2.0), in the order that its examples publish. A box of digital pots
on the same server (``POT:...``, harness/analogrig/hardware/simulator/red_pitaya.py) is used when it is there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError, RecordIncomplete, RecordStale, RigRefused, RigTimeout
from analogrig.hardware.instrument import Datasheet, Instrument, Taken, Turn
from analogrig.hardware.scpi_connection import ScpiConnection
from analogrig.links.wire import Clock
from analogrig_emulator import Excitation

PORT = 5000
CLOCK_HZ = 125e6
DECIMATION = 6250
BUFFER_N = 16_384
MIDDLE_N = BUFFER_N // 2

_POLL_S = 0.01
_ZEROS_N = BUFFER_N // 10
"""So many zeros in a row on all inputs are no measurement."""

_EARLY_N = 1e-4
"""Edges come this part of a sample before the sample that shows them, so that no rounding makes them come after it."""


class RedPitaya(Instrument):
    """Records of 16,384 samples, between which the instrument is blind for as long as they take to be read."""

    datasheet = Datasheet(
        rate_hz=CLOCK_HZ / DECIMATION,
        record_n=BUFFER_N,
        bits=14,
        inputs=(1, 2),
        output_v=(-1.0, 1.0),
        ranges_v={"LV": (-1.0, 1.0), "HV": (-20.0, 20.0)},
    )

    def __init__(self, connection: ScpiConnection, timeout_s: float, clock: Clock = time.monotonic) -> None:
        """Take over ``connection`` and bring the instrument to a known state, the generator off.

        :raises RigError: it does not answer as one.
        """
        super().__init__(f"instrument {connection.name}")
        self._scpi = connection
        self._timeout_s = timeout_s
        self._clock = clock
        self._ranges: tuple[tuple[int, str], ...] = ()
        self._excitation = Excitation()
        self.make_safe()
        self._scpi.send("*CLS")
        self._box = _PotBox.found(self._scpi)
        self.pots = self._box

    @classmethod
    def is_address(cls, address: str) -> bool:
        try:
            split = urlsplit(f"//{address}")
            found = bool(split.hostname) and (split.port is None or split.port > 0)
        except ValueError:
            return False
        return found and not (split.path or split.query or split.fragment or split.username or " " in address)

    @classmethod
    def place(cls, address: str) -> str:
        host, port = _host_and_port(address)
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    @classmethod
    def open(cls, address: str, timeout_s: float) -> RedPitaya:
        """:raises RigError: nobody answers there."""
        connection = ScpiConnection(*_host_and_port(address), timeout_s)
        try:
            return cls(connection, timeout_s)
        except BaseException:
            connection.close()
            raise

    @classmethod
    def check(cls, excitation: Excitation) -> None:
        super().check(excitation)
        if excitation.shape == "prbs":
            raise ConfigurationError("the generator of a Red Pitaya has no prbs: say square or pulse")
        period_n = cls.datasheet.rate_hz / excitation.frequency_hz
        high_n = period_n * (0.5 if excitation.shape == "square" else excitation.duty)
        if excitation.clock == "card" and not (_is_whole(high_n) and _is_whole(period_n)):
            raise ConfigurationError(
                f'{excitation.frequency_hz:g} Hz on the clock "card" need edges that are whole samples apart, not'
                f" {high_n:g} and {period_n - high_n:g}:"
                ' the generator\'s edges come when they come; say clock = "free"'
            )

    def set_inputs(self, ranges: Sequence[tuple[int, str]]) -> None:
        self._ranges = tuple(ranges)

    def set_excitation(self, excitation: Excitation) -> None:
        self._excitation = excitation

    def rest(self, settle_s: float) -> None:
        """The samples that go by are those of a record: so it is the computer's time that goes by.

        They are no measurement, but what the buffer then holds must not come again.
        """
        self.make_safe()
        self._scpi.send("ACQ:RST", f"ACQ:DEC:Factor {DECIMATION}")
        delay_n = max(0, math.ceil(settle_s * self.datasheet.rate_hz) - MIDDLE_N)
        self._scpi.send(f"ACQ:TRig:DLY {delay_n}", "ACQ:START", "ACQ:TRig NOW")
        self._await_record(settle_s)
        if self._ranges:
            self._repeats(self._codes())

    def make_safe(self) -> None:
        self._scpi.send("OUTPUT1:STATE OFF", "GEN:RST")
        self._scpi.ask("*IDN?")  # it has heard it

    def close(self) -> None:
        self._scpi.close()

    def _take(self, samples: int, while_recording: Callable[[], None] | None) -> Taken:  # noqa: ARG002 - always as many
        scheduled_n = self._prepare()
        self._scpi.send("ACQ:START", "ACQ:TRig AWG_PE")
        self._check_waiting()
        self._scpi.send("OUTPUT1:STATE ON", "SOUR1:TRig:INT")
        if while_recording is not None:
            while_recording()
        self._await_record(BUFFER_N / self.datasheet.rate_hz)
        self._scpi.check("the record")
        self._check_alone(scheduled_n)
        codes = self._codes()
        self._check_filled(codes)
        return Taken(self._data("VOLTS", ">f4").astype(np.float64), codes, self.datasheet.bits)

    def _prepare(self) -> int:
        """Returns how many turns of pots are scheduled."""
        excitation = self._excitation
        middle_v = 0.5 * (excitation.low_v + excitation.high_v)
        self._scpi.send(
            "GEN:RST",
            "ACQ:RST",
            f"SOUR1:FUNC {'SQUARE' if excitation.shape == 'square' else 'PWM'}",
            f"SOUR1:DCYC {excitation.duty:.12g}",
            f"SOUR1:FREQ:FIX {self._frequency_hz:.15g}",
            f"SOUR1:VOLT {excitation.high_v - middle_v:.12g}",
            f"SOUR1:VOLT:OFFS {middle_v:.12g}",
            f"SOUR1:PHAS {360.0 * self._phase():.15g}",
            f"ACQ:DEC:Factor {DECIMATION}",
            "ACQ:AVG OFF",
            *(f"ACQ:SOUR{number}:GAIN {word}" for number, word in self._ranges),
            f"ACQ:TRig:DLY {MIDDLE_N}",
        )
        scheduled_n = 0 if self._box is None else self._box.hand_over()
        self._scpi.check("the set-up of the record")
        return scheduled_n

    @property
    def _frequency_hz(self) -> float:
        return self._excitation.frequency_hz * (1.0 + 1e-6 * self._excitation.drift_ppm)

    def _phase(self) -> float:
        """Into a period at the first sample; on the card's clock the edges come with samples."""
        excitation = self._excitation
        if excitation.clock == "free":
            return excitation.phase
        period_n = round(self.datasheet.rate_hz / excitation.frequency_hz)
        return (math.floor(excitation.phase * period_n) + _EARLY_N) / period_n

    def _check_waiting(self) -> None:
        """:raises RecordStale: it has a record before the generator, which is to trigger it, is on: an old one."""
        if (answer := self._scpi.ask("ACQ:TRig:STAT?")) != "WAIT":
            raise RecordStale(
                f"{self.name}: the record is an old one: ACQ:TRig:STAT? says {answer[:20]!r} before the generator is on"
            )

    def _await_record(self, lasting_s: float) -> None:
        """:raises RigTimeout: it is not full in its own time and the time-out."""
        deadline_s = self._clock() + lasting_s + self._timeout_s
        for query, wanted, what in (
            ("ACQ:TRig:STAT?", "TD", "was not triggered"),
            ("ACQ:TRig:FILL?", "1", "is not full"),
        ):
            while (answer := self._scpi.ask(query)) != wanted:
                if self._clock() > deadline_s:
                    self._scpi.check("the record")
                    raise RigTimeout(f"{self.name}: the record {what} in time: {query} says {answer[:20]!r}")
                time.sleep(_POLL_S)

    def _check_alone(self, scheduled_n: int) -> None:
        """:raises RigRefused: what was set for the record is not set any more: somebody else has the instrument too."""
        stand = {"OUTPUT1:STATE?": ("ON", "1"), "ACQ:DEC:Factor?": (str(DECIMATION),)}
        if self._box is not None:
            stand["POT:SCHedule:COUNt?"] = (str(scheduled_n),)
        changed = f"{self.name}: somebody else has changed it during the record"
        for query, wanted in stand.items():
            if (answer := self._scpi.ask(query)) not in wanted:
                raise RigRefused(f"{changed}: {query} says {answer[:20]!r}, not {wanted[0]}")
        frequency_hz = self._scpi.ask("SOUR1:FREQ:FIX?")
        if not _is_close(frequency_hz, self._frequency_hz):
            raise RigRefused(f"{changed}: its generator gives {frequency_hz[:20]} Hz, not {self._frequency_hz:g} Hz")

    def _codes(self) -> NDArray[np.int32]:
        return self._data("RAW", ">i2").astype(np.int32)

    def _data(self, units: str, dtype: str) -> NDArray[np.generic]:
        """(16384, inputs): the buffer in one of its units."""
        self._scpi.send(f"ACQ:DATA:Units {units}", "ACQ:DATA:FORMAT BIN")
        return np.stack([self._of_input(number, dtype) for number, _ in self._ranges], axis=1)

    def _of_input(self, number: int, dtype: str) -> NDArray[np.generic]:
        block = self._scpi.ask_block(f"ACQ:SOUR{number}:DATA?")
        size = np.dtype(dtype).itemsize
        if len(block) != BUFFER_N * size:
            raise RecordIncomplete(f"{self.name}: IN{number} gave {len(block) / size:g} of {BUFFER_N} samples")
        return np.frombuffer(block, dtype)

    def _check_filled(self, codes: NDArray[np.int32]) -> None:
        """:raises RecordIncomplete: a stretch of it was never written."""
        measured = np.flatnonzero((codes != 0).any(axis=1))
        marks = np.concatenate(([-1], measured, [BUFFER_N]))
        longest = int(np.argmax(np.diff(marks)))
        start, end = int(marks[longest]) + 1, int(marks[longest + 1])
        if end - start >= _ZEROS_N:
            raise RecordIncomplete(
                f"{self.name}: its buffer is not filled: nothing but zeros from sample {start} to {end - 1}"
            )


def _host_and_port(address: str) -> tuple[str, int]:
    split = urlsplit(f"//{address}")
    return str(split.hostname), split.port or PORT


class _PotBox:
    """A PotBox on the instrument's own server."""

    def __init__(self, scpi: ScpiConnection, names: tuple[str, ...]) -> None:
        self.names = names
        self._scpi = scpi
        self._turns: tuple[Turn, ...] = ()

    @classmethod
    def found(cls, scpi: ScpiConnection) -> _PotBox | None:
        """An instrument without one says nothing to the first question, or an error."""
        scpi.send("POT:CATalog?")
        answer = scpi.ask("*OPC?")
        if answer == "1":
            scpi.send("*CLS")
            return None
        scpi.next_line("*OPC?")
        return None if answer.upper().startswith("ERR") else cls(scpi, tuple(answer.split(",")))

    def turn(self, pot: str, dial: float) -> None:
        self._scpi.send(f"POT{self._number(pot)}:DIAL {dial:.12g}")
        self._scpi.check(f"turning {pot} to {dial:.4g}")

    def schedule(self, turns: Sequence[Turn]) -> None:
        self._turns = tuple(turns)

    def hand_over(self) -> int:
        """What is scheduled to the instrument, of which it has nothing else; how many turns that is."""
        turns, self._turns = self._turns, ()
        scheduled = [f"POT:SCH {self._number(pot)},{dial:.12g},{delay_s:.12g}" for delay_s, pot, dial in turns]
        self._scpi.send("POT:SCH:CLE", *scheduled)
        return len(scheduled)

    def _number(self, pot: str) -> int:
        return self.names.index(pot) + 1


def _is_whole(samples: float) -> bool:
    return math.isclose(samples, round(samples), rel_tol=1e-12)


def _is_close(answer: str, wanted: float) -> bool:
    try:
        return math.isclose(float(answer), wanted, rel_tol=1e-5)
    except ValueError:
        return False
