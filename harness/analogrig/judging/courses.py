"""Courses of the output with and without each change of a run, from any model of the plant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from analogrig.run import CHUNK_SAMPLES

Values = Mapping[str, float]
"""Parameters of the plant by name."""


class Trajectory(Protocol):
    """Output from the sample after a moment on."""

    def advance(self, samples: int) -> NDArray[np.float64]:
        """Output of the next samples in LSB, (samples,)."""

    def moment(self) -> Any:
        """Moment of the last sample."""


class Model(Protocol):
    """Plant of a run. A moment is its state at one sample, in the model's own form."""

    def at_rest(self, start: int, values: Values) -> Any:
        """Moment of sample ``start``, the first of a record."""

    def course(self, moment: Any, before: Values, after: Values, ramp_n: int) -> Trajectory:
        """Trajectory from a moment on, at which the parameters change at once or over a ramp."""

    def rival(self, moment: Any, values: Values) -> Trajectory | None:
        """Trajectory from a moment on with other parameters; None: the plant cannot have them."""


@dataclass(frozen=True)
class PlantChange:
    """One change of the plant in a run."""

    start: int
    before: Values
    after: Values
    moment: Any
    """Moment of the model at ``start``."""
    course_lsb: NDArray[np.float64]
    """Output in the samples after ``start``, up to the next change or the end."""

    @property
    def changed(self) -> tuple[str, ...]:
        """Names of the parameters that change."""
        return tuple(name for name, value in self.after.items() if value != self.before[name])


def changes_between(
    model: Model,
    stretches: Iterable[tuple[int, int, Values]],
    ramps_n: Mapping[int, int],
    records: Sequence[int] = (0,),
) -> Iterator[PlantChange]:
    """Changes between stretches (start, end, values). The plant is at rest at the start of each record."""
    stretches = list(stretches)
    moment: Any = None
    before: Values | None = None
    for i, (start, end, values) in enumerate(stretches):
        is_last = i + 1 == len(stretches)
        if start in records:
            moment = model.at_rest(start, values)
        if before is None and is_last:
            return
        course = model.course(moment, before or values, values, ramps_n.get(start, 0) if before else 0)
        course_lsb = advance(course, end - start - 1)
        if before is not None:
            yield PlantChange(start, before, values, moment, course_lsb)
        if not is_last:
            course.advance(1)
            moment = course.moment()
        before = values


def advance(course: Trajectory, samples: int) -> NDArray[np.float64]:
    """Output of the next samples in LSB, computed in chunks."""
    if samples <= CHUNK_SAMPLES:
        return course.advance(samples) if samples else np.empty(0)
    chunks = (min(CHUNK_SAMPLES, samples - first) for first in range(0, samples, CHUNK_SAMPLES))
    return np.concatenate([course.advance(chunk) for chunk in chunks])


def first_at_level(information: Sequence[float] | NDArray[np.float64], level: float) -> int | None:
    """Smallest n with I(n) >= level, or None."""
    reached = np.asarray(information) >= level
    first = int(reached.argmax()) if reached.size else 0
    return first + 1 if reached.size and reached[first] else None
