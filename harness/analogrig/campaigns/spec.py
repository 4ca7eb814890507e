"""File of a campaign: TOML that defines what is played."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.plant import MAX_SAMPLES
from analogrig.trust import resolve_name

MAX_CELLS, MAX_TRIALS = 10_000, 10_000_000


Axes = Mapping[str, tuple[float, ...]]
"""Values by axis: a parameter at the start (``K``), its factor at the change (``K_factor``), or ``noise_lsb``."""


def corners(draw: Axes) -> tuple[dict[str, float], ...]:
    """Low ends of all drawn axes, and high ends of all of them.

    Every pot and the noise stay between their values at these two corners: a parameter and its factor move the same
    pot in the same direction.
    """
    return tuple({axis: ends[i] for axis, ends in draw.items()} for i in range(2 if draw else 0))


@dataclass(frozen=True)
class Stop:
    """The ``[stop]`` table: a cell ends once its rate is certain to be above or below ``rate``.

    The decision comes from a confidence sequence, which may be evaluated after every trial.
    """

    quantity: Literal["missed", "false_alarms"]
    """``missed``: missed fraction of the detectable changes; ``false_alarms``: false alarms per sample."""
    rate: float
    confidence: float = 0.99

    def __post_init__(self) -> None:
        for name in ("rate", "confidence"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be between 0 and 1, not {getattr(self, name):g}")


@dataclass(frozen=True)
class CampaignSpec:
    """File of a campaign."""

    scenario: str = "healthy"
    rigs: tuple[str, ...] = ("emulator",)
    devices: tuple[str, ...] = ("inproc",)
    trials: int = 100
    """Number of trials of each cell, with consecutive seeds from ``first_seed`` on."""
    first_seed: int = 0
    chunk: int = 10
    """Number of trials of a cell between two looks of ``[stop]``."""
    samples: int | None = None
    """Number of samples of each trial; overrides the scenario's."""
    false_alarms: int | None = None
    """Largest number of false alarms in a trial that passes; overrides the scenario's."""
    change_at: int = 1000
    """Sample at which the factors take effect."""
    grid: Axes = field(default_factory=dict)
    """Table ``[grid]``: every combination of these values is a cell. Axes are in order of their names."""
    draw: Axes = field(default_factory=dict)
    """Table ``[draw]``: values drawn for each trial from its seed, uniformly between the ends (low, high)."""
    stop: Stop | None = None
    description: str = ""
    name: str = ""

    def __post_init__(self) -> None:
        if self.samples is not None and not 1 <= self.samples <= MAX_SAMPLES:
            raise ValueError(f"samples must be 1 to {MAX_SAMPLES}, not {self.samples}")
        if self.false_alarms is not None and self.false_alarms < 0:
            raise ValueError(f"false_alarms must not be negative, not {self.false_alarms}")
        for name in ("rigs", "devices"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise ValueError(f"{name} must name at least one, and each once")
        for name, most in (("trials", MAX_TRIALS), ("chunk", MAX_TRIALS), ("change_at", 2**31)):
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be 1 to {most}, not {getattr(self, name)}")
        if not 0 <= self.first_seed < 2**62:
            raise ValueError(f"first_seed must be 0 to 2^62, not {self.first_seed}")
        _check_axes(self.grid, self.draw)
        # The numbers of cells and of draws follow the order of the axes, which must survive a plan's text.
        for name in ("grid", "draw"):
            object.__setattr__(self, name, dict(sorted(getattr(self, name).items())))

    @classmethod
    def load(cls, name: str) -> CampaignSpec:
        """Shipped campaign by name, or a user's .toml file.

        :raises ConfigurationError: absent, not TOML, or no campaign; names the file and the key.
        """
        path = config.locate("campaigns", name)
        spec = config.build(cls, {"name": path.stem, **config.read_toml(path)}, str(path))
        if "/" in spec.name or spec.name in {"", ".", ".."} or not spec.name.isprintable():
            raise ConfigurationError(f"{path}: name must be one that a file can have, not {spec.name!r}")
        rigs, devices = (tuple(resolve_name(path, each) for each in names) for names in (spec.rigs, spec.devices))
        return dataclasses.replace(spec, scenario=resolve_name(path, spec.scenario), rigs=rigs, devices=devices)


def _check_axes(grid: Axes, draw: Axes) -> None:
    """:raises ValueError: a value is there twice, or is no pair of ends."""
    for axis, values in grid.items():
        if not values or len(set(values)) != len(values):
            raise ValueError(f"grid: {axis} has {'a value twice' if values else 'no value'}")
    for axis, ends in draw.items():
        if len(ends) != 2 or not ends[0] < ends[1]:
            raise ValueError(f"draw: {axis} must be (low, high), not ({', '.join(f'{end:g}' for end in ends)})")
        if axis in grid:
            raise ValueError(f"{axis}: in the grid and drawn as well")
