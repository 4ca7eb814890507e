"""A multifunction card of National Instruments through NI-DAQmx: generator at ao0, inputs at ai0 to ai7.

``nidaqmx://Dev1``, the card's name in NI MAX; simulated cards too. Needs the extra ``analogrig[nidaqmx]`` and NI's
driver. Output and inputs begin together and have one timebase; the output is written LEVELS_PER_SAMPLE times a sample,
so that edges of a generator on a clock of its own come to within 1/32 of one. Few cards sample their inputs at the same
instant: the self-test says by how much they do not. Task, timing and triggers after NI's Python documentation
(https://nidaqmx-python.readthedocs.io).
"""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.excitation import TICKS_PER_SAMPLE, Excitation
from harness.errors import ConfigurationError, RecordIncomplete, RigError
from harness.rigs.instrument import Instrument, Recorded, Turn, parsed

RATE_HZ = 20e3
RECORD_N = 100_000
LEVELS_PER_SAMPLE = 32


class NiDaqmx(Instrument):
    """One record is one finite task; the card has no pots."""

    rate_hz = RATE_HZ
    record_n = RECORD_N
    bits = 16
    inputs = tuple(range(8))
    output_v = (-10.0, 10.0)
    ranges_v = {f"{volts}V": (-float(volts), float(volts)) for volts in (10, 5, 2, 1)}  # noqa: RUF012 - a constant

    def __init__(self, library: Any, card: str, timeout_s: float, pause: Callable[[float], None] = time.sleep) -> None:
        """``library`` is the module nidaqmx.

        :raises RigError: the card is not there.
        """
        self.name = f"instrument {card}"
        self._library = library
        self._card = card
        self._timeout_s = timeout_s
        self._pause = pause
        self._ranges: tuple[tuple[int, str], ...] = ()
        self._excitation = Excitation()
        self.make_safe()

    @classmethod
    def open(cls, url: str, timeout_s: float) -> NiDaqmx:
        """:raises ConfigurationError: the package nidaqmx is not installed.
        :raises RigError: the card is not there, or NI's driver is not.
        """
        try:
            library = importlib.import_module("nidaqmx")
            importlib.import_module("nidaqmx.constants")
            importlib.import_module("nidaqmx.errors")
        except ImportError as error:
            raise ConfigurationError(f"instrument {url}: needs nidaqmx: pip install 'analogrig[nidaqmx]'") from error
        return cls(library, parsed(url).netloc, timeout_s)  # its hostname would be in small letters

    @classmethod
    def check(cls, excitation: Excitation) -> None:
        least_v, most_v = cls.output_v
        if not least_v <= excitation.low_v <= excitation.high_v <= most_v:
            raise ConfigurationError(
                f"the generator would have to give {excitation.low_v:g} V to {excitation.high_v:g} V, and has"
                f" {least_v:g} V to {most_v:g} V"
            )

    def set_inputs(self, ranges: Sequence[tuple[int, str]]) -> None:
        self._ranges = tuple(ranges)

    def set_excitation(self, excitation: Excitation) -> None:
        self._excitation = excitation

    def record(
        self, samples: int, turns: Sequence[Turn] = (), while_recording: Callable[[], None] | None = None
    ) -> Recorded:
        if turns:
            raise RigError(f"{self.name}: has no pots that it could turn")
        with self._errors("the record"), self._library.Task() as out, self._library.Task() as taken:
            self._wire(out, taken, samples)
            out.write(levels_v(self._excitation, samples).tolist(), auto_start=False)
            out.start()  # it waits for the inputs to start
            taken.start()
            if while_recording is not None:
                while_recording()
            read = taken.read(number_of_samples_per_channel=samples, timeout=samples / RATE_HZ + self._timeout_s)
        volts = np.array(read, dtype=np.float64).reshape(len(self._ranges), -1).T
        if volts.shape[0] != samples:
            raise RecordIncomplete(f"{self.name}: gave {volts.shape[0]} of {samples} samples")
        ends = np.array([self.ranges_v[word] for _, word in self._ranges])
        lsb_v = (ends[:, 1] - ends[:, 0]) / (1 << self.bits)
        return Recorded(volts, (volts <= ends[:, 0] + 0.5 * lsb_v) | (volts >= ends[:, 1] - 1.5 * lsb_v))

    def rest(self, settle_s: float) -> None:
        """In the card's case the computer's time is that of the clock on the wall."""
        self.make_safe()
        self._pause(settle_s)

    def make_safe(self) -> None:
        with self._errors("0 V at ao0"), self._library.Task() as out:
            out.ao_channels.add_ao_voltage_chan(f"{self._card}/ao0", min_val=self.output_v[0], max_val=self.output_v[1])
            out.write(0.0, auto_start=True, timeout=self._timeout_s)

    def close(self) -> None:
        """Tasks are closed when they are done."""

    def _wire(self, out: Any, taken: Any, samples: int) -> None:
        finite = self._library.constants.AcquisitionType.FINITE
        out.ao_channels.add_ao_voltage_chan(f"{self._card}/ao0", min_val=self.output_v[0], max_val=self.output_v[1])
        for number, word in self._ranges:
            low_v, high_v = self.ranges_v[word]
            taken.ai_channels.add_ai_voltage_chan(f"{self._card}/ai{number}", min_val=low_v, max_val=high_v)
        for task, per_sample in ((taken, 1), (out, LEVELS_PER_SAMPLE)):
            rate_hz, count = per_sample * RATE_HZ, per_sample * samples
            task.timing.cfg_samp_clk_timing(rate_hz, sample_mode=finite, samps_per_chan=count)
        out.triggers.start_trigger.cfg_dig_edge_start_trig(f"/{self._card}/ai/StartTrigger")

    @contextlib.contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        """NI's errors have many lines; the first says what is the matter."""
        try:
            yield
        except self._library.errors.Error as error:
            first = str(error).strip().partition("\n")[0]
            raise RigError(f"{self.name}: {what}: {first}") from error


def levels_v(excitation: Excitation, samples: int) -> NDArray[np.float64]:
    """(samples * LEVELS_PER_SAMPLE,): of the output, evenly in time; the first is that of the first sample."""
    edges = excitation.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)
    ticks = np.arange(samples * LEVELS_PER_SAMPLE, dtype=np.int64) * (TICKS_PER_SAMPLE // LEVELS_PER_SAMPLE)
    return np.asarray(edges.levels_v[np.searchsorted(edges.ticks, ticks, side="right") - 1])
