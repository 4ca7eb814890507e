"""Devices of the kind ``library``: an estimator in a shared library with the interface of analogrig_estimator.h."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import Answers, RaisedAlarm, Samples
from analogrig.catalogue import SteppedFlag
from analogrig.datasheet import Datasheet
from analogrig.devices.adapted import AdaptedDescription
from analogrig.devices.description import Capability
from analogrig.devices.device import Device
from analogrig.devices.library_host import (
    SLOT_SAMPLES,
    SLOTS,
    About,
    ChildHost,
    InProcessHost,
    LibraryHost,
    Reports,
)
from analogrig.errors import ConfigurationError, DeviceError, DeviceRefused, TimeLimitReached
from analogrig.protocol.pace import Pace
from analogrig.run import UNARMED
from analogrig.trust import Thing, absolute_path
from analogrig.wording import one_line


@dataclass(frozen=True, kw_only=True)
class EstimatorLibrary(AdaptedDescription):
    """An estimator of your own in a shared library. `analogrig include` prints the folder of its header."""

    kind: ClassVar[str] = "library"
    usage: ClassVar[str] = "library:FILE.so[?in_process=true]"
    summary: ClassVar[str] = "estimator of your own in a shared library with three functions"
    collects: ClassVar[str] = "settings"
    library: str
    """Shared library."""
    in_process: bool = False
    """True: run in this process, which a crash of the library ends; False: in a child process."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.library:
            raise ValueError("library must name a shared library, such as ./my_estimator.so")
        for name, value in self.settings.items():
            if not name.isidentifier():
                raise ValueError(f"settings: {name!r} is no name of a setting: use letters, digits and _")
            if isinstance(value, str) or not math.isfinite(value):
                raise ValueError(f"settings: {name} must be a finite number, not {value!r}")

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """:raises ConfigurationError: no library is named."""
        if place in {"", ":"}:
            raise ConfigurationError(f"device {name!r}: names no library: use {cls.kind}:./my_estimator.so")

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:  # noqa: ARG003
        return {"library": place}

    @property
    def capabilities(self) -> frozenset[Capability]:
        always: frozenset[Capability] = frozenset({"blocks", "configure"})
        return always | ({"in-process"} if self.in_process else frozenset())

    def open(self) -> Device:
        return EstimatorLibraryDevice(self)

    def direct(self, *, alarms_only: bool = False) -> Device:
        device = EstimatorLibraryDevice(self, alarms_only=alarms_only)
        try:
            device.recover()
            device.configure()
        except BaseException:
            device.close()
            raise
        return device

    @property
    def program(self) -> Path:
        return Path(self.library).absolute()

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("library", self.library, "the device loads the library"),)

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, library=absolute_path(self.library, folder))

    def host(self) -> LibraryHost:
        """The library, loaded anew.

        :raises ConfigurationError: the file is no library of analogrig_estimator.h.
        :raises DeviceError: the library crashes or hangs.
        """
        if not self.program.is_file():
            raise ConfigurationError(f"device {self.name}: there is no file {self.library}")
        if self.in_process:
            return InProcessHost(self.name, self.program)
        return ChildHost(self.name, self.program, self.numbers, self.timeout_s)

    @property
    def numbers(self) -> Mapping[str, float]:
        """Settings as the library takes them."""
        return {name: float(value) for name, value in self.settings.items()}


class _Piece(NamedTuple):
    """Samples of one call of the library: all of a block, or a piece of a long one."""

    samples: Samples
    skipped_n: int
    """Samples before the block, which were skipped and are missing samples to the library."""
    is_last: bool


