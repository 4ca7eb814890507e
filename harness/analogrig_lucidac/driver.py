"""Driver of a LUCIDAC: the computer, its signal generator, and eight channels of 16 bits, at 20 kS/s.

The driver patches the program itself; a cable leads from the square-wave output of the generator to port 2 of the front
panel. Converter channel 0 reads the input of the program, channel 1 its output. Coefficients change between runs: a
record with changes is played in several runs, each from the states that the converter read at the change. A machine may
accept coefficients during OP, which ``remarks`` asks for. Its answer has no time, so the sample of such a change would
be unknown by the delay of the network, many samples at 20 kS/s.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Program, RigError
from analogrig.links import Clock
from analogrig_emulator import EmulatorError, Excitation, SuspensionComputer
from analogrig_emulator.lucidac.configuration import Configuration, SignalGenerator
from analogrig_emulator.lucidac.lucidac_circuit import FULL_SCALE, UNIT_V
from analogrig_instruments import (
    DialChange,
    InputRecord,
    Instrument,
    InstrumentDatasheet,
    PotBox,
    check_edges,
    first_phase,
    host_and_port,
    tcp_place,
)
from analogrig_lucidac.connection import LucidacConnection
from analogrig_lucidac.linear_patch import LinearPatch, coefficients_of, module_of
from analogrig_lucidac.messages import PORT

if TYPE_CHECKING:
    from analogrig_instruments import TcpServer

_HALF_RANGE = 1 << 15
_MOST_INITIAL = 1.001
"""Largest state in machine units at a change: initial conditions end at 1, and the converter is noisy."""
_EARLY_N = 1e-3
"""Time from an edge of the generator to its first sample, in samples: the elements settle in 50 ns."""

_ACCEPTS = "the machine accepts coefficients during OP, but its answer tells no instant: a change is a new run"
_REFUSES = "the machine accepts no coefficients during OP: a change is a new run"

_ASLEEP = SignalGenerator("sine and square")


class LucidacInstrument(Instrument):
    """LUCIDAC with records of any number of samples."""

    datasheet = InstrumentDatasheet(
        rate_hz=20e3,
        record_n=1_000_000,
        bits=16,
        inputs=(0, 1),
        output_v=(-UNIT_V, UNIT_V),
        ranges_v={"unit": (-FULL_SCALE * UNIT_V, FULL_SCALE * UNIT_V)},
    )

    form = "HOST[:PORT]"
    served_port = PORT

    def __init__(self, connection: LucidacConnection) -> None:
        """Take over ``connection``.

        :raises RigError: the answers are not those of a LUCIDAC.
        """
        super().__init__(f"instrument {connection.name}")
        self._connection = connection
        self._mac = connection.carrier()
        self._patched: LinearPatch | None = None
        self._box: _Coefficients | None = None
        self._accepts_in_op: bool | None = None
        """Answer to the question of ``remarks``."""

    @classmethod
    def place(cls, address: str) -> str:
        return tcp_place(address, PORT)

    @classmethod
    def emulated(
        cls, rig: str | None, program: str | None, seed: int, defects: Sequence[str], clock: Clock | None
    ) -> tuple[TcpServer, Mapping[str, str]]:
        from analogrig_lucidac.served_machine import LucidacServer, specimen

        if rig or program:
            option = "--rig" if rig else "--program"
            raise ConfigurationError(f"{option}: a LUCIDAC gets its program from its client: leave out {option}")
        return LucidacServer(specimen(seed, defects), clock), {"rig": "lucidac", "program": ""}

    @classmethod
    def open(cls, address: str, timeout_s: float, clock: Clock = time.monotonic) -> LucidacInstrument:
        """:raises RigError: the connection failed."""
        connection = LucidacConnection(*host_and_port(address, PORT), timeout_s, clock)
        try:
            return cls(connection)
        except BaseException:
            connection.close()
            raise

    @classmethod
    def check(cls, excitation: Excitation) -> None:
        super().check(excitation)
        if excitation.shape != "square":
            raise ConfigurationError(f"the generator of a LUCIDAC has no {excitation.shape}: use square")
        check_edges(excitation, cls.datasheet.rate_hz)

    def patch(self, program: str) -> None:
        self._patched = LinearPatch(Program.load(program))
        self._box = self.pots = _Coefficients(self._patched, self.name)

    def remarks(self) -> tuple[str, ...]:
        """Ask once, by a run during which the coefficients are written again with the values that they have."""
        if self._patched is None or self._box is None:
            return ()
        if self._accepts_in_op is None:
            self.make_safe()
            coefficients = coefficients_of(self._at_rest(self._patched, self._box), self._mac)
            self._accepts_in_op = self._connection.accepts_in_op(coefficients, 1 + len(self._patched.states))
        return (_ACCEPTS if self._accepts_in_op else _REFUSES,)

    def rest(self, settle_s: float) -> None:
        """Wait for nothing: every run begins at the initial conditions."""

    def make_safe(self) -> None:
        if self._patched is not None and self._box is not None:
            at_rest = self._at_rest(self._patched, self._box)
            self._connection.ask("config_command", module=module_of(at_rest, self._mac), reset_before=True)

    def _at_rest(self, patched: LinearPatch, box: _Coefficients) -> Configuration:
        return patched.configuration(box.values(), [0.0] * len(patched.states), _ASLEEP)

    def close(self) -> None:
        self._connection.close()

    def _take(self, samples: int, while_recording: Callable[[], None] | None) -> InputRecord:
        if self._patched is None or self._box is None:
            raise RigError(f"{self.name}: no program is patched")
        self._connection.ask("reset_command", keep_calibration=True, overload_reset=True)
        columns = [0, 1 + self._patched.output]
        channels = [columns[number] for number, _ in self._ranges]
        signs = np.array([-1.0 if channel == 0 else 1.0 for channel in channels])
        values, ends = self._play(self._patched, self._box, samples)
        if while_recording is not None:
            while_recording()
        measured = signs * values[:, channels]
        codes = np.clip(np.rint(measured / (FULL_SCALE / _HALF_RANGE)), -_HALF_RANGE, _HALF_RANGE - 1).astype(np.int32)
        at_end = ends[:, channels]
        codes[at_end] = np.where(measured[at_end] < 0.0, -_HALF_RANGE, _HALF_RANGE - 1)
        return InputRecord(measured * UNIT_V, codes, self.datasheet.bits)

    def _play(
        self, patched: LinearPatch, box: _Coefficients, samples: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Play runs from change to change. Return values in machine units and ends of the range, (samples, channels).

        The first sample of a run is the last one of the run before.
        """
        rate_hz, states = self.datasheet.rate_hz, len(patched.states)
        cuts, late = box.take_schedule(samples, rate_hz)
        initial: NDArray[np.float64] = np.zeros(states)
        values, ends = [], []
        for i, (start, dials) in enumerate(cuts):
            box.set_all(dials)
            stop = cuts[i + 1][0] if i + 1 < len(cuts) else samples - 1
            self._configure(patched.configuration(box.values(), initial.tolist(), self._generator(start)))
            taken, at_end = self._connection.run(stop + 1 - start, int(rate_hz), states + 1)
            if overloaded := self._connection.overloads():
                raise RigError(
                    f"{self.name}: overload of {', '.join(overloaded[:4])} in samples {start} to {stop}:"
                    " rescale the program"
                )
            for name, value in zip(patched.states, taken[-1, 1:], strict=True):
                if start != cuts[-1][0] and abs(value) > _MOST_INITIAL:
                    raise RigError(
                        f"{self.name}: state {name} stands at {value:.3f} machine units at the"
                        " change, and no run begins beyond 1: lower the levels of the excitation"
                    )
            initial = np.clip(taken[-1, 1:], -1.0, 1.0)
            first = 1 if i else 0
            values.append(taken[first:])
            ends.append(at_end[first:])
        box.set_all(late)
        return np.concatenate(values), np.concatenate(ends)

    def _configure(self, configuration: Configuration) -> None:
        """Configure and calibrate. :raises RigError: another client has changed the configuration meanwhile."""
        self._connection.ask("config_command", module=module_of(configuration, self._mac), reset_before=True)
        configured = self._connection.configuration()
        self._calibrate()
        if self._connection.configuration() != configured:
            raise RigError(
                f"{self.name}: another client has changed the configuration: let only one work with the machine"
            )

    def _calibrate(self) -> None:
        self._connection.ask("calibration_command", config={"gain": "Enabled", "offset": "Enabled"})

    def _generator(self, sample: int) -> SignalGenerator:
        """Generator of a run that begins at a sample of the record."""
        excitation, rate_hz = self._excitation, self.datasheet.rate_hz
        periods = first_phase(excitation, rate_hz, _EARLY_N) + sample / rate_hz * excitation.true_frequency_hz
        return SignalGenerator(
            "sine and square",
            excitation.true_frequency_hz,
            360.0 * (periods % 1.0),
            square=(excitation.low_v / UNIT_V, excitation.high_v / UNIT_V),
            sleep=False,
        )


