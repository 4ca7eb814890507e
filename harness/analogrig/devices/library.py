"""The device as a shared library in this process: its ports in memory, its estimator alone, and the kind ``inproc``."""

from __future__ import annotations

import ctypes
import dataclasses
import enum
import secrets
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NoReturn, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analogrig.answers import Answers, Samples, raised_alarms
from analogrig.catalogue import CATALOGUE_HASH, FirmwareId, SteppedFlag, Trigger
from analogrig.datasheet import Datasheet
from analogrig.devices.catalogue_device import CatalogueDescription
from analogrig.devices.device import KEEPS_MEMORY, CanRates, Capability, Device, SerialRate
from analogrig.devices.pace import Pace
from analogrig.errors import ConfigurationError, LinkError
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.link import VirtualClock, Wire
from analogrig.run import Channel
from analogrig.trust import Thing, absolute_path

if TYPE_CHECKING:
    import can

    from analogrig.links.can_bus import CanBus
    from analogrig.links.line import CanLine

LIBRARY = Path(__file__).parents[1] / "_device.so"
"""The project's own device."""

WIDE_LIBRARY = LIBRARY.with_name("_device_wide.so")
"""The same with room for plants of higher order."""

FIXED_LIBRARY = LIBRARY.with_name("_device_fixed.so")
"""The same with fixed orders, which takes fewer instructions."""

OWN_LIBRARIES = (LIBRARY, WIDE_LIBRARY, FIXED_LIBRARY)

_FIXED_ORDERS = {"na": 2, "nb": 3, "nk": 0, "nc": 0, "offset": True}
"""FIXED_ORDERS of setup.py."""

ALWAYS_ROOM = 255
"""Input blocks of a device that handles every message before the call returns: no message ever waits."""

_OUTPUT_BYTES = 65_536


class ProgressStruct(ctypes.Structure):
    """device_progress_t of estimator_c/device/device.h."""

    _fields_ = (("taken", ctypes.c_size_t), ("given", ctypes.c_size_t))


class IdentityStruct(ctypes.Structure):
    """device_identity_t of estimator_c/device/device.h."""

    _fields_ = (
        ("catalogue_hash", ctypes.c_uint32),
        ("boot_nonce", ctypes.c_uint32),
        ("input_blocks", ctypes.c_uint8),
        ("firmware_id", ctypes.c_uint8),
    )


_HOW_TO = "sources to compile: harness/docs/howto/check-a-port-of-the-estimator.md"


def load_library(library: Path, functions: Iterable[str]) -> ctypes.CDLL:
    """The library of the project's device or of a user's own, with all of ``functions``.

    :raises LinkError: the project's library was not built.
    :raises ConfigurationError: the user's library cannot be loaded, or lacks a function.
    """
    if library.exists() and not library.is_file():
        raise ConfigurationError(f"{library}: not a file")
    try:
        c = ctypes.CDLL(str(library))
    except OSError as error:
        if library in OWN_LIBRARIES:
            raise LinkError(f"{library} cannot be loaded: run `make setup` ({error})") from error
        reason = str(error).removeprefix(f"{library}: ")
        raise ConfigurationError(f"{library}: cannot be loaded as a library of a device: {reason}") from error
    missing = [function for function in functions if not hasattr(c, function)]
    if missing:
        raise ConfigurationError(f"{library}: is no library of a device: it lacks {', '.join(missing)} ({_HOW_TO})")
    return c


def library_for(estimator: EstimatorConfig) -> Path:
    """The project's own device, with room for these settings."""
    return WIDE_LIBRARY if estimator.is_wide else LIBRARY


def estimator_library_for(estimator: EstimatorConfig) -> Path:
    """The fastest build of the estimator alone for these settings, whose orders are final."""
    is_fixed = all(getattr(estimator, name) == order for name, order in _FIXED_ORDERS.items())
    return FIXED_LIBRARY if is_fixed else library_for(estimator)


def unwritten(size: int) -> ctypes.Array[ctypes.c_char]:
    """Buffer of ``size`` bytes that are not zero, so that a device which relies on zeroed memory fails."""
    return ctypes.create_string_buffer(b"\xa5" * size, size)