class EstimatorLibraryDevice(Device):
    """Estimator in a shared library."""

    def __init__(self, description: EstimatorLibrary, *, alarms_only: bool = False) -> None:
        """Nothing is loaded yet: ``recover`` does so.

        :param alarms_only: omit the estimates: theta has no columns.
        """
        super().__init__(description)
        self._description: EstimatorLibrary = description
        self._as_opened = description.settings
        self._alarms_only = alarms_only
        self._opened: LibraryHost | None = None
        self._until_s = math.inf
        self._posted: deque[_Piece] = deque()
        self._answered: list[Answers] = []
        """Answers to the first pieces of a block."""
        self._next_index = 0
        self._held = np.zeros(2, np.uint16)
        """u and y of the last valid sample."""

    @property
    def datasheet(self) -> Datasheet:
        return super().datasheet if self._opened is None else self._sheet

    def description(self) -> Mapping[str, Any]:
        return super().description() if self._opened is None else self._table

    @property
    def _host(self) -> LibraryHost:
        if self._opened is None:
            raise DeviceError(f"device {self.name}: is closed")
        return self._opened

    def recover(self) -> None:
        self.close()
        if self._description.files() != self._files:
            raise DeviceError(f"device {self.name}: its file was replaced since it was opened: start again")
        self._opened = self._description.host()
        self._opened.limit(self._until_s)
        self._sheet = self._complete(self._opened.about)
        identity = {"firmware": one_line(self._opened.about.name)}
        # Runs share the table: to write it anew for each takes as long as to play a thousand samples.
        self._table = {**super().description(), "identity": identity}

    def _complete(self, about: About) -> Datasheet:
        """Stated data sheet with the quantities that the library reports."""
        try:
            return dataclasses.replace(
                self._description.datasheet,
                **({"theta_n": 0, "model": None} if self._alarms_only else {"theta_n": about.theta_n}),
                statistic=bool(about.reports & Reports.STATISTIC),
                innovation=bool(about.reports & Reports.INNOVATION),
                armed=bool(about.reports & Reports.ARMED),
            )
        except ValueError as error:
            raise ConfigurationError(f"device {self.name}: datasheet: {error}") from error

    def configure(self, **settings: Any) -> None:
        try:
            described = dataclasses.replace(self._description, settings={**self._as_opened, **settings})
        except ValueError as error:
            raise DeviceRefused(f"device {self.name}: {error}") from error
        before = self._description
        if described != before:
            self._description = described
            self.recover()
        try:
            self.start()
        except DeviceRefused:
            self._description = before
            self.recover()
            raise

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        if not self._host.is_idle:
            self.recover()
        self._posted.clear()
        self._answered.clear()
        self._next_index = 0
        self._held[:] = 0
        self._host.start(self._description.numbers)

    def limit(self, left_s: float) -> None:
        self._until_s = time.monotonic() + left_s
        if self._opened is not None:
            self._opened.limit(self._until_s)

    def close(self) -> None:
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        try:
            for block in blocks:
                while self._posted and not len(block):
                    yield from self._take()
                for piece in self._pieces(block):
                    if len(self._posted) == SLOTS:
                        yield from self._take()
                    self._post(piece)
            while self._posted:
                yield from self._take()
        except TimeLimitReached:
            yield from self._take_in_time()
            raise

    def _pieces(self, block: Samples) -> Iterator[_Piece]:
        skipped_n = block.skipped_after(self._next_index)
        whole = _after_missing(skipped_n, block) if skipped_n else block
        if 0 < len(whole) <= SLOT_SAMPLES:
            yield _Piece(whole, skipped_n, is_last=True)
            self._next_index += len(whole)
            return
        for start in range(0, len(whole), SLOT_SAMPLES):
            piece = slice(start, start + SLOT_SAMPLES)
            samples = Samples(whole.first + start, whole.u[piece], whole.y[piece], whole.valid[piece])
            yield _Piece(samples, skipped_n, is_last=piece.stop >= len(whole))
        self._next_index += len(whole)

    def _post(self, piece: _Piece) -> None:
        samples = piece.samples
        u, y = samples.u, samples.y
        if not samples.valid.all():
            last = np.maximum.accumulate(np.where(samples.valid, np.arange(1, len(samples) + 1), 0))
            u, y = (np.concatenate(([held], x))[last] for held, x in zip(self._held, (u, y), strict=True))
        self._held[:] = u[-1], y[-1]
        self._host.post(u, y, samples.valid)
        self._posted.append(piece)

    def _take(self) -> Iterator[Answers]:
        """Wait for the records of the oldest piece. Yield the answers to its block if it is the last of it."""
        piece = self._posted[0]
        records = self._host.take(len(piece.samples), piece.samples.first)
        self._answered.append(self._answers(piece.samples, records))
        self._posted.popleft()
        if piece.is_last:
            yield self._join(piece.skipped_n)

    def _take_in_time(self) -> Iterator[Answers]:
        """Answers that have come; those to the last block in part."""
        try:
            while self._posted:
                yield from self._take()
        except TimeLimitReached:
            piece = self._posted[0]
            self._answered.append(self._answers(piece.samples, self._host.answered(len(piece.samples))))
            yield self._join(piece.skipped_n)

    def _join(self, skipped_n: int) -> Answers:
        """Answers to a block from those to its pieces."""
        pieces, self._answered = self._answered, []
        if len(pieces) == 1 and not skipped_n:
            return pieces[0]

        def joined(name: str) -> Any:
            arrays = [getattr(piece, name) for piece in pieces]
            return None if arrays[0] is None else np.concatenate(arrays)[skipped_n:]

        alarms = tuple(alarm for piece in pieces for alarm in piece.alarms)
        names = ("flags", "theta", "innovation", "statistic")
        return Answers(alarms=alarms, **{name: joined(name) for name in names})

    def _answers(self, samples: Samples, records: NDArray[Any]) -> Answers:
        """Answers from the first records of a piece; copies, since the records will be overwritten."""
        sheet, valid = self._sheet, samples.valid[: len(records)]
        flags = np.zeros(len(records), np.uint8)
        if not valid.all():
            flags[~valid] = SteppedFlag.MISSING
        if records["refused"].any():
            flags[valid & (records["refused"] != 0)] |= np.uint8(SteppedFlag.REFUSED)
        if sheet.armed:
            flags[records["armed"] == 0] |= UNARMED
        alarm = records["alarm"]
        indices = np.flatnonzero(alarm).tolist() if alarm.any() else []
        return Answers(
            flags=flags,
            alarms=tuple(
                RaisedAlarm(samples.first + k, statistic=float(records["statistic"][k]) if sheet.statistic else 0.0)
                for k in indices
            ),
            theta=self._numbers("theta", samples.first, records) if sheet.theta_n else None,
            innovation=self._numbers("innovation", samples.first, records) if sheet.innovation else None,
            statistic=self._numbers("statistic", samples.first, records) if sheet.statistic else None,
        )

    def _numbers(self, name: str, first: int, records: NDArray[Any]) -> NDArray[np.float32]:
        """Copy of a field of the records, the first of which is that of the sample ``first``.

        :raises DeviceError: a number is non-finite.
        """
        numbers: NDArray[np.float32] = records[name].copy()
        if not (are_finite := np.isfinite(numbers)).all():
            index = int(np.argmin(are_finite.reshape(len(records), -1).all(axis=1)))
            raise DeviceError(f"device {self.name}: sample {first + index}: {name} is non-finite: {numbers[index]}")
        return numbers


def _after_missing(n: int, block: Samples) -> Samples:
    """The block after ``n`` missing samples."""
    codes = np.zeros(n, np.uint16)
    u, y = np.concatenate((codes, block.u)), np.concatenate((codes, block.y))
    return Samples(block.first - n, u, y, np.concatenate((np.zeros(n, np.bool_), block.valid)))
