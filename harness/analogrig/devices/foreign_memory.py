"""Memory that foreign code and its host share, and the messages between them.

The process of a Python device imports this module, and forks for each record: it imports as little as possible.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.datasheet import MOST_THETA
from analogrig.errors import DeviceError

SLOTS = 2
"""Blocks that a host takes before it answers: while the foreign code works on one, the next is filled."""
SLOT_SAMPLES = 16_384

GUARD = 0xA5C3_5A3C
"""Value behind each record, which foreign code that writes beyond it destroys."""
CANARY = np.full(64, 0xA5, np.uint8)
"""Bytes behind the last record of a block, and behind the state of a library."""

REQUEST = struct.Struct("=QII")
"""Samples, slot and bytes of a record. No samples: a new record begins, and its settings follow."""
REPLY = struct.Struct("=qq")
"""Result, and 1 if the state was overrun. A text may follow."""
NO_SOCKET = 4
"""Exit status of a child without its socket."""
MOST_MESSAGE = 1 << 16


class StepFailed(DeviceError):  # noqa: N818 - the words of the message
    """The foreign code failed by an error of its own language. The answers before that hold."""


class Slot:
    """Memory of one block: views of its samples and records, made once because that takes longer than to fill them."""

    def __init__(self, samples: NDArray[Any], room: NDArray[np.uint8], record: np.dtype[Any]) -> None:
        """``room`` holds the records and the canary behind them."""
        self.u, self.y, self.valid = (samples[name] for name in ("u", "y", "valid"))
        self.records = room[: SLOT_SAMPLES * record.itemsize].view(record)
        self._room = room
        self.done, self.guard = self.records["done"], self.records["guard"]
        self.addresses = samples.ctypes.data, room.ctypes.data

    def fill(self, u: NDArray[Any], y: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Set the samples, and prepare their records."""
        n = len(u)
        self.u[:n], self.y[:n], self.valid[:n] = u, y, valid
        self._room[: n * self.records.itemsize] = 0
        self.guard[:n] = GUARD
        self._behind(n)[:] = CANARY

    def is_overrun(self, n: int) -> bool:
        """True if something was written behind the last of ``n`` records."""
        return self._behind(n).tobytes() != CANARY.tobytes()  # in a third of the time of a comparison of arrays

    def _behind(self, n: int) -> NDArray[np.uint8]:
        end = n * self.records.itemsize
        return self._room[end : end + len(CANARY)]

    def done_n(self, n: int) -> int:
        """Number of complete records before the first incomplete one, of ``n``."""
        done = self.done[:n]
        return n if done.all() else int(np.argmin(done))


class SharedLayout(NamedTuple):
    """Shared memory of a kind of foreign code: SLOTS blocks of samples, then as many of records."""

    sample: np.dtype[Any]
    numbers: tuple[tuple[str, str], ...] = ()
    """Fields of a record behind theta, for that which a library cannot report."""

    def record(self, theta_n: int) -> np.dtype[Any]:
        """analogrig_out_t with ``theta_n`` elements of theta, these fields and a guard."""
        flags = [(name, "u1") for name in ("alarm", "armed", "refused", "done")]
        numbers = [("statistic", "<f4"), ("innovation", "<f4"), ("theta", "<f4", (theta_n,))]
        return np.dtype([*flags, *numbers, *self.numbers, ("guard", "<u4")])

    @property
    def samples_bytes(self) -> int:
        """Bytes of the samples of a slot, in whole pages."""
        return -(-SLOT_SAMPLES * self.sample.itemsize // mmap.PAGESIZE) * mmap.PAGESIZE

    @property
    def records_bytes(self) -> int:
        """Bytes of the records of a slot; the last page holds the canary of a full one."""
        pages = -(-SLOT_SAMPLES * self.record(MOST_THETA).itemsize // mmap.PAGESIZE) + 1
        return pages * mmap.PAGESIZE

    def memory(self, fd: int = -1) -> mmap.mmap:
        """Memory of all slots, and room behind it for one full record; ``fd`` is a file for it."""
        size = SLOTS * (self.samples_bytes + self.records_bytes) + mmap.PAGESIZE
        if fd >= 0:
            os.ftruncate(fd, size)
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)  # by foreign code: SIGBUS here
        return mmap.mmap(fd, size)

    def slots(self, memory: mmap.mmap, theta_n: int) -> tuple[Slot, ...]:
        """Slots in the memory, with ``theta_n`` elements of theta in each record."""
        record, behind = self.record(theta_n), SLOTS * self.samples_bytes
        return tuple(
            Slot(
                np.frombuffer(memory, self.sample, SLOT_SAMPLES, slot * self.samples_bytes),
                np.frombuffer(memory, np.uint8, self.records_bytes, behind + slot * self.records_bytes),
                record,
            )
            for slot in range(SLOTS)
        )
