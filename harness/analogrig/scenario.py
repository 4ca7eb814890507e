"""Scenario: excitation, program, pot changes and expectations of one play. The device never receives the changes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from analogrig import config
from analogrig.datasheet import DEFAULT_ARL0
from analogrig.errors import ConfigurationError
from analogrig.plant import MAX_CHANGES, MAX_SAMPLES, Plant, Segment, check_parameter
from analogrig.program import Program
from analogrig.trust import FiledName, resolve_name
from analogrig.wording import number_of
from analogrig_emulator import Excitation

__all__ = ["DEFAULT_PROGRAM", "DEFAULT_SEED", "MAX_RAMP_N", "segments_of"]
"""Names for packages beside the core."""

MAX_RAMP_N = 100_000

MAX_TRIES = 1000
"""Largest number of seeds that a statement may try."""

DEFAULT_SEED = 1995
"""Random seed if neither the user nor the scenario sets one."""

DEFAULT_PROGRAM = "front"
"""Program if the scenario names none."""

MOST_SEED = 2**63

Limit = bool | int | float | str
"""Value of a limit of a statement."""

MISSING = "clipped and missing for the device"
"""Predicate for missing samples, for messages."""


@dataclass(frozen=True)
class PotChange:
    """Change of pots at the instant of a sample: new values of parameters, by name.

    The next sample is the first one affected. With ``ramp_n`` the pots turn linearly from that instant and arrive
    ``ramp_n`` samples later. ValueError: nothing changes, or a value is out of range.
    """

    sample: int
    set: Mapping[str, float]
    ramp_n: int = 0

    def __post_init__(self) -> None:
        if self.sample < 1:
            raise ValueError(f"sample must be at least 1, not {self.sample}")
        if not 0 <= self.ramp_n <= MAX_RAMP_N:
            raise ValueError(f"ramp_n must be in 0 .. {MAX_RAMP_N}, not {self.ramp_n}")
        if not self.set:
            raise ValueError("a pot change must set a parameter of the program: set = { NAME = value }")
        for name, value in self.set.items():
            check_parameter(name, value)


@dataclass(frozen=True)
class Expectations:
    """Requirements of a scenario on the device; its ``[expect]`` table. ValueError: a value is out of range."""

    missed: int = 0
    """Largest number of detectable changes (the bound was reached) without an alarm."""
    false_alarms: int = 0
    """Largest number of false alarms in the run."""
    estimate_error: float = 0.25
    """Largest relative error of an estimated parameter at the end of a long segment that determines it."""
    arl0: float = DEFAULT_ARL0
    """Mean samples between false alarms that the bound assumes if the device's trigger has no ceiling of its own."""
    late_information_ratio: float = 4.0
    """Information at the deadline, as a multiple of ln ARL0; see ``late_slack_n``."""
    late_slack_n: int = 15
    """Samples from reaching that information to the deadline. A later alarm is late."""
    max_missing_fraction: float = 0.25
    """Largest share of missing samples in a valid run; a run with more is INCONCLUSIVE."""
    least_exposure: float = 0.5
    """Smallest share of the samples after warm-up in which the trigger must be armed; of all samples, a tenth of it. A
    run with less that shows no fault of the device is INCONCLUSIVE."""

    def __post_init__(self) -> None:
        if not self.arl0 > 1.0:
            raise ValueError(f"arl0 must be more than 1 sample, not {self.arl0:g}")
        if not self.estimate_error > 0.0:
            raise ValueError(f"estimate_error must be more than 0, not {self.estimate_error:g}")
        if not self.late_information_ratio >= 1.0:
            raise ValueError(f"late_information_ratio must be at least 1, not {self.late_information_ratio:g}")
        for name in ("max_missing_fraction", "least_exposure"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in 0 .. 1, not {getattr(self, name):g}")
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
    """Excitation, program and changes of one play, in samples, and the expectations of the device.

    ``load`` reads a shipped scenario by name or a .toml file, and raises ConfigurationError. Values may also be given
    as files spell them: ``program="dc-motor"``. ValueError: a value is out of range.
    """

    samples: int
    excitation: Excitation
    program: Program = field(default_factory=lambda: Program.load(DEFAULT_PROGRAM))
    set: Mapping[str, float] = field(default_factory=dict)
    """Initial values of parameters that differ from the program's, by name."""
    changes: tuple[PotChange, ...] = ()
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
        self._convert()
        if self.seed is not None:
            check_seed(self.seed)
        if not 1 <= self.samples <= MAX_SAMPLES:
            raise ValueError(f"samples must be in 1 .. {MAX_SAMPLES}, not {self.samples}")
        if self.random_phase and self.excitation.shape == "recorded":
            raise ValueError("random_phase: an excitation of the shape recorded has no phase")
        self._check_changes()

    def _convert(self) -> None:
        """Replace values that are spelt as in files.

        :raises ConfigurationError: one is malformed.
        """
        program = Program.of(self.program, "program")
        tables: dict[str, type[Excitation | Expectations]] = {"excitation": Excitation, "expect": Expectations}
        converted: dict[str, Any] = {"program": program}
        for name, kind in tables.items():
            if isinstance(value := getattr(self, name), Mapping):
                converted[name] = config.build(kind, value, name)
        converted["set"] = {program.names.get(name, name): value for name, value in self.set.items()}
        converted["changes"] = tuple(
            config.build(PotChange, _with_set(change, program), f"changes[{i}]")
            if isinstance(change, Mapping)
            else change
            for i, change in enumerate(self.changes)
        )
        for name, value in converted.items():
            object.__setattr__(self, name, value)

    def _check_changes(self) -> None:
        if len(self.changes) > MAX_CHANGES:
            raise ValueError(f"there must be at most {MAX_CHANGES} changes, not {len(self.changes)}")
        instants = [change.sample for change in self.changes]
        if instants != sorted(set(instants)):
            raise ValueError(f"changes must come in the order of their samples, each sample once, not {instants}")
        if instants and instants[-1] >= self.samples:
            of = number_of(self.samples, "sample")
            raise ValueError(f"the change at sample {instants[-1]} is beyond the last of {of}")
        for change, following in itertools.pairwise(self.changes):
            if change.sample + change.ramp_n > following.sample:
                raise ValueError(
                    f"the change at sample {change.sample} lasts {number_of(change.ramp_n, 'sample')},"
                    f" beyond the next one at {following.sample}"
                )
        plant = self.plant
        for i, change in enumerate(self.changes):
            try:
                plant = plant.changed(change.set)
            except ValueError as error:
                raise ValueError(f"changes[{i}]: {error}") from error

    @classmethod
    def load(cls, name: str | Path) -> Scenario:
        """Load a shipped scenario by name, or a user's .toml file.

        :raises ConfigurationError: absent, not TOML, or not a scenario; names the file and the key.
        """
        path = config.locate("scenarios", name)
        table = config.read_toml(path)
        if isinstance(table.get("program"), str):
            table["program"] = resolve_name(path, table["program"])
        scenario = cls.from_table(table, str(path), default_name=path.stem)
        rig, dut = (resolve_name(path, each) for each in (scenario.rig, scenario.dut))
        return dataclasses.replace(scenario, rig=rig, dut=dut)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], where: str, default_name: str = "") -> Scenario:
        """Build a scenario from TOML values; ``where``, the name of their file, leads every error.

        :raises ConfigurationError: not a scenario; names the key.
        """
        scenario = config.build(cls, {"name": default_name, **_with_program(table, where)}, where)
        return dataclasses.replace(scenario, dut=FiledName(scenario.dut, where)) if scenario.dut else scenario

    def as_table(self) -> dict[str, Any]:
        """Plain TOML values, from which ``from_table`` builds an equal scenario."""
        table: dict[str, Any] = config.plain(dataclasses.asdict(self))
        table["program"] = self.program.as_value()
        return table

    def draw_excitation(self, rng: np.random.Generator) -> Excitation:
        """Excitation of one run, with a random phase if ``random_phase`` is set."""
        return dataclasses.replace(self.excitation, phase=rng.random()) if self.random_phase else self.excitation

    @classmethod
    def of_program(cls, program: Program | str) -> Scenario:
        """Scenario that changes the first parameter once, by a fifth as far as its range allows.

        The excitation is a square wave between the levels of the program's trial play.
        """
        program = Program.of(program, "program")
        driven = program.channels[0]
        volts = program.circuit.scales.volts(driven)
        low_v, high_v = (level * volts for level in program.equations.inputs[driven].trial)
        changes: tuple[PotChange, ...] = ()
        for name, row in itertools.islice(program.parameters.items(), 1):
            goals = (max(0.8 * row.value, row.low), min(1.2 * row.value, row.high))
            goal = max(goals, key=lambda value: abs(value / row.value - 1.0))
            changes = (PotChange(1000, {name: goal}),) if goal != row.value else ()
        excitation = Excitation(low_v=low_v, high_v=high_v)
        return cls(1500, excitation, program, changes=changes, random_phase=True, name=program.name)

    def on_program(self, program: Program | str) -> Scenario:
        """The same scenario on another program; its parameters are those of the same name or alias.

        :raises ConfigurationError: the program lacks a parameter of the scenario.
        """
        program = Program.of(program, "program")

        def renamed(values: Mapping[str, float]) -> dict[str, float]:
            names = {name: program.names.get(self.program.parameters[name].alias, name) for name in values}
            return {name if name in program.names else names[name]: value for name, value in values.items()}

        changes = tuple(dataclasses.replace(change, set=renamed(change.set)) for change in self.changes)
        try:
            return dataclasses.replace(self, program=program, set=renamed(self.set), changes=changes)
        except ValueError as error:
            raise ConfigurationError(f"scenario {self.name}: {error}") from error

    def with_plant(self, plant: Plant) -> Scenario:
        """The same scenario with another plant before the first change."""
        return dataclasses.replace(self, program=plant.program, set=plant.overrides)

    @property
    def plant(self) -> Plant:
        """Plant before the first change."""
        return Plant.of(self.program, self.set)

    def poles(self, period_s: float) -> tuple[complex, ...]:
        """Poles of the plant as the scenario begins, one step a sample of ``period_s`` in problem time."""
        return self.program.poles(self.plant.values, period_s)

    def segments(self) -> tuple[Segment, ...]:
        """True plant from the start and after each change."""
        return segments_of(self.plant, self.changes)


