"""The C estimator in this process: whole blocks of samples, without frames and link."""

from __future__ import annotations

import ctypes
import dataclasses
import enum
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analogrig.answers import Answers, Samples, raised_alarms
from analogrig.catalogue import SteppedFlag, Trigger
from analogrig.datasheet import Datasheet
from analogrig.devices.device import Device
from analogrig.devices.library import LIBRARY, load_library
from analogrig.devices.pace import Pace
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from analogrig.run import Channel

if TYPE_CHECKING:
    from analogrig.devices.catalogue_device import CatalogueDescription


class StepStatus(enum.IntEnum):
    """est_status_t of est.h."""

    UPDATED = 0
    MISSING = 1
    REFUSED = 2
    GATHERING = 3
    OUTLIER = 4


_FLAGS = bytes((0, SteppedFlag.MISSING, SteppedFlag.REFUSED, SteppedFlag.GATHERING)).ljust(256, b"\0")
"""Flags of a Run by StepStatus, as a table of bytes: to look them up in an array takes several times as long."""


@dataclass(frozen=True, eq=False)
class EstimatorOutput:
    """Output of the estimator for n samples."""

    theta: NDArray[np.float32]
    """(n, p) after each sample; (n, 0) if it was not asked for."""
    innovation: NDArray[np.float32]
    """(n,) codes; 0 where there was no equation."""
    statistic: NDArray[np.float32]
    """(n,)"""
    status: NDArray[np.uint8]
    """(n,) StepStatus."""
    alarms: NDArray[np.int64]
    """Indices of the samples with an alarm."""

    @property
    def flags(self) -> NDArray[np.uint8]:
        """(n,): flags of a Run for each status."""
        return np.frombuffer(self.status.tobytes().translate(_FLAGS), np.uint8)


_Arrays = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_]]

_NO_ALARMS = np.empty(0, np.int64)


class _Out(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("theta", "innovation", "statistic", "status", "alarm")]


_COUNTERS = dict.fromkeys(("updated", "missing"), ctypes.c_uint32) | dict.fromkeys(
    ("refused", "saturated", "stuck", "alarms", "restarts", "slips", "refreshes", "outliers"), ctypes.c_uint16
)
"""Fields of est_counters_t with their C types."""

REPORTED = [name for name in _COUNTERS if name != "outliers"]
"""Counters that devices report, the first ones: no message has the outliers."""


_COUNTERS_TYPE = np.dtype(list(_COUNTERS.items()), align=True)
"""The C type est_counters_t."""


class _Counters(ctypes.Structure):
    _fields_ = list(_COUNTERS.items())


_FUNCTIONS = ("size", "init", "set", "start", "run", "run_codes", "run_records", "theta_count", "counters")
"""Functions of estimator_c/ports/library/library.h, without their prefix."""


def _load(library: Path) -> ctypes.CDLL:
    c = load_library(library, (f"library_{does}" for does in _FUNCTIONS))
    c.library_size.restype = c.library_run.restype = ctypes.c_size_t
    c.library_run.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *(ctypes.c_void_p,) * 3, ctypes.POINTER(_Out)]
    c.library_run_codes.restype = ctypes.c_size_t
    c.library_run_codes.argtypes = [
        ctypes.c_void_p,
        *(ctypes.c_size_t,) * 2,
        *(ctypes.c_void_p,) * 3,
        ctypes.POINTER(_Out),
    ]
    c.library_start.restype = c.library_run_records.restype = ctypes.c_bool
    c.library_run_records.argtypes = [
        ctypes.c_void_p,
        *(ctypes.c_size_t,) * 3,
        *(ctypes.c_void_p,) * 3,
        ctypes.POINTER(_Out),
        ctypes.c_void_p,
    ]
    c.library_theta_count.restype = ctypes.c_uint8
    c.library_counters.restype = _Counters
    return c


