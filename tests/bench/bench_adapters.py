"""Sample rates through the adapters for any estimator.

python -m tests.bench adapters

Each adapter adds one function to ROWS, which yields the names and the devices to be measured. A row of an adapter takes
a trivial estimator, unless its name says otherwise: the rate is that of the adapter.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import numpy as np

from analogrig.answers import Samples
from analogrig.devices.device import Device
from analogrig.devices.estimator_library import EstimatorLibrary
from tests.harness.library_builds import OWN, build

from . import text_programs
from .ecus import ecus
from .figure import Figure

PLAY_S = 0.5
"""Duration of one repetition."""
REPEATS = 5
"""Number of repetitions; the median is reported, with the slowest and the fastest."""

TRIVIAL = """
#include "analogrig_estimator.h"
typedef struct { float last; } trivial_t;
static int init(trivial_t* self) { self->last = 0.0F; return 0; }
static void step(trivial_t* self, const analogrig_in_t* in, analogrig_out_t* out) {
    out->innovation = in->y - self->last;
    out->theta[0] = self->last = in->y;
}
ANALOGRIG_ESTIMATOR(trivial_t, init, step, "trivial", 1, ANALOGRIG_INNOVATION);
"""
"""Estimator in C that predicts the sample before."""

Row = tuple[str, Device, int]
"""Name, connected device, samples in a block."""


def rates(device: Device, block_n: int) -> list[float]:
    """Sorted rates of all repetitions [samples/s]."""
    draw = np.random.default_rng(1)
    u, y = (draw.integers(0, 4096, block_n).astype(np.uint16) for _ in range(2))
    valid = np.ones(block_n, np.bool_)

    def blocks() -> Iterator[Samples]:
        first, until_s = 0, time.perf_counter() + PLAY_S
        while time.perf_counter() < until_s:
            yield Samples(first, u, y, valid)
            first += block_n

    found = []
    for _ in range(REPEATS):
        device.start()
        start_s = time.perf_counter()
        answered = sum(len(answers) for answers in device.play(blocks()))
        found.append(answered / (time.perf_counter() - start_s))
    return sorted(found)


def libraries() -> Generator[Row, None, None]:
    """Plain C libraries in a child process."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "trivial.c"
        source.write_text(TRIVIAL)
        trivial = build(Path(folder) / "trivial.so", source)
        own = build(Path(folder) / "own.so", OWN)
        for library, estimator in ((trivial, ""), (own, ", RLS with 6 parameters and CUSUM")):
            with EstimatorLibrary(name="library", library=str(library)).connect() as device:
                for block_n in (16_384, 1024, 1) if not estimator else (1024,):
                    yield f"library in a child, blocks of {block_n}{estimator}", device, block_n


ROWS: tuple[Callable[[], Generator[Row, None, None]], ...] = (libraries, text_programs.rows, ecus)


def figures() -> Iterator[Figure]:
    """One figure for each adapter and length of blocks."""
    for rows in ROWS:
        for name, device, block_n in rows():
            found = rates(device, block_n)
            yield Figure(f"adapters, {name}", found[len(found) // 2], "samples/s", bounds=(found[0], found[-1]))
