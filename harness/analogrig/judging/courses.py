"""Courses of the displacement with and without each change of a run, from any model of the plant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from analogrig.run import CHUNK_SAMPLES

Values = Mapping[str, float]
"""Parameters of the plant by name."""


class Course(Protocol):
    """Displacement from the sample after a moment on."""

    def advance(self, samples: int) -> NDArray[np.float64]:
        """Displacement of the next samples in LSB, (samples,)."""


class Model(Protocol):
    """Plant of a run. A moment is its state at one sample, in the model's own form."""

    def at_rest(self, start: int, values: Values) -> Any:
        """Moment of sample ``start``, the first of a record."""

    def follow(self, moment: Any, before: Values, after: Values, ramp_n: int, samples: int) -> Any:
        """Moment so many samples later; the other arguments as for ``course``."""

    def course(self, moment: Any, before: Values, after: Values, ramp_n: int) -> Course:
        """Course from a moment on, at which the parameters change at once or over a ramp."""

    def rival(self, moment: Any, values: Values) -> Course | None:
        """Course from a moment on with other parameters; None: the plant cannot have them."""


@dataclass(frozen=True)
class Change:
    """One change of the plant in a run."""

    start: int
    samples: int
    """Samples after ``start`` up to the next change or the end."""
    before: Values
    after: Values
    ramp_n: int
    moment: Any
    """Moment of the model at ``start``."""

    @property
    def changed(self) -> tuple[str, ...]:
        """Names of the parameters that change."""
        return tuple(name for name, value in self.after.items() if value != self.before[name])

    def course(self, model: Model) -> Course:
        """Course with the change."""
        return model.course(self.moment, self.before, self.after, self.ramp_n)

    def unchanged(self, model: Model) -> Course:
        """Course without it."""
        return model.course(self.moment, self.before, self.before, 0)

    def chunks(self) -> Iterator[slice]:
        """Samples after ``start`` in chunks, counted from 0."""
        for first in range(0, self.samples, CHUNK_SAMPLES):
            yield slice(first, min(first + CHUNK_SAMPLES, self.samples))


def changes_between(
    model: Model,
    stretches: Iterable[tuple[int, int, Values]],
    ramps_n: Mapping[int, int],
    records: Sequence[int] = (0,),
) -> Iterator[Change]:
    """Changes between stretches (start, end, values). The plant is at rest at the start of each record."""
    moment: Any = None
    before: Values | None = None
    stretches = list(stretches)
    for i, (start, end, values) in enumerate(stretches):
        if start in records:
            moment = model.at_rest(start, values)
        ramp_n = ramps_n.get(start, 0) if before else 0
        change = Change(start, end - start - 1, before or values, values, ramp_n, moment)
        if before is not None:
            yield change
        if i + 1 < len(stretches) and stretches[i + 1][0] not in records:
            moment = model.follow(moment, change.before, values, ramp_n, end - start)
        before = values


def first_at_level(information: Sequence[float] | NDArray[np.float64], level: float) -> int | None:
    """Smallest n with I(n) >= level, or None."""
    reached = np.flatnonzero(np.asarray(information) >= level)
    return int(reached[0]) + 1 if len(reached) else None
