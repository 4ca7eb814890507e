"""The C estimator for the tests: est_driver.c, compiled against the public header when the tests start."""

from __future__ import annotations

import ctypes
import os
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analogrig.estimator_config import EstimatorConfig
from estimator_c.evidence.cost import SLICES_N as DEVICE_SLICES_N

CORE = Path(__file__).parents[2] / "estimator_c" / "core"
ISOLATION = CORE.parent / "isolation"
FIT = CORE.parent / "fit"
STRICT = [
    "-std=c99",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wdouble-promotion",
    "-pedantic",
    "-Werror",
    "-ffp-contract=off",
    "-DEST_NC_MAX=2U",
    *("-fsanitize=bounds", "-fsanitize-undefined-trap-on-error"),  # an access outside an array ends the run
]
COVERED = ("-O0", "--coverage", "-DNDEBUG", "-D__OPTIMIZE_SIZE__=1", "-DEST_NA_MAX=3U")
"""One copy of every line, and loops over EST_NA_MAX that are loops."""

COUNTERS = (
    "updated",
    "missing",
    "refused",
    "alarms",
    "restarts",
    "slips",
    "saturated",
    "stuck",
    "refreshes",
    "outliers",
)

NONE, PREDICTION_ERROR, MEAN_BETWEEN_FAULTS, CUSUM, CUSTOM = range(5)
UPDATED, MISSING, REFUSED, GATHERING, OUTLIER = range(5)
LOCKED, MAY_SLIP, ANYWHERE = range(3)

WARM_UP_N = EstimatorConfig().warm_up_n
"""Warm-up of the default configuration."""
SHORT_WARM_UP_N = 150
"""Warm-up for short records."""


class Config(ctypes.Structure):
    """driver_config_t: all numbers are doubles."""

    _fields_ = [
        *(
            (name, ctypes.c_double)
            for name in "na nb nk nc offset noise_estimated refresh_n stuck_n idle_n edge_instants".split()
        ),
        *((name, ctypes.c_double) for name in "forgetting random_walk p0 p0_offset noise_variance".split()),
        ("c", ctypes.c_double * 2),
        *((name, ctypes.c_double) for name in "edge_codes code_low code_high".split()),
        *((name, ctypes.c_double) for name in "kind ceiling hold_off_n warm_up_n absolute reset custom".split()),
    ]


@dataclass(frozen=True)
class Result:
    """Results of each of n samples."""

    theta: NDArray[np.float32]
    innovation: NDArray[np.float32]
    statistic: NDArray[np.float32]
    alarms: NDArray[np.int64]
    """Sample indices."""
    status: NDArray[np.uint8]
    idle: NDArray[np.uint8]
    counters: Mapping[str, int]
    variance: NDArray[np.float64]
    """Variance of each parameter, after the last sample, in noise variances."""
    noise_variance: float
    """After the last sample; codes^2."""


CHANGES = (
    *("undecided", "M", "B", "K", "several"),
    *(
        f"{channel} {fault}"
        for channel in ("force", "displacement")
        for fault in ("offset", "gain", "delay", "stuck", "noise")
    ),
)


@dataclass(frozen=True, eq=False)
class Isolated:
    """The diagnoses of t runs; (t,) each."""

    alarm: NDArray[np.float64]
    """Sample; the length of the run if there was none."""
    at: NDArray[np.float64]
    """Sample of the diagnosis; the length of the run if there was none."""
    change: NDArray[np.str_]
    """One of CHANGES."""
    extent: NDArray[np.float64]
    """New over old, at the diagnosis."""
    refined: NDArray[np.float64]
    """The same, at the end of the run."""
    onset_n: NDArray[np.float64]
    """Samples from the onset to the alarm, at the diagnosis; the least and the most likewise."""
    least_n: NDArray[np.float64]
    most_n: NDArray[np.float64]


SLICES_N = 22
"""EST_ISOLATION_SLICES_N of est_isolation.h: slices of work of a sample that is weighed."""


