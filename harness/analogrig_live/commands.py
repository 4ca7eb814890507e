"""Commands of clients to a live session: typed tables, checked before anything is done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from analogrig import ConfigurationError
from analogrig.config import build, check_range
from analogrig.links import Direction
from analogrig.scenario import MAX_RAMP_N

MOST_STEPS = 1_000_000
SLOWEST, FASTEST = 1e6, 1e-3
"""Limits of the time factor: wall-clock time per machine time."""

Mode = Literal["POT SET", "INITIAL CONDITION", "HOLD", "OPERATE"]
Fault = Literal["noise", "hum", "stuck", "skew"]


@dataclass(frozen=True)
class Turn:
    """Turn a pot to a value of its parameter, at once or over ``ramp_n`` samples."""

    name: str
    value: float
    ramp_n: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.ramp_n <= MAX_RAMP_N:
            raise ValueError(f"ramp_n must be 0 to {MAX_RAMP_N}, not {self.ramp_n}")


@dataclass(frozen=True)
class Generate:
    """Set the generator; None leaves a setting as it is. The machine starts from rest."""

    on: bool | None = None
    shape: Literal["square", "pulse", "prbs", "sine"] | None = None
    low_v: float | None = None
    high_v: float | None = None
    frequency_hz: float | None = None
    phase: float | None = None
    duty: float | None = None
    drift_ppm: float | None = None


@dataclass(frozen=True)
class Operate:
    """Switch the computer to a mode, through the modes between."""

    mode: Mode


@dataclass(frozen=True)
class SetPlaying:
    """Run, or pause."""

    on: bool


@dataclass(frozen=True)
class Step:
    """Play so many samples, and pause."""

    samples: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.samples <= MOST_STEPS:
            raise ValueError(f"samples must be 1 to {MOST_STEPS}, not {self.samples}")


@dataclass(frozen=True)
class Tempo:
    """Set the time factor: 1 is real time, 10 is ten times slower."""

    factor: float

    def __post_init__(self) -> None:
        check_range(self, "factor", FASTEST, SLOWEST)


@dataclass(frozen=True)
class Restart:
    """Start machine and device again, from rest."""


@dataclass(frozen=True)
class Inject:
    """Switch a fault on or off."""

    fault: Fault
    on: bool


@dataclass(frozen=True)
class Spoil:
    """Inject a fault of the device's line into the next frame of one direction."""

    kind: str
    direction: Direction = "to"


@dataclass(frozen=True)
class Mend:
    """End the faults of the device's line."""


@dataclass(frozen=True)
class SetRecording:
    """Start a recording, from rest, or end and save it."""

    on: bool


@dataclass(frozen=True)
class ClearLamps:
    """Put the overload lamps out."""


Command = (
    Turn | Generate | Operate | SetPlaying | Step | Tempo | Restart | Inject | Spoil | Mend | SetRecording | ClearLamps
)

_COMMANDS: Mapping[str, type[Command]] = {
    "turn": Turn,
    "generate": Generate,
    "operate": Operate,
    "play": SetPlaying,
    "step": Step,
    "tempo": Tempo,
    "restart": Restart,
    "inject": Inject,
    "spoil": Spoil,
    "mend": Mend,
    "record": SetRecording,
    "clear lamps": ClearLamps,
}
"""Commands by their names in messages."""


def command_of(name: object, table: Mapping[str, Any]) -> Command:
    """Command of a message.

    :raises ConfigurationError: there is no such command, or its table is wrong.
    """
    if not isinstance(name, str) or name not in _COMMANDS:
        raise ConfigurationError(f"no command is called {name!r}: there are {', '.join(_COMMANDS)}")
    return build(_COMMANDS[name], table, name)
