"""Ring of the last samples and answers of a live session, written by one thread and read by others."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from analogrig.devices import Answers
from analogrig.rigs import Block

RING_N = 1 << 17
"""Samples in the ring: 6.5 s at 20,000 samples/s, 12 MB."""


class Ring:
    """Last ``RING_N`` answered samples of a play, by their indices from its start."""

    def __init__(self, channels: int, probes: int, theta_n: int) -> None:
        self._lock = threading.Lock()
        self.columns: dict[str, NDArray[np.generic]] = {
            "codes": np.zeros((RING_N, channels), np.uint16),
            "clipped": np.zeros((RING_N, channels), np.bool_),
            "probed": np.zeros((RING_N, probes), np.float32),
            "theta": np.zeros((RING_N, theta_n), np.float32),
            "innovation": np.zeros(RING_N, np.float32),
            "statistic": np.zeros(RING_N, np.float32),
            "flags": np.zeros(RING_N, np.uint8),
        }
        self._place = (0, 0)

    @property
    def place(self) -> tuple[int, int]:
        """Number of the play, from 1, and number of its samples."""
        return self._place

    @property
    def end(self) -> int:
        """Number of samples since the start of the play."""
        return self._place[1]

    @property
    def start(self) -> int:
        """Oldest sample in the ring."""
        return max(0, self.end - RING_N)

    def restart(self) -> None:
        """Forget all samples: the next one is the first of the next play."""
        with self._lock:
            self._place = self._place[0] + 1, 0

    def add(self, block: Block, probed: NDArray[np.float64], answers: Answers) -> None:
        """Append the answered samples of a block."""
        n = len(answers)
        values = {
            "codes": block.codes,
            "clipped": block.clipped,
            "probed": probed,
            "theta": answers.theta,
            "innovation": answers.innovation,
            "statistic": answers.statistic,
            "flags": answers.flags,
        }
        with self._lock:
            for skip in range(0, n, RING_N):
                self._write({k: v[skip : min(n, skip + RING_N)] for k, v in values.items() if v is not None})

    def _write(self, values: dict[str, NDArray[np.generic]]) -> None:
        n, (take, end) = len(values["flags"]), self._place
        at = end % RING_N
        until_wrap = min(n, RING_N - at)
        for name, value in values.items():
            column = self.columns[name]
            if column.shape[1:] != value.shape[1:]:  # a device may take its orders from the program of the take
                column = self.columns[name] = np.zeros((RING_N, *value.shape[1:]), column.dtype)
            column[at : at + until_wrap] = value[:until_wrap]
            column[: n - until_wrap] = value[until_wrap:]
        self._place = take, end + n

    def read(self, name: str, first: int, end: int) -> NDArray[np.generic]:
        """Copy of a column for the samples ``first`` <= k < ``end``.

        :raises LookupError: the ring does not hold them any more, or not yet.
        """
        with self._lock:
            if not self.start <= first <= end <= self.end:
                raise LookupError(f"samples {first} to {end} are not in the ring")
            at, n = first % RING_N, end - first
            column = self.columns[name]
            return np.concatenate((column[at : at + n], column[: max(0, at + n - RING_N)]))