def segments_of(plant: Plant, changes: Iterable[PotChange]) -> tuple[Segment, ...]:
    """True plant from the start and after each change."""
    out = [Segment(0, plant)]
    for change in changes:
        changed = out[-1].plant.changed(change.set)
        if changed == out[-1].plant:
            continue  # a pot set to where it stood changes nothing, and nothing can be detected
        out.append(Segment(change.sample, changed, change.ramp_n))
    return tuple(out)


def check_seed(seed: Any) -> int:
    """Return ``seed``.

    :raises ConfigurationError: it is no whole number from 0 to 2^63 - 1.
    """
    if isinstance(seed, int | np.integer) and not isinstance(seed, bool) and 0 <= seed < MOST_SEED:
        return int(seed)
    raise ConfigurationError(f"seed must be a whole number from 0 to 2^63 - 1, not {str(seed)[:40]!r}")


def program_of(table: Any, where: str) -> Program:
    """Program of the table of a scenario.

    :raises ConfigurationError: it is none.
    """
    program: Program = _with_program(table if isinstance(table, Mapping) else {}, where)["program"]
    return program


def _with_program(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The table of a scenario with its program loaded, and with every change of a parameter in ``set``.

    A table ``plant`` is another form of the keys ``program`` and ``set``, with ``set`` as the name of the program and
    parameters beside it. A parameter may stand beside the keys of a change by its alias. ``tweaks`` is the former name
    of ``changes``.
    """
    out = {"changes" if key == "tweaks" and "changes" not in table else key: value for key, value in table.items()}
    if "plant" in out:
        plant = out.pop("plant")
        if not isinstance(plant, Mapping) or "program" in out or "set" in out:
            raise ConfigurationError(f"{where}: plant: write program = ... and set = {{ ... }} instead")
        out |= {"program": plant.get("set", DEFAULT_PROGRAM), "set": {k: v for k, v in plant.items() if k != "set"}}
    program = out["program"] = Program.of(out.get("program", DEFAULT_PROGRAM), f"{where}: program")
    if isinstance(out.get("set"), Mapping):
        out["set"] = {program.names.get(name, name): value for name, value in out["set"].items()}
    if isinstance(changes := out.get("changes"), list):
        out["changes"] = [_with_set(change, program) for change in changes]
    return out


def _with_set(change: Any, program: Program) -> Any:
    """A change with its aliases in ``set``."""
    if not isinstance(change, Mapping) or not isinstance(change.get("set", {}), Mapping):
        return change
    beside = [key for key in change if key in program.names and key not in program.parameters]
    rest = {key: value for key, value in change.items() if key not in beside}
    return {**rest, "set": {**change.get("set", {}), **{program.names[key]: change[key] for key in beside}}}
