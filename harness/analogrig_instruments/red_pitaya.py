"""Driver of a Red Pitaya STEMlab 125-14 through its SCPI server: generator OUT1, inputs IN1 and IN2, 20 kS/s.

Commands and their order follow https://redpitaya.readthedocs.io (OS 2.0). A box of digital pots on the same server
(``POT:...``, harness/analogrig_instruments/simulator/served.py) is used if there is one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Program
from analogrig.cli import PASSED, complain
from analogrig.errors import RecordIncomplete, RecordStale, RigRefused, RigTimeout
from analogrig.links import Clock
from analogrig_emulator import Excitation
from analogrig_instruments.instrument import (
    DialChange,
    InputRecord,
    Instrument,
    InstrumentDatasheet,
    PotBox,
    check_edges,
    first_phase,
)
from analogrig_instruments.scpi_connection import ScpiConnection
from analogrig_instruments.tcp_address import host_and_port, tcp_place

if TYPE_CHECKING:
    from analogrig_instruments.simulator.tcp_server import TcpServer

PORT = 5000
CLOCK_HZ = 125e6
DECIMATION = 6250
BUFFER_N = 16_384
MIDDLE_N = BUFFER_N // 2

_POLL_S = 0.01
_ZEROS_N = BUFFER_N // 10
"""Zeros in a row on all inputs that show an unfilled buffer."""


class RedPitaya(Instrument):
    """Red Pitaya with records of 16,384 samples; it samples nothing while a record is read out."""

    datasheet = InstrumentDatasheet(
        rate_hz=CLOCK_HZ / DECIMATION,
        record_n=BUFFER_N,
        bits=14,
        inputs=(1, 2),
        output_v=(-1.0, 1.0),
        ranges_v={"LV": (-1.0, 1.0), "HV": (-20.0, 20.0)},
    )

    form = "HOST[:PORT]"
    served_port = PORT

    def __init__(self, connection: ScpiConnection, timeout_s: float, clock: Clock = time.monotonic) -> None:
        """Take over ``connection`` and bring the instrument to a known state, the generator off.

        :raises RigError: the answers are not those of a Red Pitaya.
        """
        super().__init__(f"instrument {connection.name}")
        self._scpi = connection
        self._timeout_s = timeout_s
        self._clock = clock
        self.make_safe()
        self._scpi.send("*CLS")
        self._box = self.pots = _ScpiPots.find(self._scpi)

    @classmethod
    def place(cls, address: str) -> str:
        return tcp_place(address, PORT)

    @classmethod
    def emulated(
        cls, rig: str | None, program: str | None, seed: int, defects: Sequence[str], clock: Clock | None
    ) -> tuple[TcpServer, Mapping[str, str]]:
        from analogrig_instruments.simulator.served import ServedDescription
        from analogrig_instruments.simulator.server import Server

        described = ServedDescription.load(rig or "emulator", defects)
        server = Server(described.set_up(Program.load(program or "front"), seed, clock))
        if described.unsupported:
            complain(f"{described.name}: the instrument has no {', '.join(described.unsupported)}", PASSED)
        return server, {"rig": described.name, "program": program or "front"}

    @classmethod
    def open(cls, address: str, timeout_s: float) -> RedPitaya:
        """:raises RigError: the connection failed."""
        connection = ScpiConnection(*host_and_port(address, PORT), timeout_s)
        try:
            return cls(connection, timeout_s)
        except BaseException:
            connection.close()
            raise

    @classmethod
    def check(cls, excitation: Excitation) -> None:
        super().check(excitation)
        if excitation.shape == "prbs":
            raise ConfigurationError("the generator of a Red Pitaya has no prbs: use square or pulse")
        check_edges(excitation, cls.datasheet.rate_hz)

    def rest(self, settle_s: float) -> None:
        """Wait for a record, so that machine time passes.

        Its codes are no measurement, but are remembered: a later record that repeats them is stale.
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
        self._scpi.ask("*IDN?")  # the answer shows that the commands have been executed

    def close(self) -> None:
        self._scpi.close()

    def _take(self, samples: int, while_recording: Callable[[], None] | None) -> InputRecord:  # noqa: ARG002
        scheduled_n = self._prepare()
        self._scpi.send("ACQ:START", "ACQ:TRig AWG_PE")
        self._check_waiting()
        self._scpi.send("OUTPUT1:STATE ON", "SOUR1:TRig:INT")
        if while_recording is not None:
            while_recording()
        self._await_record(BUFFER_N / self.datasheet.rate_hz)
        self._scpi.check("the record")
        self._check_unchanged(scheduled_n)
        codes = self._codes()
        self._check_filled(codes)
        return InputRecord(self._data("VOLTS", ">f4").astype(np.float64), codes, self.datasheet.bits)

    def _prepare(self) -> int:
        """Send the settings of a record. Return the number of scheduled pot changes."""
        excitation = self._excitation
        middle_v = 0.5 * (excitation.low_v + excitation.high_v)
        self._scpi.send(
            "GEN:RST",
            "ACQ:RST",
            f"SOUR1:FUNC {'SQUARE' if excitation.shape == 'square' else 'PWM'}",
            f"SOUR1:DCYC {excitation.duty:.12g}",
            f"SOUR1:FREQ:FIX {self._excitation.true_frequency_hz:.15g}",
            f"SOUR1:VOLT {excitation.high_v - middle_v:.12g}",
            f"SOUR1:VOLT:OFFS {middle_v:.12g}",
            f"SOUR1:PHAS {360.0 * first_phase(self._excitation, self.datasheet.rate_hz):.15g}",
            f"ACQ:DEC:Factor {DECIMATION}",
            "ACQ:AVG OFF",
            *(f"ACQ:SOUR{number}:GAIN {word}" for number, word in self._ranges),
            f"ACQ:TRig:DLY {MIDDLE_N}",
        )
        scheduled_n = 0 if self._box is None else self._box.send_schedule()
        self._scpi.check("the set-up of the record")
        return scheduled_n

    def _check_waiting(self) -> None:
        """:raises RecordStale: a record is ready before the generator, which triggers it, is on."""
        if (answer := self._scpi.ask("ACQ:TRig:STAT?")) != "WAIT":
            raise RecordStale(
                f"{self.name}: stale record: ACQ:TRig:STAT? answered {answer[:20]!r} before the generator was on"
            )

    def _await_record(self, lasting_s: float) -> None:
        """Await a full record.

        :raises RigTimeout: it is not full after its duration and the time-out.
        """
        deadline_s = self._clock() + lasting_s + self._timeout_s
        for query, wanted, what in (
            ("ACQ:TRig:STAT?", "TD", "was not triggered"),
            ("ACQ:TRig:FILL?", "1", "is not full"),
        ):
            while (answer := self._scpi.ask(query)) != wanted:
                if self._clock() > deadline_s:
                    self._scpi.check("the record")
                    raise RigTimeout(f"{self.name}: the record {what} in time: {query} answered {answer[:20]!r}")
                time.sleep(_POLL_S)

    def _check_unchanged(self, scheduled_n: int) -> None:
        """:raises RigRefused: another client has changed the settings of the record."""
        settings = {"OUTPUT1:STATE?": ("ON", "1"), "ACQ:DEC:Factor?": (str(DECIMATION),)}
        if self._box is not None:
            settings["POT:SCHedule:COUNt?"] = (str(scheduled_n),)
        changed = f"{self.name}: another client has changed it during the record"
        for query, wanted in settings.items():
            if (answer := self._scpi.ask(query)) not in wanted:
                raise RigRefused(f"{changed}: {query} answered {answer[:20]!r}, not {wanted[0]}")
        answer, wanted_hz = self._scpi.ask("SOUR1:FREQ:FIX?"), self._excitation.true_frequency_hz
        if not _is_close(answer, wanted_hz):
            raise RigRefused(f"{changed}: its generator gives {answer[:20]} Hz, not {wanted_hz:g} Hz")

    def _codes(self) -> NDArray[np.int32]:
        return self._data("RAW", ">i2").astype(np.int32)

    def _data(self, units: str, dtype: str) -> NDArray[np.generic]:
        """Contents of the buffer in one of its units, (16384, inputs)."""
        self._scpi.send(f"ACQ:DATA:Units {units}", "ACQ:DATA:FORMAT BIN")
        return np.stack([self._read_input(number, dtype) for number, _ in self._ranges], axis=1)

    def _read_input(self, number: int, dtype: str) -> NDArray[np.generic]:
        block = self._scpi.ask_block(f"ACQ:SOUR{number}:DATA?")
        size = np.dtype(dtype).itemsize
        if len(block) != BUFFER_N * size:
            raise RecordIncomplete(f"{self.name}: IN{number} returned {len(block) / size:g} of {BUFFER_N} samples")
        return np.frombuffer(block, dtype)

    def _check_filled(self, codes: NDArray[np.int32]) -> None:
        """:raises RecordIncomplete: part of the buffer was never written."""
        measured = np.flatnonzero((codes != 0).any(axis=1))
        marks = np.concatenate(([-1], measured, [BUFFER_N]))
        longest = int(np.argmax(np.diff(marks)))
        start, end = int(marks[longest]) + 1, int(marks[longest + 1])
        if end - start >= _ZEROS_N:
            raise RecordIncomplete(f"{self.name}: incomplete record: only zeros from sample {start} to {end - 1}")