@dataclass(frozen=True, eq=False)
class Diagnosed:
    """Results of est_isolation for n steps that were given to it."""

    left: NDArray[np.intc]
    """(n,) after how many of the slices of work after this step there was more to do."""
    change: str
    """One of CHANGES, at the end; and the following likewise."""
    extent: float
    samples_n: int
    """Samples after the alarm that it rests on."""


CAUSES = ("none", "drift", "hum", "edges", "nonlinear", "noise", "slow plant", "excitation")


@dataclass(frozen=True, eq=False)
class Watched:
    """Results of est_fit for t runs of n samples."""

    cause: NDArray[np.uint8]
    """(t, n): index in CAUSES after each sample."""
    strength: NDArray[np.float64]
    """(t,) after the last sample; and the following likewise."""
    frequency: NDArray[np.float64]
    """Cycles per sample."""

    def share(self, cause: str, sample: int = -1) -> float:
        """Share of the runs with this cause after a sample."""
        return float(np.mean(self.cause[:, sample] == CAUSES.index(cause)))


class Estimator:
    """One estimator at a time, as in the driver."""

    def __init__(self, library: Path) -> None:
        self._c = ctypes.CDLL(str(library))
        self._c.driver_variance.restype = ctypes.c_float
        self._c.driver_noise_variance.restype = ctypes.c_float
        self._c.driver_scale.restype = ctypes.c_float

    def default(self) -> Mapping[str, float]:
        """est_config_default(), by the names that the harness has for its fields."""
        config = Config()
        self._c.driver_default(ctypes.byref(config))
        names = {"kind": "trigger"}
        fields = {names.get(name, name): getattr(config, name) for name, *_ in Config._fields_ if name != "custom"}
        c1, c2 = fields.pop("c")
        return fields | {"c1": c1, "c2": c2}

    def for_codes(self, low: float, high: float) -> tuple[float, ...]:
        """Range of the codes of est_config_for_codes()."""
        out = np.zeros(2)
        self._c.driver_for_codes(ctypes.c_double(low), ctypes.c_double(high), ctypes.c_void_p(out.ctypes.data))
        return tuple(out.tolist())

    def init(self, **changes: float | tuple[float, float]) -> bool:
        """est_init() with the default configuration, a short warm-up, and these changes."""
        config = Config()
        self._c.driver_default(ctypes.byref(config))
        config.warm_up_n = SHORT_WARM_UP_N
        for name, value in changes.items():
            setattr(config, name, (ctypes.c_double * 2)(*value) if isinstance(value, tuple) else value)
        return bool(self._c.driver_init(ctypes.byref(config)))

    def run(self, u: ArrayLike, y: ArrayLike, valid: ArrayLike | None = None) -> Result:
        """est_step() for every sample; fails if the invariants do not hold after any of them."""
        u_, y_ = (np.ascontiguousarray(x, dtype=np.float64) for x in (u, y))
        n = len(u_)
        valid_ = np.ascontiguousarray(np.ones(n) if valid is None else valid, dtype=np.uint8)
        theta = np.zeros((n, self._c.driver_theta_count()), np.float32)
        innovation, statistic = np.zeros(n, np.float32), np.zeros(n, np.float32)
        alarm, status, idle = (np.zeros(n, np.uint8) for _ in range(3))
        arrays = (u_, y_, valid_, theta, innovation, statistic, alarm, status, idle)
        held = self._c.driver_run(ctypes.c_size_t(n), *(ctypes.c_void_p(a.ctypes.data) for a in arrays))
        assert held, "est_invariants_hold() was false, or est_copy_theta() is another than est_theta()"
        counters = (ctypes.c_uint * len(COUNTERS))()
        self._c.driver_counters(counters)
        variance = np.array([self._c.driver_variance(i) for i in range(theta.shape[1])])
        named = dict(zip(COUNTERS, counters, strict=True))
        noise_variance = float(self._c.driver_noise_variance())
        return Result(
            theta, innovation, statistic, np.flatnonzero(alarm), status, idle, named, variance, noise_variance
        )

    def age_counters(self) -> None:
        """Sets all counters to one below their limits."""
        self._c.driver_age_counters()

    def scale(self) -> float:
        """est_scale(), in codes^2."""
        return float(self._c.driver_scale())

    def inflate(self, inflation: float) -> None:
        """Sets the inflation of the scale, as after alarms that were not justified."""
        self._c.driver_inflate(ctypes.c_double(inflation))

    def partial_correlations(self) -> NDArray[np.float64]:
        """(2,) of the innovations, at lags 1 and 2."""
        return self._correlation()[0]

    def reads_twice(self) -> bool:
        """True if the innovations have a second reading."""
        return self._correlation()[1]

    def _correlation(self) -> tuple[NDArray[np.float64], bool]:
        partial = np.zeros(2)
        reads = self._c.driver_correlation(ctypes.c_void_p(partial.ctypes.data))
        return partial, bool(reads)

    def invariants_hold_if_damaged(self, way: int) -> bool:
        """Result of est_invariants_hold() for a state damaged in one of the ways 0 .. 9; 10: not at all."""
        return bool(self._c.driver_invariants_hold_if_damaged(way))

    def watch(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Whole runs (t, n), each from the start: where the alarms came (t, n), and theta at the end (t, p). Fast."""
        runs, samples = u.shape
        alarm = np.zeros((runs, samples), np.bool_)
        theta = np.zeros((runs, self._c.driver_theta_count()), np.float32)
        arrays = (np.ascontiguousarray(u), np.ascontiguousarray(y), alarm, theta)
        pointers = (ctypes.c_void_p(a.ctypes.data) for a in arrays)
        self._c.driver_watch(ctypes.c_size_t(runs), ctypes.c_size_t(samples), *pointers)
        return alarm, theta

    def parameters(self, period_s: float, n_per_code: float, m_per_code: float) -> tuple[float, ...] | None:
        """est_isolation_parameters(): M, B and K, or None if it returns false."""
        out = np.full(3, -1.0)
        units = (ctypes.c_double(unit) for unit in (period_s, n_per_code, m_per_code))
        found = bool(self._c.driver_parameters(*units, ctypes.c_void_p(out.ctypes.data)))
        assert found or (out == -1.0).all()
        return tuple(out.tolist()) if found else None

    def can_isolate(self) -> bool:
        """est_isolation_init() with the configuration of the last init()."""
        return bool(self._c.driver_can_isolate())

    def isolate(
        self,
        u: NDArray[np.float64],
        y: NDArray[np.float64],
        start: NDArray[np.int64],
        valid: ArrayLike | None = None,
        slices: int = DEVICE_SLICES_N,
        force_zero: float = 0.0,
    ) -> Isolated:
        """Whole runs (t, n), each from the start: the diagnosis of the first alarm at or after ``start`` (t,).

        :param slices: of work per sample, as many as in the device.
        :param force_zero: u where the force is zero.
        """
        runs, samples = u.shape
        found = np.zeros((runs, 8))
        valid_ = np.ascontiguousarray(np.ones((runs, samples)) if valid is None else valid, dtype=np.uint8)
        inputs = (np.ascontiguousarray(u), np.ascontiguousarray(y), valid_, np.ascontiguousarray(start, np.int64))
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in inputs]
        counts = (ctypes.c_size_t(runs), ctypes.c_size_t(samples))
        self._c.driver_isolate(
            *counts, *pointers, slices, ctypes.c_double(force_zero), ctypes.c_void_p(found.ctypes.data)
        )
        alarm, at, change, extent, refined, onset, least, most = found.T
        return Isolated(alarm, at, np.array(CHANGES)[change.astype(int)], extent, refined, onset, least, most)

    def can_watch_fit(self) -> bool:
        """est_fit_init() with the configuration of the last init()."""
        return bool(self._c.driver_can_watch_fit())

    def watch_fit(self, u: ArrayLike, y: ArrayLike, valid: ArrayLike | None = None) -> Watched:
        """Whole runs (t, n), each from the start."""
        signals: list[NDArray[Any]] = [np.ascontiguousarray(x, np.float64) for x in (u, y)]
        runs, samples = signals[0].shape
        valid_ = np.ascontiguousarray(np.ones((runs, samples)) if valid is None else valid, np.uint8)
        cause, found = np.zeros((runs, samples), np.uint8), np.zeros((runs, 2))
        pointers = (ctypes.c_void_p(x.ctypes.data) for x in (*signals, valid_, cause, found))
        self._c.driver_watch_fit(ctypes.c_size_t(runs), ctypes.c_size_t(samples), *pointers)
        return Watched(cause, *found.T)

    def judge_fit(
        self,
        u: ArrayLike,
        y: ArrayLike,
        innovation: ArrayLike,
        status: ArrayLike | None = None,
        alarms: ArrayLike = (),
        inflation: float = 1.0,
    ) -> Watched:
        """Misfits of one run (n,) whose innovations are given instead of those of the estimator.

        :param alarms: samples with an alarm.
        :param inflation: of the scale.
        """
        signals: list[NDArray[Any]] = [np.ascontiguousarray(x, np.float64) for x in (u, y, innovation)]
        n = len(signals[-1])
        status_ = np.ascontiguousarray(np.zeros(n) if status is None else status, np.uint8)
        alarm = np.zeros(n, np.uint8)
        alarm[np.asarray(alarms, np.int64)] = 1
        cause, found = np.zeros((1, n), np.uint8), np.zeros((1, 2))
        pointers = (ctypes.c_void_p(x.ctypes.data) for x in (*signals, status_, alarm, cause, found))
        self._c.driver_judge_fit(ctypes.c_size_t(n), ctypes.c_double(inflation), *pointers)
        return Watched(cause, *found.T)

    def diagnose(self, theta: ArrayLike, steps: NDArray[np.float64], slices: int = SLICES_N) -> Diagnosed:
        """Play steps (n, 3) of statistic, status and alarm to est_isolation; theta stays as it is.

        The force is a square wave, which the plant does not answer.
        """
        n = len(steps)
        u = 1000.0 * (np.arange(n) // 25 % 2)
        numbers = [np.ascontiguousarray(x, np.float64) for x in (theta, u, np.zeros(n), steps[:, 0])]
        flags = [np.ascontiguousarray(steps[:, i], np.uint8) for i in (1, 2)]
        worked, found = np.zeros(n, np.intc), np.zeros(3)
        inputs = [ctypes.c_void_p(x.ctypes.data) for x in numbers] + [ctypes.c_void_p(x.ctypes.data) for x in flags]
        ends = (ctypes.c_void_p(worked.ctypes.data), ctypes.c_void_p(found.ctypes.data))
        self._c.driver_diagnose(ctypes.c_size_t(n), *inputs, slices, *ends)
        return Diagnosed(worked, CHANGES[int(found[0])], float(found[1]), int(found[2]))


def compile_driver(folder: Path, *options: str) -> Path:
    """The driver as a shared library, with the strict warnings of the project; options come last."""
    if not options and os.environ.get("EST_COVERAGE"):  # estimator_c/evidence/coverage.py counts there
        folder, options = Path(os.environ["EST_COVERAGE"]), COVERED
    library = folder / f"est_driver_{len(list(folder.iterdir()))}.so"
    folders = (CORE, ISOLATION, FIT)
    sources = [
        Path(__file__).with_name("est_driver.c"),
        *(path for each in folders for path in sorted(each.glob("*.c"))),
    ]
    include = [f"-I{each}" for each in folders]
    command = [os.environ.get("CC", "cc"), "-O2", *STRICT, *options, "-shared", "-fPIC", *include]
    subprocess.run([*command, "-o", str(library), *map(str, sources)], check=True)
    return library
