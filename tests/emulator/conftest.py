"""ngspice as an oracle: run a deck, read its raw file, pick the sample instants."""

from __future__ import annotations

import re
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.emulator.plays import SAMPLE_RATE_HZ, NgSpice


class UnfinishedError(Exception):
    """ngspice did not finish a deck: its limit of time was over, or its step became too small."""


@pytest.fixture
def ngspice(tmp_path: Path) -> NgSpice:
    """(deck, nodes, samples) -> voltages of the nodes at every sample instant of 20 kHz, (samples, nodes)."""
    return ngspice_in(tmp_path)


def ngspice_in(folder: Path, limit_s: int | None = None) -> NgSpice:
    """Value of the fixture, with its files in a folder; limit_s: most processor time of a deck."""
    limit = [] if limit_s is None else ["prlimit", f"--cpu={limit_s}:"]

    def run(deck: str, nodes: Sequence[str], samples: int) -> NDArray[np.float64]:
        (folder / "deck.cir").write_text(deck)
        command = [*limit, "ngspice", "-b", "-r", "out.raw", "deck.cir"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode == -signal.SIGXCPU:
            raise UnfinishedError(f"not finished after {limit_s} s of processor time")
        log = done.stdout[-2000:] + done.stderr[-2000:]
        if aborted := re.search("Timestep too small; time = [^,]*", log):
            raise UnfinishedError(aborted[0])
        assert (folder / "out.raw").exists(), log
        names, table = _read_raw(folder / "out.raw")
        instants_s = np.arange(samples) / SAMPLE_RATE_HZ
        rows = _nearest(table[:, 0], instants_s)
        # ngspice's first time point comes 10 ps after sample 0; all other samples have a time point of their own.
        assert np.abs(table[rows, 0] - instants_s).max() < 2e-11, log
        columns = np.array([names.index(f"v({node})") for node in nodes])
        volts: NDArray[np.float64] = table[np.ix_(rows, columns)]
        volts[0] = _at_start(table[:, 0], table[:, columns])
        return volts

    return run


def _nearest(times_s: NDArray[np.float64], instants_s: NDArray[np.float64]) -> NDArray[np.intp]:
    """Index of the time point nearest to each instant."""
    right = np.clip(np.searchsorted(times_s, instants_s), 1, times_s.size - 1)
    return np.where(instants_s - times_s[right - 1] < times_s[right] - instants_s, right - 1, right)


def _at_start(times_s: NDArray[np.float64], volts: NDArray[np.float64]) -> NDArray[np.float64]:
    """At time 0, on the line through the first time point and one as far from it again.

    Nearer ones differ by less than ngspice's tolerances; the fastest amplifiers here take tens of nanoseconds.
    """
    second = int(np.searchsorted(times_s, 2 * times_s[0]))
    assert times_s[second] < 1e-10, f"ngspice's first time points come at {times_s[0]} and {times_s[second]} s"
    slope = (volts[second] - volts[0]) / (times_s[second] - times_s[0])
    return np.asarray(volts[0] - slope * times_s[0])


def _read_raw(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    """Variable names and values, (points, variables), of a binary raw file with one real plot."""
    header, _, data = path.read_bytes().partition(b"Binary:\n")
    lines = header.decode().splitlines()
    count = next(int(line.split(":")[1]) for line in lines if line.startswith("No. Variables:"))
    first = lines.index("Variables:") + 1
    names = [line.split()[1].lower() for line in lines[first : first + count]]
    return names, np.frombuffer(data).reshape(-1, count)