class _ScpiPots(PotBox):
    """Pots on the instrument's own server."""

    def __init__(self, scpi: ScpiConnection, names: tuple[str, ...]) -> None:
        self.names = names
        self._scpi = scpi
        self._changes: tuple[DialChange, ...] = ()

    @classmethod
    def find(cls, scpi: ScpiConnection) -> _ScpiPots | None:
        """The box of an instrument, or None: without one, the first query has no answer, or an error."""
        scpi.send("POT:CATalog?")
        answer = scpi.ask("*OPC?")
        if answer == "1":
            scpi.send("*CLS")
            return None
        scpi.next_line("*OPC?")
        return None if answer.upper().startswith("ERR") else cls(scpi, tuple(answer.split(",")))

    def set_one(self, pot: str, dial: float) -> None:
        self._scpi.send(f"POT{self._number(pot)}:DIAL {dial:.12g}")
        self._scpi.check(f"set {pot} to {dial:.4g}")

    def schedule(self, changes: Sequence[DialChange]) -> None:
        self._changes = tuple(changes)

    def send_schedule(self) -> int:
        """Replace the schedule of the instrument. Return the number of changes."""
        changes, self._changes = self._changes, ()
        scheduled = [f"POT:SCH {self._number(pot)},{dial:.12g},{delay_s:.12g}" for delay_s, pot, dial in changes]
        self._scpi.send("POT:SCH:CLE", *scheduled)
        return len(scheduled)

    def _number(self, pot: str) -> int:
        return self.names.index(pot) + 1


def _is_close(answer: str, wanted: float) -> bool:
    try:
        return math.isclose(float(answer), wanted, rel_tol=1e-5)
    except ValueError:
        return False