class LibraryDevice:
    """The device in a shared library, behind its serial port or its CAN port."""

    def __init__(
        self,
        port: Literal["serial", "can"],
        *arguments: object,
        boot_nonce: int,
        catalogue_hash: int = CATALOGUE_HASH,
        input_blocks: int = ALWAYS_ROOM,
        library: Path = LIBRARY,
    ) -> None:
        """Load and boot a device; ``arguments`` go to its port.

        :param catalogue_hash: another one stands for a device built from another catalogue.
        :raises LinkError: the project's library was not built.
        :raises ConfigurationError: the user's library is not one of a device.
        """
        names = [f"{port}_device_{name}" for name in ("size", "init", "run")]
        c = load_library(library, names)
        size, init, self.run = (getattr(c, name) for name in names)
        size.restype = ctypes.c_size_t
        self.run.restype = ProgressStruct
        self.run.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t]
        self.state = unwritten(size())
        identity = IdentityStruct(catalogue_hash, boot_nonce, input_blocks, FirmwareId.LIBRARY)
        init(self.state, ctypes.byref(identity), *arguments)


class MemoryWire(LibraryDevice):
    """Wire to a device in this process: the same C code and frames as elsewhere, on a virtual clock."""

    name = "memory"

    def __init__(
        self,
        boot_nonce: int,
        *,
        catalogue_hash: int = CATALOGUE_HASH,
        clock: VirtualClock | None = None,
        library: Path = LIBRARY,
    ) -> None:
        """Boot a device; parameters and errors as ``LibraryDevice``."""
        super().__init__("serial", boot_nonce=boot_nonce, catalogue_hash=catalogue_hash, library=library)
        self._output = unwritten(_OUTPUT_BYTES)
        self._given = memoryview(self._output)
        self.clock = VirtualClock() if clock is None else clock
        self._answers = b""

    def write(self, sent: bytes) -> None:
        while True:
            progress = self.run(self.state, sent, len(sent), self._output, _OUTPUT_BYTES)
            self._answers += self._given[: progress.given]
            sent = sent[progress.taken :]
            if not progress.given and not sent:
                return

    def read(self, timeout_s: float) -> bytes:
        """All unread answers. Without any, the clock advances by the whole time-out, since none can follow."""
        answers, self._answers = self._answers, b""
        if not answers:
            self.clock.advance(timeout_s)
        return answers

    def close(self) -> None:
        """Do nothing: nothing is held."""


_FRAME_BYTES = 64
"""Data of the longest frame of CAN FD."""

_EXTENDED, _REMOTE, _FD, _ERROR = 1, 2, 4, 8
"""Flags of estimator_c/device/can_frame.h."""

_OUTPUT_FRAMES = 128


class _Frame(ctypes.Structure):
    """can_frame_t of estimator_c/device/can_frame.h."""

    _fields_ = (
        ("id", ctypes.c_uint32),
        ("flags", ctypes.c_uint8),
        ("length", ctypes.c_uint8),
        ("data", ctypes.c_uint8 * _FRAME_BYTES),
    )


def _to_c(frame: can.Message) -> _Frame:
    flags = _EXTENDED * frame.is_extended_id | _REMOTE * frame.is_remote_frame
    flags |= _FD * frame.is_fd | _ERROR * frame.is_error_frame
    data = bytes(frame.data[:_FRAME_BYTES])
    out = _Frame(frame.arbitration_id, flags, len(data))
    ctypes.memmove(out.data, data, len(data))
    return out


def _from_c(frame: _Frame) -> can.Message:
    import can

    return can.Message(
        arbitration_id=frame.id,
        is_extended_id=False,
        is_fd=bool(frame.flags & _FD),
        data=bytes(frame.data)[: frame.length],
    )