class _Coefficients(PotBox):
    """Coefficients of a program's parameters, set as if they were the pots of a computer with that program."""

    def __init__(self, patch: LinearPatch, name: str) -> None:
        self._patch = patch
        self._name = name
        self._computer = SuspensionComputer(patch.program.circuit)
        self.names = tuple(self._computer.dials)
        self._changes: tuple[DialChange, ...] = ()

    def set_one(self, pot: str, dial: float) -> None:
        self.set_all({pot: dial})

    def set_all(self, dials: Mapping[str, float]) -> None:
        """Set pots. :raises RigError: one cannot stand there."""
        self._turn(self._computer, dials)

    def standing(self, dials: Mapping[str, float]) -> dict[str, float]:
        computer = SuspensionComputer(self._patch.program.circuit)
        self._turn(computer, {**self._computer.dials, **dials})
        return computer.dials_for(**self._patch.rounded(self._values(computer)))

    def values(self) -> dict[str, float]:
        """Present values of the parameters."""
        return self._values(self._computer)

    def _turn(self, computer: SuspensionComputer, dials: Mapping[str, float]) -> None:
        try:
            computer.set(**{f"{pot}_dial": dial for pot, dial in dials.items()})
        except EmulatorError as error:
            raise RigError(f"{self._name}: {error}") from error

    def _values(self, computer: SuspensionComputer) -> dict[str, float]:
        program = self._patch.program
        shown = program.values_at(computer.coefficients)
        return {name: shown.get(name, row.value) for name, row in program.parameters.items()}

    def schedule(self, changes: Sequence[DialChange]) -> None:
        self._changes = tuple(changes)

    def take_schedule(
        self, samples: int, rate_hz: float
    ) -> tuple[list[tuple[int, dict[str, float]]], dict[str, float]]:
        """Samples at which runs begin, with their new dials, and dials that change after the last sample.

        The schedule is empty then.
        """
        cuts: dict[int, dict[str, float]] = {0: {}}
        late: dict[str, float] = {}
        for delay_s, pot, dial in sorted(self._changes):
            sample = math.floor(delay_s * rate_hz)
            (cuts.setdefault(sample, {}) if sample < samples - 1 else late)[pot] = dial
        self._changes = ()
        return sorted(cuts.items()), late
