"""A Red Pitaya STEMlab 125-14 by its SCPI server: generator OUT1, inputs IN1 and IN2, 20 kS/s.

Commands after https://redpitaya.readthedocs.io (OS 2.0), in the order that its examples publish. A box of digital pots
on the same server (``POT:...``, harness/served/red_pitaya.py) is used when it is there.
"""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from emulator.excitation import Excitation
from harness.errors import ConfigurationError, RecordIncomplete, RigClosed, RigError, RigRefused, RigTimeout
from harness.links.wire import Clock
from harness.rigs.instrument import Instrument, Recorded, Turn, parsed

PORT = 5000
CLOCK_HZ = 125e6
DECIMATION = 6250
BUFFER_N = 16_384
MIDDLE_N = BUFFER_N // 2
BITS = 14

_POLL_S = 0.01
_ROUNDING_V = 1e-9
_MOST_ANSWER_BYTES = 1 << 20
_ZEROS_N = BUFFER_N // 10
"""So many zeros in a row on all inputs are no measurement."""

_EARLY_N = 1e-4
"""Edges come this part of a sample before the sample that shows them, so that no rounding makes them come after it."""


class ScpiConnection:
    """Lines and blocks over TCP, each with a deadline."""

    def __init__(self, host: str, port: int, timeout_s: float, clock: Clock = time.monotonic) -> None:
        """:raises RigError: nobody answers there."""
        self.name = f"{host}:{port}"
        self._clock = clock
        self._timeout_s = timeout_s
        self._input = bytearray()
        try:
            self._socket = socket.create_connection((host, port), timeout_s)
        except TimeoutError as error:
            raise RigTimeout(f"instrument {self.name}: no connection within {timeout_s:g} s") from error
        except OSError as error:
            raise RigClosed(f"instrument {self.name}: cannot be reached: {error.strerror or error}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, *commands: str) -> None:
        """Commands without an answer, a line each."""
        try:
            self._socket.settimeout(self._timeout_s)
            self._socket.sendall("".join(f"{command}\r\n" for command in commands).encode("ascii"))
        except TimeoutError as error:
            raise RigTimeout(f"instrument {self.name}: took no command for {self._timeout_s:g} s") from error
        except OSError as error:
            raise RigClosed(f"instrument {self.name}: gone at {commands[0]}: {error.strerror or error}") from error

    def ask(self, query: str) -> str:
        """The one line of its answer, without its end."""
        self.send(query)
        return self.next_line(query)

    def next_line(self, query: str) -> str:
        """A further line of the answer to ``query``."""
        end = self._until(lambda: self._input.find(b"\n"), query)
        line = bytes(self._input[:end]).rstrip(b"\r")
        del self._input[: end + 1]
        return "".join(character if character.isprintable() else "?" for character in line.decode("ascii", "replace"))

    def ask_block(self, query: str) -> bytes:
        """The content of the definite-length block (IEEE 488.2, 8.7.9) that it answers."""
        self.send(query)
        self._need(2, query)
        head = bytes(self._input[:2])
        if head[:1] != b"#" or not head[1:].isdigit() or head == b"#0":
            raise RigError(f"instrument {self.name}: {query}: a block was due, {head!r} came")
        digits = int(head[1:])
        self._need(2 + digits, query)
        length = bytes(self._input[2 : 2 + digits])
        if not length.isdigit() or int(length) > _MOST_ANSWER_BYTES:
            raise RigError(f"instrument {self.name}: {query}: a block of {length!r} bytes cannot be")
        start, end = 2 + digits, 2 + digits + int(length)
        self._need(end, query)
        content = bytes(self._input[start:end])
        del self._input[:end]
        self.next_line(query)
        return content

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.close()

    def _need(self, count: int, query: str) -> None:
        self._until(lambda: count if len(self._input) >= count else -1, query)

    def _until(self, found: Callable[[], int], query: str) -> int:
        """Take what comes until ``found`` says where, no longer than the time-out."""
        deadline_s = self._clock() + self._timeout_s
        while (at := found()) < 0:
            if len(self._input) > 2 * _MOST_ANSWER_BYTES:
                raise RigError(f"instrument {self.name}: {query}: an answer without end")
            left_s = deadline_s - self._clock()
            if left_s <= 0.0:
                raise RigTimeout(f"instrument {self.name}: {query}: no whole answer within {self._timeout_s:g} s")
            self._socket.settimeout(left_s)
            try:
                received = self._socket.recv(65536)
            except TimeoutError as error:
                raise RigTimeout(f"instrument {self.name}: {query}: no answer within {self._timeout_s:g} s") from error
            except OSError as error:
                raise RigClosed(f"instrument {self.name}: gone at {query}: {error.strerror or error}") from error
            if not received:
                raise RigClosed(f"instrument {self.name}: hung up at {query}")
            self._input += received
        return at


class RedPitaya(Instrument):
    """Records of 16,384 samples, between which the instrument is blind for as long as they take to be read."""

    rate_hz = CLOCK_HZ / DECIMATION
    record_n = BUFFER_N
    bits = BITS
    inputs = (1, 2)
    output_v = (-1.0, 1.0)
    ranges_v = {"LV": (-1.0, 1.0), "HV": (-20.0, 20.0)}  # noqa: RUF012 - a constant, as its base has it

    def __init__(self, connection: ScpiConnection, timeout_s: float, clock: Clock = time.monotonic) -> None:
        """Take over ``connection`` and bring the instrument to a known state, the generator off.

        :raises RigError: it does not answer as one.
        """
        self._scpi = connection
        self._timeout_s = timeout_s
        self._clock = clock
        self._ranges: tuple[tuple[int, str], ...] = ()
        self._excitation = Excitation()
        self.name = f"instrument {connection.name}"
        self.make_safe()
        self._scpi.send("*CLS")
        self.pots = self._catalogue()

    @classmethod
    def open(cls, url: str, timeout_s: float) -> RedPitaya:
        """:raises RigError: nobody answers at ``redpitaya://HOST[:PORT]``."""
        address = parsed(url)
        connection = ScpiConnection(str(address.hostname), address.port or PORT, timeout_s)
        try:
            return cls(connection, timeout_s)
        except BaseException:
            connection.close()
            raise

    @classmethod
    def check(cls, excitation: Excitation) -> None:
        least_v, most_v = cls.output_v
        if excitation.low_v < least_v - _ROUNDING_V or excitation.high_v > most_v + _ROUNDING_V:
            raise ConfigurationError(
                f"the generator would have to give {excitation.low_v:g} V to {excitation.high_v:g} V, and has"
                f" {least_v:g} V to {most_v:g} V"
            )
        if excitation.shape == "prbs":
            raise ConfigurationError("the generator of a Red Pitaya has no prbs: say square or pulse")
        period_n = cls.rate_hz / excitation.frequency_hz
        if excitation.clock == "card" and not math.isclose(period_n, round(period_n), rel_tol=1e-12):
            raise ConfigurationError(
                f'{excitation.frequency_hz:g} Hz on the clock "card" need a period of whole samples, not {period_n:g}:'
                ' the generator\'s edges come when they come; say clock = "free"'
            )

    def set_inputs(self, ranges: Sequence[tuple[int, str]]) -> None:
        self._ranges = tuple(ranges)

    def set_excitation(self, excitation: Excitation) -> None:
        self._excitation = excitation

    def turn(self, pot: str, dial: float) -> None:
        self._scpi.send(f"POT{self._number(pot)}:DIAL {dial:.12g}")
        self._check(f"turning {pot} to {dial:.4g}")

    def rest(self, settle_s: float) -> None:
        """The samples that go by are taken and not looked at: so it is the computer's time that goes by."""
        self.make_safe()
        self._scpi.send("ACQ:RST", f"ACQ:DEC:Factor {DECIMATION}")
        delay_n = max(0, math.ceil(settle_s * self.rate_hz) - MIDDLE_N)
        self._scpi.send(f"ACQ:TRig:DLY {delay_n}", "ACQ:START", "ACQ:TRig NOW")
        self._await_record(settle_s)

    def record(
        self, samples: int, turns: Sequence[Turn] = (), while_recording: Callable[[], None] | None = None
    ) -> Recorded:
        self._prepare(turns)
        self._scpi.send("ACQ:START", "ACQ:TRig AWG_PE", "OUTPUT1:STATE ON", "SOUR1:TRig:INT")
        if while_recording is not None:
            while_recording()
        self._await_record(BUFFER_N / self.rate_hz)
        self._check("the record")
        self._check_alone(turns)
        volts = np.stack([self._volts(number) for number, _ in self._ranges], axis=1)
        self._check_filled(volts)
        lsb_v = np.array([self._lsb_v(word) for _, word in self._ranges])
        ends = np.array([self.ranges_v[word] for _, word in self._ranges])
        clipped = (volts <= ends[:, 0] + 0.5 * lsb_v) | (volts >= ends[:, 1] - 1.5 * lsb_v)
        return Recorded(volts[:samples], clipped[:samples])

    def make_safe(self) -> None:
        self._scpi.send("OUTPUT1:STATE OFF", "GEN:RST")
        self._scpi.ask("*IDN?")  # it has heard it

    def close(self) -> None:
        self._scpi.close()

    def _prepare(self, turns: Sequence[Turn]) -> None:
        excitation = self._excitation
        middle_v = 0.5 * (excitation.low_v + excitation.high_v)
        drift = 1.0 + 1e-6 * excitation.drift_ppm
        self._scpi.send(
            "GEN:RST",
            "ACQ:RST",
            f"SOUR1:FUNC {'SQUARE' if excitation.shape == 'square' else 'PWM'}",
            f"SOUR1:DCYC {excitation.duty:.12g}",
            f"SOUR1:FREQ:FIX {excitation.frequency_hz * drift:.15g}",
            f"SOUR1:VOLT {excitation.high_v - middle_v:.12g}",
            f"SOUR1:VOLT:OFFS {middle_v:.12g}",
            f"SOUR1:PHAS {360.0 * self._phase():.15g}",
            f"ACQ:DEC:Factor {DECIMATION}",
            "ACQ:AVG OFF",
            "ACQ:DATA:Units VOLTS",
            "ACQ:DATA:FORMAT BIN",
            *(f"ACQ:SOUR{number}:GAIN {word}" for number, word in self._ranges),
            f"ACQ:TRig:DLY {MIDDLE_N}",
        )
        if self.pots:
            scheduled = [f"POT:SCH {self._number(pot)},{dial:.12g},{delay_s:.12g}" for delay_s, pot, dial in turns]
            self._scpi.send("POT:SCH:CLE", *scheduled)
        self._check("the set-up of the record")

    def _phase(self) -> float:
        """Into a period at the first sample; on the card's clock the edges come with samples."""
        excitation = self._excitation
        if excitation.clock == "free":
            return excitation.phase
        period_n = round(self.rate_hz / excitation.frequency_hz)
        return (math.floor(excitation.phase * period_n) + _EARLY_N) / period_n

    def _await_record(self, lasting_s: float) -> None:
        """:raises RigTimeout: it is not full in its own time and the time-out."""
        deadline_s = self._clock() + lasting_s + self._timeout_s
        for query, wanted, what in (
            ("ACQ:TRig:STAT?", "TD", "was not triggered"),
            ("ACQ:TRig:FILL?", "1", "is not full"),
        ):
            while (answer := self._scpi.ask(query)) != wanted:
                if self._clock() > deadline_s:
                    self._check("the record")
                    raise RigTimeout(f"{self.name}: the record {what} in time: {query} says {answer[:20]!r}")
                time.sleep(_POLL_S)

    def _check_alone(self, turns: Sequence[Turn]) -> None:
        """:raises RigRefused: what was set for the record is not set any more: somebody else has the instrument too."""
        stand = {
            "OUTPUT1:STATE?": "ON",
            "ACQ:DEC:Factor?": str(DECIMATION),
            **({"POT:SCHedule:COUNt?": str(len(turns))} if self.pots else {}),
        }
        for query, wanted in stand.items():
            if (answer := self._scpi.ask(query)) not in (wanted, {"ON": "1"}.get(wanted, wanted)):
                raise RigRefused(
                    f"{self.name}: somebody else has changed it during the record: {query} says {answer[:20]!r}, not"
                    f" {wanted}"
                )
        frequency_hz = self._scpi.ask("SOUR1:FREQ:FIX?")
        wanted_hz = self._excitation.frequency_hz * (1.0 + 1e-6 * self._excitation.drift_ppm)
        if not _is_close(frequency_hz, wanted_hz):
            raise RigRefused(
                f"{self.name}: somebody else has changed it during the record: its generator gives {frequency_hz[:20]}"
                f" Hz, not {wanted_hz:g} Hz"
            )

    def _volts(self, number: int) -> NDArray[np.float64]:
        volts = np.frombuffer(self._scpi.ask_block(f"ACQ:SOUR{number}:DATA?"), ">f4").astype(np.float64)
        if len(volts) != BUFFER_N:
            raise RecordIncomplete(f"{self.name}: IN{number} gave {len(volts)} of {BUFFER_N} samples")
        if not np.isfinite(volts).all():
            raise RecordIncomplete(f"{self.name}: IN{number} gave samples that are no numbers")
        return volts

    def _check_filled(self, volts: NDArray[np.float64]) -> None:
        """:raises RecordIncomplete: a stretch of it was never written."""
        measured = np.flatnonzero((volts != 0.0).any(axis=1))
        marks = np.concatenate(([-1], measured, [BUFFER_N]))
        longest = int(np.argmax(np.diff(marks)))
        start, end = int(marks[longest]) + 1, int(marks[longest + 1])
        if end - start >= _ZEROS_N:
            raise RecordIncomplete(
                f"{self.name}: its buffer is not filled: nothing but zeros from sample {start} to {end - 1}"
            )

    def _lsb_v(self, word: str) -> float:
        low_v, high_v = self.ranges_v[word]
        return (high_v - low_v) / (1 << BITS)

    def _catalogue(self) -> tuple[str, ...]:
        """An instrument without a box of pots says nothing to the first question, or an error."""
        self._scpi.send("POT:CATalog?")
        answer = self._scpi.ask("*OPC?")
        if answer == "1":
            self._scpi.send("*CLS")
            return ()
        self._scpi.next_line("*OPC?")
        return () if answer.upper().startswith("ERR") else tuple(answer.split(","))

    def _number(self, pot: str) -> int:
        return self.pots.index(pot) + 1

    def _check(self, what: str) -> None:
        """:raises RigRefused: the instrument has put an error into its queue."""
        answer = self._scpi.ask("SYST:ERR?")
        if not answer.startswith(("0,", "+0,", "0 ")) and answer != "0":
            self._scpi.send("*CLS")
            raise RigRefused(f"{self.name}: {what}: it says {answer[:120]}")


def _is_close(answer: str, wanted: float) -> bool:
    try:
        return math.isclose(float(answer), wanted, rel_tol=1e-5)
    except ValueError:
        return False
