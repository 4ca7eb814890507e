"""Stand-in for the parts of NI's Python package nidaqmx that the driver uses; the package needs NI's driver.

Names and arguments are those of nidaqmx 1.7 (https://github.com/ni/nidaqmx-python).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator import TICKS_PER_SAMPLE, Edges, Excitation, SuspensionComputer, preset
from analogrig_instruments.ni_daqmx import LEVELS_PER_SAMPLE


class Error(Exception):
    """Base of nidaqmx's errors; raised without a code if NI's driver is not installed."""


class DaqError(Error):
    """Error with a code and a message of several lines."""

    def __init__(self, message: str, error_code: int) -> None:
        super().__init__(message)
        self.error_code = error_code


@dataclass
class Card:
    """Card whose ao0 drives an ideal computer, and whose inputs measure force and displacement."""

    bits: int = 16
    reach: float = 0.0
    """Relative excess of the converter's range."""
    noise_v: float = 0.0
    gain: float = 1.0
    """Gain between the computer and each input."""
    lost_n: int = 0
    failing: Error | None = None
    """Error raised when a task is started."""
    stale: bool = False
    """True: each record repeats the first."""
    done: list[tuple[Any, ...]] = field(default_factory=list)
    output_v: float = 0.0
    levels: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(1)
        self._last: NDArray[np.int64] | None = None

    @property
    def lsb_v(self) -> float:
        """Volts per code in the range +-10 V."""
        return 20.0 / (1 << self.bits) * (1.0 + self.reach)

    def measured(self, samples: int) -> NDArray[np.int64]:
        """Codes, (2, n)."""
        if self._last is None or not self.stale:
            computer = SuspensionComputer("front", opamp=preset("ideal"), sample_rate_hz=20e3)
            volts = self.gain * np.concatenate(list(computer.play(_Played(np.array(self.levels)), samples)))[:, :2]
            volts += self.noise_v * self._rng.standard_normal(volts.shape)
            end = 1 << (self.bits - 1)
            self._last = np.clip(np.rint(volts / self.lsb_v), -end, end - 1).astype(np.int64).T
        return self._last[:, : samples - self.lost_n]


class _Played(Excitation):
    """Excitation with the levels written to the card."""

    def __init__(self, levels: NDArray[np.float64]) -> None:
        super().__init__()
        object.__setattr__(self, "levels", levels)

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Any:  # noqa: ARG002 - as its base
        each = TICKS_PER_SAMPLE // LEVELS_PER_SAMPLE
        first, last = -(-start_tick // each), -(-stop_tick // each)
        at = np.arange(first, min(last, len(self.levels)))  # type: ignore[attr-defined]
        return Edges(at * each, self.levels[at])  # type: ignore[attr-defined]


class Task:
    """Task of nidaqmx; its channels, timing, triggers and stream are the task itself."""

    def __init__(self, card: Card) -> None:
        self.card = card
        self.ao_channels = self.ai_channels = self.timing = self.triggers = self.start_trigger = self.in_stream = self

    def _note(self, what: str, *args: Any, **kwargs: Any) -> None:
        self.card.done.append((what, *args, *kwargs.values()))

    def add_ao_voltage_chan(self, *args: Any, **kwargs: Any) -> None:
        self._note("ao", *args, **kwargs)

    def add_ai_voltage_chan(self, *args: Any, **kwargs: Any) -> SimpleNamespace:
        self._note("ai", *args, **kwargs)
        coefficients = [0.0, self.card.lsb_v, 0.0, 0.0]
        return SimpleNamespace(ai_resolution=float(self.card.bits), ai_dev_scaling_coeff=coefficients)

    def cfg_samp_clk_timing(self, *args: Any, **kwargs: Any) -> None:
        self._note("clock", *args, **kwargs)

    def cfg_dig_edge_start_trig(self, *args: Any) -> None:
        self._note("trigger", *args)

    def start(self) -> None:
        if self.card.failing is not None:
            raise self.card.failing

    def write(self, data: Any, **_: Any) -> None:
        if isinstance(data, float):
            self.card.output_v = data
        else:
            self.card.levels, self.card.output_v = data, data[-1]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class AnalogUnscaledReader:
    def __init__(self, task_in_stream: Task) -> None:
        self._card = task_in_stream.card

    def read_int16(self, data: NDArray[np.int16], number_of_samples_per_channel: int, timeout: float) -> int:
        assert data.dtype == np.int16
        assert timeout > number_of_samples_per_channel / 20e3
        codes = self._card.measured(number_of_samples_per_channel)
        data[:, : codes.shape[1]] = codes
        return int(codes.shape[1])


def library(card: Card) -> ModuleType:
    """Module nidaqmx for a card."""
    module = ModuleType("nidaqmx")
    vars(module).update(
        Task=lambda: Task(card),
        errors=SimpleNamespace(Error=Error),
        constants=SimpleNamespace(AcquisitionType=SimpleNamespace(FINITE="finite")),
        stream_readers=SimpleNamespace(AnalogUnscaledReader=AnalogUnscaledReader),
    )
    return module
