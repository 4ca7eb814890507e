"""Scenario: excitation, plant, pot changes and expectations of one play. The device never receives the pot changes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from analogrig import config
from analogrig.plant import LEAST_PARAMETER, MAX_CHANGES, MAX_SAMPLES, MOST_PARAMETER, Plant, Segment
from analogrig.trust import FiledName, resolve_name
from analogrig.wording import number_of
from analogrig_emulator import PROGRAMS, Excitation

MAX_RAMP_N = 100_000

MAX_TRIES = 1000
"""Largest number of seeds that a statement may try."""

DEFAULT_SEED = 1995
"""Random seed if neither the user nor the scenario sets one."""

_MASS_DAMPER_SPRING = ("front", "shock")
"""Programs that ``Plant`` describes. Bounds and estimates of others have no meaning."""

PLANTS = {name: Plant(*list(program.values.values())[:3]) for name, program in PROGRAMS.items()}
"""Initial parameters of each program of the computer."""

MOST_SEED = 2**63

Limit = bool | int | float | str
"""Value of a limit of a statement."""

MISSING = "clipped and missing for the device"
"""Predicate for missing samples, for messages."""


@dataclass(frozen=True)
class PlantChoice:
    """Program on the computer and initial settings of its pots: mass in kg, damping in N s/m, stiffness in N/m.

    None: the value of the program. ValueError: a value is not positive.
    """

    set: Literal["front", "shock", "bump-stop", "two-mass"] = "front"
    mass_kg: float | None = None
    damping_n_s_per_m: float | None = None
    stiffness_n_per_m: float | None = None

    def __post_init__(self) -> None:
        _check_parameters(self)

    def overrides(self) -> dict[str, float]:
        """Parameters that differ from the program's, by their names in Plant."""
        return _overrides(self)

    def plant(self) -> Plant:
        """Plant with the program's parameters and the overrides."""
        return _apply_overrides(PLANTS[self.set], self)


@dataclass(frozen=True)
class PotChange:
    """Change of pots at the instant of a sample: mass in kg, damping in N s/m, stiffness in N/m; None: unchanged.

    The next sample is the first one affected. With ``ramp_n`` the pots turn linearly from that instant and arrive
    ``ramp_n`` samples later. ValueError: nothing changes, or a value is out of range.
    """

    sample: int
    mass_kg: float | None = None
    damping_n_s_per_m: float | None = None
    stiffness_n_per_m: float | None = None
    ramp_n: int = 0

    def __post_init__(self) -> None:
        _check_parameters(self)
        if self.sample < 1:
            raise ValueError(f"sample must be at least 1, not {self.sample}")
        if not 0 <= self.ramp_n <= MAX_RAMP_N:
            raise ValueError(f"ramp_n must be in 0 .. {MAX_RAMP_N}, not {self.ramp_n}")
        if not _overrides(self):
            raise ValueError("a pot change must set mass_kg, damping_n_s_per_m or stiffness_n_per_m")

    def overrides(self) -> dict[str, float]:
        """Changed parameters, by their names in Plant."""
        return _overrides(self)


