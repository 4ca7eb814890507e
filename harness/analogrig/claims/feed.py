"""Replay of the bundled estimator library: steps of samples in, one row of answers for each sample out."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.devices.library import Estimator, estimator_library_for
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from analogrig.run import Run

Matrix = NDArray[np.float32]

INNOVATION, STATISTIC, ALARM = "innovation", "statistic", "alarm"


@dataclass(frozen=True, eq=False)
class Feed:
    """Steps of the library, and the step whose answer each sample has."""

    u: NDArray[np.float32]
    """(m,) input of each step."""
    y: NDArray[np.float32]
    """(m,)"""
    valid: NDArray[np.bool_]
    """(m,)"""
    answer: NDArray[np.int64]
    """(n,): step after which each sample is answered; -1: before the first step."""
    restarts: tuple[int, ...] = (0,)
    """Steps before which the library begins anew."""

    @classmethod
    def of(cls, run: Run) -> Self:
        """Steps that a sound device of the run makes: each sample once, anew for each record."""
        codes = run.codes.astype(np.float32)
        valid = ~(run.missing | run.lost)
        return cls(codes[:, 0].copy(), codes[:, 1].copy(), valid, np.arange(run.samples), run.conditions.records)

    def upto(self, samples: int) -> Self:
        """The feed of the first samples."""
        answer = self.answer[:samples]
        steps = max(int(answer.max(initial=-1)) + 1, min(samples, len(self.u)))
        restarts = tuple(each for each in self.restarts if each < max(steps, 1))
        return type(self)(self.u[:steps], self.y[:steps], self.valid[:steps], answer, restarts)

    def altered(self, **arrays: Any) -> Self:
        """The feed with other ``u``, ``y`` or ``valid``."""
        values: dict[str, Any] = {
            name: np.asarray(x, np.bool_ if name == "valid" else np.float32) for name, x in arrays.items()
        }
        return dataclasses.replace(self, **values)

    def put(self, at: int, **values: float) -> Self:
        """The feed with other values of one step."""
        return self.altered(**{name: np.where(self.at(at), x, getattr(self, name)) for name, x in values.items()})

    def at(self, *steps: int) -> NDArray[np.bool_]:
        """(m,): true at these steps."""
        return np.isin(np.arange(len(self.u)), steps)

    def times(self, times: NDArray[np.int64]) -> Self:
        """The feed with each step made so many times. A sample has the answer of the last of them."""
        ends = np.concatenate([[0], np.cumsum(times)])
        return type(self)(
            np.repeat(self.u, times),
            np.repeat(self.y, times),
            np.repeat(self.valid, times),
            ends[self.answer + 1] - 1,
            tuple(dict.fromkeys(int(ends[each]) for each in self.restarts)),
        )

    def without(self, dropped: NDArray[np.bool_]) -> Self:
        """The feed without some steps; their samples have the answer before."""
        return self.times(1 - dropped.astype(np.int64))

    def twice(self, repeated: NDArray[np.bool_]) -> Self:
        """The feed with some steps made twice; their samples have the answer of the second."""
        return self.times(1 + repeated.astype(np.int64))

    def after(self, earlier: Self) -> Self:
        """The feed continuing after the steps of an earlier one, without a restart between them."""
        first = len(earlier.u)
        later = tuple(each + first for each in self.restarts if each)
        return type(self)(
            np.concatenate([earlier.u, self.u]),
            np.concatenate([earlier.y, self.y]),
            np.concatenate([earlier.valid, self.valid]),
            np.where(self.answer < 0, -1, self.answer + first),
            (*earlier.restarts, *later),
        )

    def restarted(self, *steps: int) -> Self:
        """The feed with more restarts, before these steps."""
        return dataclasses.replace(self, restarts=tuple(sorted({*self.restarts, *steps})))


class Library:
    """The bundled library with one configuration."""

    def __init__(self, config: EstimatorConfig) -> None:
        """:raises ConfigurationError: the estimator refuses the configuration."""
        self.config = config
        names = (("a", 1, config.na), ("b", 0, config.nb), ("c", 1, config.nc))
        theta = [f"{letter}{i + first}" for letter, first, n in names for i in range(n)]
        self.columns = (*theta, *(("offset",) if config.offset else ()), INNOVATION, STATISTIC, ALARM)
        """Names of the columns of a replay."""
        self._estimator = Estimator(config, library=estimator_library_for(config))

    def replay(self, feed: Feed) -> Matrix:
        """(n, columns): answers to each sample."""
        ends = sorted({0, *feed.restarts, len(feed.u)})
        parts = [np.zeros((1, len(self.columns)), np.float32)]
        for start, end in itertools.pairwise(ends):
            self._estimator.restart()
            out = self._estimator.run(feed.u[start:end], feed.y[start:end], feed.valid[start:end])
            alarm = np.zeros(end - start, np.float32)
            alarm[out.alarms] = 1.0
            parts.append(np.column_stack([out.theta, out.innovation, out.statistic, alarm]))
        return np.concatenate(parts)[feed.answer + 1]


def library_of(config: EstimatorConfig, **settings: Any) -> Library | None:
    """Library with some settings changed; None if there is no such configuration."""
    try:
        return Library(dataclasses.replace(config, **settings))
    except (ConfigurationError, ValueError, TypeError):
        return None
