"""Driver of multifunction cards of National Instruments through NI-DAQmx: generator at ao0, inputs at ai0 to ai7.

The URL ``nidaqmx://Dev1`` has the card's name in NI MAX; simulated cards work too. The driver needs the extra
``analogrig[nidaqmx]`` and NI's own driver. Output and inputs start together on one timebase. The output has
LEVELS_PER_SAMPLE levels a sample, so that edges on the clock "free" are exact to 1/32 sample. Few cards sample their
inputs at the same instant; the self-test measures the skew. Tasks, timing and triggers follow
https://nidaqmx-python.readthedocs.io.
"""

from __future__ import annotations

import contextlib
import importlib
import re
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError
from analogrig.errors import RigClosed, RigRefused, RigTimeout
from analogrig_emulator import TICKS_PER_SAMPLE, Excitation
from analogrig_instruments.instrument import InputRecord, Instrument, InstrumentDatasheet

RATE_HZ = 20e3
LEVELS_PER_SAMPLE = 32

_TIMED_OUT = (-200284, -200292, -200474, -200560)
_GONE = (-200220, -201003, -88705)
"""Error codes of nidaqmx.error_codes: samples not yet available, not yet acquired, operation or task timed out; device
invalid, inaccessible, not present."""


class NiDaqmx(Instrument):
    """Card that takes each record as one finite task; it has no pots."""

    datasheet = InstrumentDatasheet(
        rate_hz=RATE_HZ,
        record_n=100_000,
        bits=16,
        inputs=tuple(range(8)),
        output_v=(-10.0, 10.0),
        ranges_v={f"{volts}V": (-float(volts), float(volts)) for volts in (10, 5, 2, 1)},
    )

    def __init__(self, library: Any, card: str, timeout_s: float, pause: Callable[[float], None] = time.sleep) -> None:
        """``library`` is the module nidaqmx.

        :raises RigError: the card is not present.
        """
        super().__init__(f"instrument {card}")
        self._library = library
        self._card = card
        self._timeout_s = timeout_s
        self._pause = pause
        self.make_safe()

    form = "CARD"

    @classmethod
    def place(cls, address: str) -> str:
        return f"nidaqmx://{address}" if re.fullmatch(r"[A-Za-z0-9][\w-]*", address) else ""

    @classmethod
    def open(cls, address: str, timeout_s: float) -> NiDaqmx:
        """:raises ConfigurationError: the package nidaqmx or NI's driver is not installed.
        :raises RigError: the card is not present.
        """
        try:
            library = importlib.import_module("nidaqmx")
            for part in ("constants", "errors", "stream_readers"):
                importlib.import_module(f"nidaqmx.{part}")
        except ImportError as error:
            raise ConfigurationError(
                f"instrument {address}: needs nidaqmx: pip install 'analogrig[nidaqmx]'"
            ) from error
        return cls(library, address, timeout_s)

    def _take(self, samples: int, while_recording: Callable[[], None] | None) -> InputRecord:
        with self._errors("the record"), self._library.Task() as out, self._library.Task() as taken:
            inputs = self._configure(out, taken, samples)
            out.write(levels_v(self._excitation, samples).tolist(), auto_start=False)
            out.start()  # waits for the start trigger of the inputs
            taken.start()
            if while_recording is not None:
                while_recording()
            codes = self._codes(taken, inputs, samples)
            volts = [
                np.polynomial.polynomial.polyval(of_input, each.ai_dev_scaling_coeff)
                for each, of_input in zip(inputs, codes, strict=True)
            ]
            return InputRecord(np.stack(volts, axis=1), codes.T, _bits(inputs))

    def _codes(self, taken: Any, inputs: Sequence[Any], samples: int) -> NDArray[np.signedinteger]:
        """Codes of the converters, (inputs, m); m is less than ``samples`` if some were lost."""
        reader = self._library.stream_readers.AnalogUnscaledReader(taken.in_stream)
        is_short = _bits(inputs) <= np.iinfo(np.int16).bits
        codes = np.zeros((len(inputs), samples), np.int16 if is_short else np.int32)
        read = reader.read_int16 if is_short else reader.read_int32
        got = read(codes, number_of_samples_per_channel=samples, timeout=samples / RATE_HZ + self._timeout_s)
        return codes[:, :got]

    def rest(self, settle_s: float) -> None:
        self.make_safe()
        self._pause(settle_s)

    def make_safe(self) -> None:
        with self._errors("0 V at ao0"), self._library.Task() as out:
            self._add_output(out)
            out.write(0.0, auto_start=True, timeout=self._timeout_s)

    def close(self) -> None:
        """Do nothing: each task is closed when it is done."""

    def _add_output(self, out: Any) -> None:
        low_v, high_v = self.datasheet.output_v
        out.ao_channels.add_ao_voltage_chan(f"{self._card}/ao0", min_val=low_v, max_val=high_v)

    def _configure(self, out: Any, taken: Any, samples: int) -> list[Any]:
        """Configure both tasks. Return the input channels of nidaqmx."""
        finite = self._library.constants.AcquisitionType.FINITE
        self._add_output(out)
        inputs = []
        for number, word in self._ranges:
            low_v, high_v = self.datasheet.ranges_v[word]
            inputs.append(
                taken.ai_channels.add_ai_voltage_chan(f"{self._card}/ai{number}", min_val=low_v, max_val=high_v)
            )
        for task, per_sample in ((taken, 1), (out, LEVELS_PER_SAMPLE)):
            rate_hz, count = per_sample * RATE_HZ, per_sample * samples
            task.timing.cfg_samp_clk_timing(rate_hz, sample_mode=finite, samps_per_chan=count)
        out.triggers.start_trigger.cfg_dig_edge_start_trig(f"/{self._card}/ai/StartTrigger")
        return inputs

    @contextlib.contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        """Convert NI's errors. Their first line is the reason; they have a code unless NI's driver is missing."""
        try:
            yield
        except self._library.errors.Error as error:
            message = f"{self.name}: {what}: {str(error).strip().partition(chr(10))[0]}"
            code = getattr(error, "error_code", None)
            if code is None:
                raise ConfigurationError(message) from error
            kind = RigTimeout if code in _TIMED_OUT else RigClosed if code in _GONE else RigRefused
            raise kind(message) from error


def _bits(inputs: Sequence[Any]) -> int:
    return max(int(each.ai_resolution) for each in inputs)


def levels_v(excitation: Excitation, samples: int) -> NDArray[np.float64]:
    """Levels of the output at even intervals from the first sample on, (samples * LEVELS_PER_SAMPLE,)."""
    edges = excitation.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)
    ticks = np.arange(samples * LEVELS_PER_SAMPLE, dtype=np.int64) * (TICKS_PER_SAMPLE // LEVELS_PER_SAMPLE)
    return np.asarray(edges.levels_v[np.searchsorted(edges.ticks, ticks, side="right") - 1])