@dataclass(frozen=True)
class Expectations:
    """Requirements of a scenario on the device; its ``[expect]`` table. ValueError: a value is out of range."""

    missed: int = 0
    """Largest number of detectable changes (the bound was reached) without an alarm."""
    false_alarms: int = 0
    """Largest number of false alarms in the run."""
    arl0: float = 1e5
    """Mean samples between false alarms that the bound assumes if the device's trigger has no ceiling of its own."""
    late_information_ratio: float = 4.0
    """Information at the deadline, as a multiple of ln ARL0; see ``late_slack_n``."""
    late_slack_n: int = 15
    """Samples from reaching that information to the deadline. A later alarm is late."""
    max_missing_fraction: float = 0.25
    """Largest share of missing samples in a valid run; a run with more is INCONCLUSIVE."""

    def __post_init__(self) -> None:
        if not self.arl0 > 1.0:
            raise ValueError(f"arl0 must be more than 1 sample, not {self.arl0:g}")
        if not self.late_information_ratio >= 1.0:
            raise ValueError(f"late_information_ratio must be at least 1, not {self.late_information_ratio:g}")
        if not 0.0 <= self.max_missing_fraction <= 1.0:
            raise ValueError(f"max_missing_fraction must be in 0 .. 1, not {self.max_missing_fraction:g}")
        for name in ("missed", "false_alarms", "late_slack_n"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative")

    def excess_missing(self, samples: int, missing: int, words: str = MISSING) -> list[str]:
        """Reason that a run with so many missing samples is not valid, in a list; empty if it is valid."""
        if missing <= self.max_missing_fraction * samples:
            return []
        allowed = f"more than the {self.max_missing_fraction:.0%} that the scenario allows"
        verb = "was" if missing == 1 else "were"
        return [f"{missing} of {number_of(samples, 'sample')} {verb} {words}, {allowed}"]


@dataclass(frozen=True)
class Statement:
    """Assertion of a test that the scenario violated; its ``[statement]`` table."""

    name: str
    limits: Mapping[str, Limit] = field(default_factory=dict)
    """Limits of the assertion, by name."""
    tries: int = 1
    """Number of consecutive seeds, with one of which the assertion must hold; an experiment has its own."""
    test: str = ""
    """Name of the test, for information."""

    def __post_init__(self) -> None:
        if not 1 <= self.tries <= MAX_TRIES:
            raise ValueError(f"tries must be in 1 .. {MAX_TRIES}, not {self.tries}")


@dataclass(frozen=True)
class Scenario:
    """Excitation, plant and changes of one play, in samples, and the expectations of the device.

    ``load`` reads a shipped scenario by name or a .toml file, and raises ConfigurationError. ValueError: a value is out
    of range.
    """

    samples: int
    excitation: Excitation
    plant: PlantChoice = field(default_factory=PlantChoice)
    tweaks: tuple[PotChange, ...] = ()
    expect: Expectations = field(default_factory=Expectations)
    random_phase: bool = False
    """The excitation's phase is drawn from the seed instead of taken from ``excitation.phase``."""
    seed: int | None = None
    """Default random seed; None: DEFAULT_SEED."""
    rig: str = ""
    """Default rig: a name, or a .toml file relative to the scenario's folder."""
    dut: str = ""
    """Default device, likewise."""
    statement: Statement | None = None
    """Violated assertion that replays of a counterexample check; None: ``expect`` is checked."""
    description: str = ""
    name: str = ""

    def __post_init__(self) -> None:
        if self.seed is not None and not 0 <= self.seed < MOST_SEED:
            raise ValueError(f"seed must be 0 to 2^63 - 1, not {self.seed}")
        if not 1 <= self.samples <= MAX_SAMPLES:
            raise ValueError(f"samples must be in 1 .. {MAX_SAMPLES}, not {self.samples}")
        if len(self.tweaks) > MAX_CHANGES:
            raise ValueError(f"there must be at most {MAX_CHANGES} tweaks, not {len(self.tweaks)}")
        instants = [tweak.sample for tweak in self.tweaks]
        if instants != sorted(set(instants)):
            raise ValueError(f"tweaks must come in the order of their samples, each sample once, not {instants}")
        if instants and instants[-1] >= self.samples:
            of = number_of(self.samples, "sample")
            raise ValueError(f"the tweak at sample {instants[-1]} is beyond the last of {of}")
        for tweak, following in itertools.pairwise(self.tweaks):
            if tweak.sample + tweak.ramp_n > following.sample:
                raise ValueError(
                    f"the tweak at sample {tweak.sample} lasts {number_of(tweak.ramp_n, 'sample')},"
                    f" beyond the next one at {following.sample}"
                )

    @classmethod
    def load(cls, name: str) -> Scenario:
        """Load a shipped scenario by name, or a user's .toml file.

        :raises ConfigurationError: absent, not TOML, or not a scenario; names the file and the key.
        """
        path = config.locate("scenarios", name)
        scenario = cls.from_table(config.read_toml(path), str(path), default_name=path.stem)
        rig, dut = (resolve_name(path, each) for each in (scenario.rig, scenario.dut))
        return dataclasses.replace(scenario, rig=rig, dut=dut)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], where: str, default_name: str = "") -> Scenario:
        """Build a scenario from TOML values; ``where``, the name of their file, leads every error.

        :raises ConfigurationError: not a scenario; names the key.
        """
        scenario = config.build(cls, {"name": default_name, **table}, where)
        return dataclasses.replace(scenario, dut=FiledName(scenario.dut, where)) if scenario.dut else scenario

    def as_table(self) -> dict[str, Any]:
        """Plain TOML values, from which ``from_table`` builds an equal scenario."""
        table: dict[str, Any] = config.plain(dataclasses.asdict(self))
        return table

    def draw_excitation(self, rng: np.random.Generator) -> Excitation:
        """Excitation of one run, with a random phase if ``random_phase`` is set."""
        phase = self.draw_phase(rng)
        return self.excitation if phase == self.excitation.phase else dataclasses.replace(self.excitation, phase=phase)

    def draw_phase(self, rng: np.random.Generator) -> float:
        """Phase of the excitation of one run: its own, or a random one if ``random_phase`` is set."""
        return float(rng.uniform()) if self.random_phase else self.excitation.phase

    @property
    def caveats(self) -> tuple[str, ...]:
        """Reasons that runs are not judged; empty for the programs of a mass, a damper and a spring."""
        program = self.plant.set
        if program in _MASS_DAMPER_SPRING:
            return ()
        return (f"the program {program} is not a single mass, damper and spring, as bounds and estimates require",)

    def segments(self) -> tuple[Segment, ...]:
        """True plant from the start and after each change; with two masses, that of the sprung mass."""
        out = [Segment(0, self.plant.plant())]
        for tweak in self.tweaks:
            changed = _apply_overrides(out[-1].plant, tweak)
            if changed == out[-1].plant:
                continue  # a pot set to where it stood changes nothing, and nothing can be detected
            out.append(Segment(tweak.sample, changed, tweak.ramp_n))
        return tuple(out)


def _overrides(change: PlantChoice | PotChange) -> dict[str, float]:
    values = {item.name: getattr(change, item.name) for item in dataclasses.fields(Plant)}
    return {name: value for name, value in values.items() if value is not None}


def _apply_overrides(plant: Plant, change: PlantChoice | PotChange) -> Plant:
    return dataclasses.replace(plant, **_overrides(change))


def _check_parameters(change: PlantChoice | PotChange) -> None:
    for name, value in _overrides(change).items():
        if not LEAST_PARAMETER < value < MOST_PARAMETER:
            limit = f"less than {MOST_PARAMETER:g}" if value > LEAST_PARAMETER else f"more than {LEAST_PARAMETER:g}"
            limit = limit if value > 0.0 else "more than 0"
            raise ValueError(f"{name} must be {limit}, not {value:g}")
