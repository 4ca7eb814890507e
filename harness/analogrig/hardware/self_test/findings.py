"""What the self-test says: of each quantity how much, how surely, what is allowed, and what to do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

State = Literal["well", "wrong", "not measured"]

SIGMAS = 3.0
"""A quantity is wrong when it is beyond its limit by more than so many standard errors: one that is exactly at its
limit is called wrong with a probability of 0.0013."""

RESOLUTION = 1.0 / 12.0
"""A standard error above this part of what is allowed, and nothing can be said: then a fault of twice its limit would
be found with a probability of less than 0.9987."""


@dataclass(frozen=True)
class Check:
    """One quantity of one channel, or of both."""

    name: str
    channel: str
    """Empty: of both."""
    value: float
    error: float
    """Standard error; NaN, as the value, if it could not be measured."""
    least: float
    most: float
    """What is allowed."""
    unit: str
    advice: str
    """What to do if it is wrong, or why it could not be measured."""
    note: str = ""
    """What else is to be said of the value."""

    @property
    def state(self) -> State:
        if math.isnan(self.value):
            return "not measured"
        if self.value - SIGMAS * self.error > self.most or self.value + SIGMAS * self.error < self.least:
            return "wrong"
        return "not measured" if self.error > self.most_error else "well"

    @property
    def most_error(self) -> float:
        """With a larger standard error nothing can be said."""
        return RESOLUTION * (self.most - self.least)

    @property
    def what_to_do(self) -> str:
        """About a quantity that is not well."""
        if self.state == "not measured" and not math.isnan(self.value):
            return f"known too poorly: its standard error would have to be at most {self.most_error:.2g}"
        return self.advice

    @property
    def title(self) -> str:
        return f"{self.name} of {self.channel}" if self.channel else self.name

    @property
    def sentence(self) -> str:
        """What, how much, how surely, the limits, what to do: one line."""
        if math.isnan(self.value):
            return f"{self.title}: not measured: {self.advice}"
        known = f"{self.title}: {self.value:.4g} +- {self.error:.2g} {self.unit}".rstrip()
        return f"{known}, allowed {self.least:.4g} to {self.most:.4g}: {self.what_to_do}"


@dataclass(frozen=True)
class Findings:
    """All that one self-test has found."""

    rig: str
    program: str
    checks: tuple[Check, ...]

    def having(self, state: State) -> tuple[Check, ...]:
        return tuple(check for check in self.checks if check.state == state)

    @property
    def well(self) -> bool:
        """Whether all was measured, and is as it should be."""
        return len(self.having("well")) == len(self.checks)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why nothing should be judged on this rig, one line each; none if all is well."""
        return tuple(check.sentence for check in (*self.having("wrong"), *self.having("not measured")))