class Estimator:
    """One estimator, fed in blocks of any length."""

    def __init__(self, config: EstimatorConfig | None = None, *, library: Path = LIBRARY) -> None:
        """Configure an estimator for its first sample.

        :raises ConfigurationError: it rejects the configuration, or the user's library is not one of a device.
        :raises LinkError: the library was not built.
        """
        self._c = _load(library)
        self._state = ctypes.create_string_buffer(self._c.library_size())
        self._c.library_init(self._state)
        for key, value in (config or EstimatorConfig()).settings():
            if self._c.library_set(self._state, int(key), ctypes.c_float(value)):
                raise ConfigurationError(f"the estimator refuses {key.name.lower()} = {value:g}")
        self.restart()

    def restart(self) -> None:
        """Begin anew with the next sample.

        :raises ConfigurationError: the fields of the configuration do not go together.
        """
        if not self._c.library_start(self._state):
            self._refuse()

    def _refuse(self) -> NoReturn:
        raise ConfigurationError("the estimator refuses this configuration: its fields do not go together")

    @property
    def parameters(self) -> int:
        """Number of elements of theta."""
        return int(self._c.library_theta_count(self._state))

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters since the start, by their names in est_counters_t, as far as devices report them."""
        counters = self._c.library_counters(self._state)
        return {name: int(getattr(counters, name)) for name in REPORTED}

    def run(
        self, u: ArrayLike, y: ArrayLike, valid: ArrayLike | None = None, *, with_theta: bool = True
    ) -> EstimatorOutput:
        """Estimator output for n samples.

        :param u: (n,) codes of force.
        :param y: (n,) codes of displacement.
        :param valid: (n,) false where the sample is missing.
        :param with_theta: False: omit theta, which takes a tenth of the time.
        :raises ValueError: u, y and valid differ in length.
        """
        u, y = np.asarray(u), np.asarray(y)
        mask = None if valid is None else np.ascontiguousarray(valid, dtype=np.uint8)
        if u.ndim != 1 or u.shape != y.shape or (mask is not None and mask.shape != u.shape):
            raise ValueError("u, y and valid must be one-dimensional and of one length")
        n = len(u)
        arrays, out = self._room((n,), with_theta=with_theta)
        valid_at = None if mask is None else mask.ctypes.data
        if u.dtype == y.dtype == np.uint16 and u.strides == y.strides and u.strides[0] > 0:
            where = (u.strides[0] // u.itemsize, u.ctypes.data, y.ctypes.data, valid_at)
            alarms_n = self._c.library_run_codes(self._state, n, *where, ctypes.byref(out))
        else:
            u, y = (np.ascontiguousarray(x, dtype=np.float32) for x in (u, y))
            alarms_n = self._c.library_run(self._state, n, u.ctypes.data, y.ctypes.data, valid_at, ctypes.byref(out))
        return EstimatorOutput(*arrays[:-1], np.flatnonzero(arrays[-1]) if alarms_n else _NO_ALARMS)

    def run_records(
        self, u: NDArray[np.uint16], y: NDArray[np.uint16], valid: NDArray[np.bool_], *, with_theta: bool = True
    ) -> Iterator[tuple[EstimatorOutput, Mapping[str, int]]]:
        """Output for each of r records of n samples, with the counters of the record. It restarts before each.

        :param u: (r, n) contiguous codes of force; y and valid likewise, as of ``run``.
        """
        arrays, out = self._room(u.shape, with_theta=with_theta)
        counters = np.empty(len(u), _COUNTERS_TYPE)
        codes = [array.ctypes.data for array in (u, y, valid)]
        if not self._c.library_run_records(self._state, *u.shape, 1, *codes, ctypes.byref(out), counters.ctypes.data):
            self._refuse()
        for theta, innovation, statistic, status, alarm, counted in zip(*arrays, counters.tolist(), strict=True):
            output = EstimatorOutput(theta, innovation, statistic, status, np.flatnonzero(alarm))
            yield output, dict(zip(REPORTED, counted, strict=False))

    def _room(self, shape: tuple[int, ...], *, with_theta: bool) -> tuple[_Arrays, _Out]:
        """Arrays for theta, innovation, statistic, status and alarm of samples of this shape."""
        arrays = (
            np.empty((*shape, self.parameters if with_theta else 0), np.float32),
            np.empty(shape, np.float32),
            np.empty(shape, np.float32),
            np.empty(shape, np.uint8),
            np.empty(shape, np.bool_),
        )
        return arrays, _Out(*(array.ctypes.data if array.size else None for array in arrays))


class DirectDevice(Device):
    """Estimator of a device of our catalogue that has the capability ``blocks``, without its line.

    Its answers are those of ``CatalogueDevice`` to the bit. It lacks what other messages carry: the diagnoses,
    the misfits, the flags RESTARTED and IDLE, and the counters of messages.
    """

    def __init__(self, description: CatalogueDescription, *, alarms_only: bool = False) -> None:
        """Load and configure the estimator.

        :param alarms_only: omit the estimates, which take a twentieth of the time: theta has no columns.
        :raises ConfigurationError: the estimator refuses its configuration.
        :raises LinkError: the library was not built.
        """
        super().__init__(description)
        self._description: CatalogueDescription = description
        self._as_opened = description.estimator
        self._alarms_only = alarms_only
        self._next_index = 0
        self._poles: Sequence[complex] | None = None
        """Order for which the settings were chosen last: to choose them takes as long as to play a thousand samples."""
        self.configure()

    @property
    def datasheet(self) -> Datasheet:
        return self._datasheet

    def description(self) -> Mapping[str, Any]:
        return self._table

    def recover(self) -> None:
        self._estimator.restart()

    def configure(self, **settings: Any) -> None:
        self._poles = None
        self._apply(self._as_opened.changed(f"device {self.name}", settings))

    def suit(self, poles: Sequence[complex]) -> None:
        if poles == self._poles:
            return
        estimator = self._description.suited(poles)
        if estimator != self._description.estimator:
            self._apply(estimator)
        self._poles = poles

    def prepare(self, channels: Mapping[str, Channel], period_s: float) -> None:  # noqa: ARG002
        zero = channels["u"].zero
        if zero != self._description.estimator.force_zero:
            self._apply(dataclasses.replace(self._description.estimator, force_zero=zero))

    def _apply(self, estimator: EstimatorConfig) -> None:
        self._description = dataclasses.replace(self._description, estimator=estimator)
        self._estimator = Estimator(estimator, library=self._description.estimator_library)
        self._trigger = Trigger[estimator.trigger.replace("-", "_").upper()]
        # Runs share the table: to write it anew for each takes as long as to play a thousand samples.
        self._table = self._description.as_table()
        self._datasheet = dataclasses.replace(Datasheet.recorded(self._table), misfits=False)
        if self._alarms_only:
            self._datasheet = dataclasses.replace(self._datasheet, theta_n=0, model=None)
        self._table["datasheet"] = self._datasheet.as_table()

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        self._estimator.restart()
        self._next_index = 0

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        for block in blocks:
            if skipped_n := block.skipped_after(self._next_index):
                nothing = np.zeros(skipped_n, np.uint16)
                self._estimator.run(nothing, nothing, np.zeros(skipped_n, np.bool_), with_theta=False)
            self._next_index = block.first + len(block)
            steps = self._estimator.run(block.u, block.y, block.valid, with_theta=not self._alarms_only)
            yield self._answers(steps, block.first)

    def play_records(self, records: Sequence[Samples]) -> Iterator[tuple[Answers, Mapping[str, int]]]:
        u, y, valid = (np.stack([getattr(each, name) for each in records]) for name in ("u", "y", "valid"))
        for steps, counters in self._estimator.run_records(u, y, valid, with_theta=not self._alarms_only):
            yield self._answers(steps), counters

    def _answers(self, steps: EstimatorOutput, first: int = 0) -> Answers:
        """Answers to a block from sample ``first`` on."""
        return Answers(
            flags=steps.flags,
            alarms=raised_alarms(first + steps.alarms, steps.statistic[steps.alarms], self._trigger),
            theta=steps.theta,
            innovation=steps.innovation,
            statistic=steps.statistic,
        )

    def stop(self) -> Mapping[str, int]:
        return self._estimator.counters