class MemoryBus(LibraryDevice):
    """A bus with a device in this process as its only other node, on a virtual clock."""

    name = "memory"
    unread_n = None
    damaged = 0

    def __init__(
        self,
        boot_nonce: int,
        *,
        is_fd: bool = False,
        line: CanLine | None = None,
        input_blocks: int = ALWAYS_ROOM,
        library: Path = LIBRARY,
    ) -> None:
        """Boot a device with or without CAN FD; parameters and errors as ``LibraryDevice``."""
        port = ctypes.c_bool(is_fd)
        super().__init__("can", port, boot_nonce=boot_nonce, input_blocks=input_blocks, library=library)
        self.is_fd, self.line = is_fd, line
        self.clock = VirtualClock()
        self._output = (_Frame * _OUTPUT_FRAMES)()
        self._answers: deque[can.Message] = deque()

    def send(self, frame: can.Message) -> None:
        waiting = [_to_c(frame)]
        while True:
            array = (_Frame * len(waiting))(*waiting)
            progress = self.run(self.state, array, len(waiting), self._output, _OUTPUT_FRAMES)
            self._answers.extend(_from_c(self._output[i]) for i in range(progress.given))
            waiting = waiting[progress.taken :]
            if not progress.given and not waiting:
                return

    def receive(self, timeout_s: float) -> can.Message | None:
        """The next answer. Without any, the clock advances by the whole time-out, since none can follow."""
        if self._answers:
            return self._answers.popleft()
        self.clock.advance(timeout_s)
        return None

    def close(self) -> None:
        """Do nothing: nothing is held."""


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

        :param u: (n,) codes of the input.
        :param y: (n,) codes of the output.
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

        :param u: (r, n) contiguous codes of the input; y and valid likewise, as of ``run``.
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

    def __init__(self, description: InprocDevice, *, alarms_only: bool = False) -> None:
        """Load and configure the estimator.

        :param alarms_only: omit the estimates, which take a twentieth of the time: theta has no columns.
        :raises ConfigurationError: the estimator refuses its configuration.
        :raises LinkError: the library was not built.
        """
        super().__init__(description)
        self._description: InprocDevice = description
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


@dataclass(frozen=True, kw_only=True)
class InprocDevice(SerialRate, CanRates, CatalogueDescription):
    """The device as a shared library in this process."""

    kind: ClassVar[str] = "inproc"
    place_key: ClassVar[str] = "library"
    usage: ClassVar[str] = "inproc[:LIBRARY]"
    summary: ClassVar[str] = "device as a shared library in this process"
    is_in_process: ClassVar[bool] = True
    link: Literal["serial", "can"] = "serial"
    """Bytes or CAN frames between the device and the harness."""
    library: str = ""
    """Shared library of your own device, built from estimator_c and your core; empty for the project's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_rates()
        if not self.is_on_can and (self.fd or self.bitrate is not None):
            raise ValueError("bitrate and fd are for a CAN bus: set link = 'can'")
        if self.is_on_can and self.baud is not None:
            raise ValueError("baud is for a serial line, and link is 'can': set bitrate")
        if self.library and self.is_on_can:
            raise ValueError("a library of your own has no CAN bus: set link = 'serial'")

    @property
    def is_on_can(self) -> bool:
        return self.link == "can"

    @property
    def program(self) -> Path:
        return Path(self.library).absolute() if self.library else library_for(self.estimator)

    def known_datasheet(self) -> Datasheet:
        sheet = super().known_datasheet()
        return sheet.with_untold(KEEPS_MEMORY) if self.library else sheet

    @property
    def estimator_library(self) -> Path:
        """Shared library with the device's estimator, to be run in this process."""
        return self.program if self.library else estimator_library_for(self.estimator)

    @property
    def capabilities(self) -> frozenset[Capability]:
        if self.is_on_can or self.wire_faults or self.report_interval_n > 1:
            return super().capabilities
        return super().capabilities | {"blocks"}

    def direct(self, *, alarms_only: bool = False) -> Device:
        return DirectDevice(self, alarms_only=alarms_only)

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("library", self.library, "the device loads the library"),) if self.library else ()

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, library=absolute_path(self.library, folder))

    def wire(self) -> Wire:
        return MemoryWire(boot_nonce=secrets.randbits(32), library=self.program)

    def bus(self) -> CanBus:
        return MemoryBus(secrets.randbits(32), is_fd=self.fd, line=self.can_line(), library=self.program)
