"""Device of foreign code in a host: what a C library and a Python object have in common."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import EVENTS, Answers, Events, Samples, raised_alarms
from analogrig.catalogue import SteppedFlag
from analogrig.datasheet import Datasheet
from analogrig.devices.device import Capability, Device, DeviceDescription, Stated
from analogrig.devices.foreign_host import ForeignHost
from analogrig.devices.foreign_memory import SLOT_SAMPLES, SLOTS, StepFailed
from analogrig.devices.pace import Pace
from analogrig.errors import DeviceError, DeviceRefused, TimeLimitReached
from analogrig.run import UNARMED, UNREPORTED

H = TypeVar("H", bound=ForeignHost)

_NONE = np.empty(0, np.int64)


@dataclass(frozen=True, kw_only=True)
class ForeignDescription(Stated, DeviceDescription):
    """Description of foreign code that takes blocks of samples and settings of its own."""

    collects: ClassVar[str] = "settings"

    @property
    def capabilities(self) -> frozenset[Capability]:
        return frozenset({"blocks", "configure"})


class _Piece(NamedTuple):
    """Samples of one call of the foreign code: all of a block, or a piece of a long one."""

    samples: Samples
    is_skipped: bool
    """True for samples before a block that were skipped: the foreign code takes them as missing, without an answer."""
    is_last: bool
    """True for the last of a block."""


class ForeignDevice(Device, Generic[H]):
    """Foreign code in a host. Each record begins in the memory of freshly loaded code, unless it is in this process."""

    reports_states: ClassVar[bool] = False
    """True if the alarm in a record is a state."""

    def __init__(self, description: ForeignDescription) -> None:
        """Nothing is loaded yet: ``recover`` does so."""
        super().__init__(description)
        self._foreign = description
        self._as_opened = description.settings
        self._opened: H | None = None
        self._facts: object = None
        """Facts of the host that the data sheet is of."""
        self._until_s = math.inf
        self._posted: deque[_Piece] = deque()
        self._answered: list[Answers] = []
        """Answers to the first pieces of a block."""
        self._next_index = 0
        self._held = np.zeros(2, np.uint16)
        """u and y of the last valid sample."""

    @abstractmethod
    def load(self) -> H:
        """The foreign code, loaded anew.

        :raises ConfigurationError: there is no such code, or it cannot be loaded.
        :raises DeviceError: it crashes or hangs.
        """

    @abstractmethod
    def stated(self) -> tuple[Datasheet, Mapping[str, Any]]:
        """Stated data sheet with the quantities that the loaded code reports, and what else the record holds of it.

        :raises ConfigurationError: they contradict each other.
        """

    def numbers(self) -> Mapping[str, Any]:
        """Settings as the foreign code takes them."""
        return self._foreign.settings

    @property
    def datasheet(self) -> Datasheet:
        return super().datasheet if self._facts is None else self._sheet

    def description(self) -> Mapping[str, Any]:
        return super().description() if self._facts is None else self._table

    @property
    def _host(self) -> H:
        if self._opened is None:
            raise DeviceError(f"device {self.name}: is closed")
        return self._opened

    def recover(self) -> None:
        if self._opened is None or not self._opened.is_ready:
            self._reload()
        self._begin()

    def _reload(self) -> None:
        self.close()
        self._opened = self.load()
        self._opened.limit(self._until_s)

    def _begin(self) -> None:
        """Begin a record. Take the data sheet of code that is new, or has other settings."""
        if not self._host.is_ready:
            self._reload()
        self._posted.clear()
        self._answered.clear()
        self._next_index = 0
        self._held[:] = 0
        self._host.start(self.numbers())
        if self._host.facts is not self._facts:
            self._sheet, found = self.stated()
            # Runs share the table: to write it anew for each takes as long as to play a thousand samples.
            self._table = {**self._foreign.as_table(), "datasheet": self._sheet.as_table(), **found}
            self._facts = self._host.facts

    def configure(self, **settings: Any) -> None:
        before = self._foreign, self._facts
        try:
            self._foreign = dataclasses.replace(self._foreign, settings={**self._as_opened, **settings})
        except ValueError as error:
            raise DeviceRefused(f"device {self.name}: {error}") from error
        self._description, self._facts = self._foreign, None
        try:
            self._begin()
        except DeviceError:
            self._foreign, self._facts = before
            self._description = self._foreign
            raise

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        self._begin()

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
            with contextlib.suppress(TimeLimitReached):
                while self._posted:
                    yield from self._take()
            yield from self._take_in_part()
            raise
        except StepFailed:
            yield from self._take_in_part()
            raise

    def _pieces(self, block: Samples) -> Iterator[_Piece]:
        gap = Samples.missing(self._next_index, block.skipped_after(self._next_index))
        for whole, is_skipped in ((gap, True), (block, False)):
            for start in range(0, len(whole), SLOT_SAMPLES):
                stop = min(start + SLOT_SAMPLES, len(whole))
                is_last = stop == len(whole) and not is_skipped
                yield _Piece(whole.cut(start, stop), is_skipped, is_last)
        self._next_index = block.first + len(block)

    def _post(self, piece: _Piece) -> None:
        """Give the foreign code a piece, in which missing samples repeat the last valid one."""
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
        answers = self._answers(piece.samples, records)
        self._posted.popleft()
        if not piece.is_skipped:
            self._answered.append(answers)
        if piece.is_last:
            yield self._join()

    def _take_in_part(self) -> Iterator[Answers]:
        """Answers to the oldest block as far as there are any."""
        if self._posted and not (piece := self._posted[0]).is_skipped:
            self._answered.append(self._answers(piece.samples, self._host.answered(len(piece.samples))))
            yield self._join()

    def _join(self) -> Answers:
        """Answers to a block from those to its pieces."""
        pieces, self._answered = self._answered, []
        return Answers.joined(pieces)

    def _answers(self, samples: Samples, records: NDArray[Any]) -> Answers:
        """Answers from the first records of a piece; copies, since the records will be overwritten."""
        sheet, first, valid = self._sheet, samples.first, samples.valid[: len(records)]
        flags = np.zeros(len(records), np.uint8)
        if not valid.all():
            flags[~valid] = SteppedFlag.MISSING
        for name, flag in (("refused", SteppedFlag.REFUSED), ("unreported", UNREPORTED)):
            if name in (records.dtype.names or ()) and records[name].any():
                flags[valid & (records[name] != 0)] |= np.uint8(flag)
        if sheet.armed:
            flags[records["armed"] == 0] |= UNARMED
        states = self._description.states
        alarm = np.isin(records["alarm"], states) if states and self.reports_states else records["alarm"]
        found = np.flatnonzero(alarm) if alarm.any() else _NONE
        reported = [
            (name, key)
            for name, key in (("diagnoses", "change"), ("misfits", "cause"))
            if getattr(sheet, name) and key in (records.dtype.names or ())
        ]
        return Answers(
            flags=flags,
            alarms=raised_alarms(first + found, records["statistic"][found] if sheet.statistic else 0.0),
            theta=self._numbers("theta", first, records, valid) if sheet.theta_n else None,
            innovation=self._numbers("innovation", first, records, valid) if sheet.innovation else None,
            statistic=self._numbers("statistic", first, records, valid) if sheet.statistic else None,
            **{name: _reports(name, key, first, records) for name, key in reported},
        )

    def _numbers(self, name: str, first: int, records: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Copy of a field of the records, the first of which is that of the sample ``first``.

        :raises DeviceError: a number is non-finite.
        """
        numbers: NDArray[np.float32] = records[name].copy()
        if not (are_finite := np.isfinite(numbers)).all():
            index = int(np.argmin(are_finite.reshape(len(records), -1).all(axis=1)))
            cure = "" if valid[index] else "; the sample is missing: report the last value, or 0"
            raise DeviceError(
                f"device {self.name}: sample {first + index}: {name} is non-finite: {numbers[index]}{cure}"
            )
        return numbers


def _reports(name: str, key: str, first: int, records: NDArray[Any]) -> Events:
    """Diagnoses or misfits of those records, the first of which is of the sample ``first``, whose ``key`` is set."""
    found = np.flatnonzero(records[key])
    events = np.zeros(len(found), EVENTS[name]).view(np.recarray)
    events["index"] = first + found
    for field in set(events.dtype.names) & set(records.dtype.names or ()) - {"index"}:
        events[field] = records[field][found]
    if key == "cause":
        events["cause"] -= 1  # 0 in a record stands for no report
    return events
