"""Plan of a campaign: its file, with all the files that it names read in.

A *cell* is one combination of rig, device and values of the grid. Each cell has the same number of trials, with the
same seeds, so that cells and campaigns can be compared seed by seed. A *part* is some consecutive trials of one cell.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from analogrig import config
from analogrig.campaigns import builds
from analogrig.campaigns.spec import MAX_CELLS, MAX_TRIALS, CampaignSpec, corners
from analogrig.campaigns.trials import MOST_ERRORS
from analogrig.datasheet import Datasheet
from analogrig.devices.device import DeviceDescription
from analogrig.devices.library import LIBRARY
from analogrig.devices.registry import from_table, trusted
from analogrig.errors import ConfigurationError
from analogrig.plant import Plant
from analogrig.rigs.description import from_table as rig_of
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import SetUp, is_emulated
from analogrig.rigs.rig import Rig, RigDescription
from analogrig.scenario import PotChange, Scenario
from analogrig.trust import Trust
from analogrig.wording import number_of

_DRAWS = 20_000
"""Random stream of the campaign's own draws, separate from the rig's streams of the same seed."""

SHOWN, LONGEST = 3, 60
"""Number of differences named in one line, and characters shown of each value."""

_NEAR_STOP = 0.005
"""Part of a track at its ends that not every draw of parts reaches."""

_ABSENT = object()

NOISE = "noise_lsb"
"""Axis of the rms noise of the card."""


@dataclass(frozen=True)
class Cell:
    """Combination of rig, device and grid values."""

    rig: int
    """Index of the rig in ``Plan.rigs``."""
    device: int
    values: Mapping[str, float]
    """Values of the grid's axes, by axis name."""


@dataclass(frozen=True)
class Case:
    """One trial, ready to be played."""

    rig: Mapping[str, Any]
    device: Mapping[str, Any]
    scenario: Scenario
    seed: int


class Part(NamedTuple):
    """Consecutive trials of one cell."""

    cell: int
    first: int
    """Place of the first one in the cell, from 0 on."""
    trials: int
    """Number of trials."""

    def __str__(self) -> str:
        return f"cell {self.cell}, trials {self.first} to {self.first + self.trials - 1}"


@dataclass(frozen=True)
class Plan:
    """Campaign with the contents of all files that it names, as plain values that any worker can read."""

    spec: CampaignSpec
    scenario: Mapping[str, Any]
    rigs: tuple[Mapping[str, Any], ...]
    devices: tuple[Mapping[str, Any], ...]
    """Devices as plain values, each with its ``build``."""
    analogrig: str
    """The build of analogrig itself."""

    def __post_init__(self) -> None:
        for name, tables in (("rigs", self.rigs), ("devices", self.devices)):
            if not tables or not all(isinstance(table.get("name"), str) for table in tables):
                raise ValueError(f"{name} must be at least one, each with its name")

    @property
    def size(self) -> int:
        """Number of cells."""
        combinations = math.prod(len(values) for values in self.spec.grid.values())
        return len(self.rigs) * len(self.devices) * combinations

    @classmethod
    def of(cls, spec: CampaignSpec, allow: Trust | Iterable[str] = ()) -> Plan:
        """Plan of a campaign. Its rigs and devices are checked here, so that workers need not check them.

        :param allow: things that a file may name (``analogrig.trust``).
        :raises ConfigurationError: a rig, device or scenario is absent or wrong, or a cell cannot be played; or a file
            names what is not allowed.
        """
        scenario = Scenario.load(spec.scenario)
        if spec.samples is not None:
            scenario = dataclasses.replace(scenario, samples=spec.samples)
        plan = cls(
            spec=spec,
            scenario=scenario.as_table(),
            rigs=tuple(rig_table(name, allow) for name in spec.rigs),
            devices=tuple(device_table(name, allow) for name in spec.devices),
            analogrig=builds.of_analogrig(),
        )
        plan._check()
        return plan

    @classmethod
    def from_json(cls, text: str) -> Plan:
        """Plan from JSON.

        :raises ConfigurationError, ValueError: it is not a plan.
        """
        return config.build(cls, json.loads(text), "the plan of the campaign")

    def as_table(self) -> dict[str, Any]:
        """Plan as plain values: everything that decides the results, and nothing else."""
        table = dataclasses.asdict(self)
        table["spec"] = config.plain(table["spec"])
        return table

    def as_json(self) -> str:
        """Plan as JSON text; equal plans give equal text."""
        return json.dumps(self.as_table(), sort_keys=True, separators=(",", ":"))

    def check_same(self, other: Plan, where: str) -> None:
        """:raises ConfigurationError: the other plan differs; names what differs."""
        there, here = (json.loads(plan.as_json()) for plan in (other, self))
        if differences := list_differences(there, here, ("there", "here")):
            raise ConfigurationError(f"{where} ({differences}): choose another --out, or remove it")

    def cells(self) -> list[Cell]:
        """Cells in the order of the results: rigs, devices, then the axes by name, the last one fastest."""
        axes = self.spec.grid
        combinations = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
        return [
            Cell(rig, device, values)
            for rig, device, values in itertools.product(range(len(self.rigs)), range(len(self.devices)), combinations)
        ]

    def seeds(self, part: Part) -> range:
        first = self.spec.first_seed + part.first
        return range(first, first + part.trials)

    def draw(self, seed: int) -> dict[str, float]:
        """Drawn values of a trial, by axis name."""
        if not self.spec.draw:
            return {}
        rng = np.random.default_rng([seed, _DRAWS])
        return {axis: float(rng.uniform(low, high)) for axis, (low, high) in self.spec.draw.items()}

    def case(self, cell: Cell, seed: int, drawn: Mapping[str, float] | None = None) -> Case:
        """:raises ConfigurationError: the values make no scenario."""
        values = {**cell.values, **(self.draw(seed) if drawn is None else drawn)}
        try:
            scenario = self._scenario(values)
        except ValueError as error:
            raise ConfigurationError(f"{_text(values)}: {error}" if values else str(error)) from error
        rig = dict(self.rigs[cell.rig])
        if NOISE in values:
            rig["card"] = {**rig["card"], NOISE: values[NOISE]}
        return Case(rig, self.devices[cell.device], scenario, seed)

    @property
    def samples(self) -> int:
        """Number of samples of each trial."""
        return self._base.samples

    @property
    def most_alarms(self) -> list[int]:
        """Largest number of alarms of a trial, by cell, from the data sheets of the devices."""
        tables = (table if "estimator" in table else {"datasheet": {}, **table} for table in self.devices)
        by_device = [Datasheet.recorded(table).most_alarms(self.samples) for table in tables]
        return [by_device[cell.device] for cell in self.cells()]

    @functools.cached_property
    def _base(self) -> Scenario:
        """Scenario before the values of a cell are set."""
        return Scenario.from_table(self.scenario, "the campaign's scenario")

    def axis(self, name: str) -> tuple[str, str]:
        """Name and unit of an axis in words."""
        if name == NOISE:
            return "noise", "LSB rms"
        program = self._base.program
        unit = program.unit(self._starts[name]) if name in self._starts else ""
        spelled = unit.lower().replace("/", " per ").replace(" ", "_")  # of names such as damping_n_s_per_m
        return name.removesuffix(f"_{spelled}").replace("_", " "), unit

    @property
    def estimates(self) -> tuple[str, ...]:
        """Parameters whose estimates the results keep."""
        return self._base.program.estimates[:MOST_ERRORS]

    @property
    def _starts(self) -> Mapping[str, str]:
        """Parameters by the axes of their values at the start."""
        return self._base.program.names

    @functools.cached_property
    def _factors(self) -> Mapping[str, str]:
        """Parameters by the axes of their factors at the change."""
        rows = self._base.program.parameters.items()
        return {f"{each}_factor": name for name, row in rows for each in (name, row.diagnosis) if each}

    def _scenario(self, values: Mapping[str, float]) -> Scenario:
        """Scenario with these values of the axes."""
        base, starts, factors = self._base, self._starts, self._factors
        start = {**base.set, **{starts[axis]: value for axis, value in values.items() if axis in starts}}
        before = Plant.of(base.program, start).parameters()
        changed = {factors[axis]: value * before[factors[axis]] for axis, value in values.items() if axis in factors}
        changes = (*base.changes, PotChange(self.spec.change_at, changed)) if changed else base.changes
        expect = base.expect
        if self.spec.false_alarms is not None:
            expect = dataclasses.replace(expect, false_alarms=self.spec.false_alarms)
        return dataclasses.replace(base, set=start, changes=changes, expect=expect)

    def _check(self) -> None:
        spec = self.spec
        where = f"campaign {spec.name}"
        if self.size > MAX_CELLS or self.size * spec.trials > MAX_TRIALS:
            raise ConfigurationError(
                f"{where}: {number_of(self.size, 'cell')} of {number_of(spec.trials, 'trial')};"
                f" at most {MAX_CELLS} cells and {MAX_TRIALS} trials in all"
            )
        axes = {*spec.grid, *spec.draw}
        known = [NOISE, *self._starts, *self._factors]
        for axis in axes:
            if axis not in known:
                named = ", ".join((NOISE, *self._base.program.parameters))
                raise ConfigurationError(
                    f"{where}: unknown axis {axis[:40]!r}{config.suggest(axis, known)} (known: {named}, and each"
                    " parameter with _factor)"
                )
        if axes & set(self._factors) and self.scenario.get("changes"):
            raise ConfigurationError(
                f"{where}: the scenario {spec.scenario} has changes of its own: no factors besides"
            )
        if NOISE in axes and any("card" not in table for table in self.rigs):
            raise ConfigurationError(f"{where}: noise_lsb is for emulated rigs")
        for cell in self.cells():
            self._check_cell(cell, where)

    def _check_cell(self, cell: Cell, where: str) -> None:
        """:raises ConfigurationError: a trial of the cell cannot be set up."""
        first, ends = self.draw(self.spec.first_seed), corners(self.spec.draw)
        for drawn, opposite in (*itertools.permutations(ends, 2), (first, {})):
            if problem := self._problem(cell, drawn):
                raise ConfigurationError(f"{where}: {self._blame(cell, drawn, opposite)}{problem}")
        if any(self._nears_stop(cell, drawn) for drawn in (*ends, first)):
            for seed in range(self.spec.first_seed, self.spec.first_seed + self.spec.trials):
                if problem := self._problem(cell, self.draw(seed), seed):
                    raise ConfigurationError(f"{where}: trial of seed {seed}: {problem}")

    def _set_up(self, cell: Cell, drawn: Mapping[str, float], seed: int | None = None) -> SetUp | None:
        """Machine of a trial on an emulated rig, by default of the first seed; None on another rig.

        :raises ConfigurationError: it cannot be set up.
        """
        case = self.case(cell, self.spec.first_seed if seed is None else seed, drawn)
        if "card" in case.rig and is_emulated(rig := open_table(case.rig)):
            return rig.set_up(case.scenario, case.seed)
        return None

    def _problem(self, cell: Cell, drawn: Mapping[str, float], seed: int | None = None) -> str:
        """Reason why such a trial cannot be set up on an emulated rig; empty if it can."""
        try:
            self._set_up(cell, drawn, seed)
        except ConfigurationError as error:
            return str(error)
        return ""

    def _nears_stop(self, cell: Cell, drawn: Mapping[str, float]) -> bool:
        """True if a pot of a trial comes near an end of its track, where only some draws of parts reach."""
        if (machine := self._set_up(cell, drawn)) is None:
            return False
        turns = [machine.computer.dials_for(**turn.values) for turn in machine.changes]
        dials = [dial for each in (machine.computer.dials, *turns) for dial in each.values()]
        return not all(_NEAR_STOP < dial < 1.0 - _NEAR_STOP for dial in dials)

    def _blame(self, cell: Cell, corner: dict[str, float], opposite: dict[str, float]) -> str:
        """Error prefix with the drawn value at fault.

        It names the one value that is wrong by itself, or all values if none is. It is empty if the opposite corner
        fails as well.
        """
        if not opposite or self._problem(cell, opposite):
            return ""
        alone = ({axis: value} for axis, value in corner.items())
        return f"draw: {_text(next((each for each in alone if self._problem(cell, opposite | each)), corner))}: "


def open_table(table: Mapping[str, Any]) -> Rig:
    """Rig described by a plan's table.

    :raises ConfigurationError: it is wrong.
    """
    return _described(table).open()


def _described(table: Mapping[str, Any]) -> RigDescription:
    """:raises ConfigurationError: the table of a plan describes no rig."""
    return rig_of(table.get("described", table), f"rig {table['name']}")


def device_table(name: str, allow: Trust | Iterable[str] = ()) -> Mapping[str, Any]:
    """Device ``name`` as plain values that ``device_of`` takes, with its ``build``.

    :raises ConfigurationError: there is none, or it is wrong, or what it runs cannot be read or is not allowed.
    """
    device = trusted(name, Trust.of(allow))
    return {**device.as_table(), "build": builds.of_device(device)}


def device_of(table: Mapping[str, Any]) -> DeviceDescription:
    """Device of such a table, after a check of its build if the table names one.

    :raises ConfigurationError: it is another build by now.
    """
    described = {key: value for key, value in table.items() if key != "build"}
    device = from_table(described, f"device {table['name']}")
    if "build" in table:
        if (file := builds.supplied(device, table["build"])) is not None:
            for key, value in described.items():
                if isinstance(value, str) and value and Path(value).absolute() == device.program:
                    described[key] = str(file)
            device = from_table(described, f"device {table['name']}")
        builds.check_device(device, table["build"])
    return device


def device_files(devices: Iterable[Mapping[str, Any]]) -> dict[str, bytes]:
    """Contents of the files that devices run, by their hash, without those that analogrig brings."""
    found = {}
    for table in devices:
        program = device_of(table).program
        if program is not None and not program.is_relative_to(LIBRARY.parent):
            found[str(table["build"])] = program.read_bytes()
    return found


def one_worker_only(rigs: Iterable[Mapping[str, Any]], devices: Iterable[Mapping[str, Any]]) -> str:
    """Name of the first rig or device that only one worker can use at a time; "" if there is none."""
    single_rigs = (str(table["name"]) if _described(table).only_one else "" for table in rigs)
    return next(filter(None, (*single_rigs, *(device_of(table).only_one for table in devices))), "")


def rig_table(name: str, allow: Trust | Iterable[str] = ()) -> Mapping[str, Any]:
    """Rig ``name`` as plain values that ``open_table`` takes.

    :raises ConfigurationError: there is none, or it can play but one scenario, or it names what is not allowed.
    """
    with open_rig(name, allow=allow) as rig:
        if rig.recorded is not None:
            raise ConfigurationError(
                f"{name}: a recording plays one scenario with one seed: analogrig replay is for it"
            )
        described = config.plain(rig.description())
        return described if is_emulated(rig) else {"name": name, "kind": described["kind"], "described": described}


def _text(values: Mapping[str, float]) -> str:
    return ", ".join(f"{axis} = {value:g}" for axis, value in values.items())


def list_differences(a: Any, b: Any, sides: tuple[str, str]) -> str:
    """First few values that differ between two tables of plain values, as part of a line; empty if they are equal.

    :param sides: words for the places of ``a`` and ``b``.
    """
    found = list(_differences(a, b))
    more = f", and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return ", ".join(f"{name} is {a} {sides[0]} and {b} {sides[1]}" for name, a, b in found[:SHOWN]) + more


def _differences(a: Any, b: Any, name: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield each value that differs: its dotted name and both values."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for key in sorted(a.keys() | b.keys()):
            yield from _differences(a.get(key, _ABSENT), b.get(key, _ABSENT), f"{name}.{key}" if name else key)
    elif isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        for i, (mine, other) in enumerate(zip(a, b, strict=True)):
            yield from _differences(mine, other, f"{name}[{i}]")
    elif a != b:
        yield name, _value_text(a), _value_text(b)


def _value_text(value: Any) -> str:
    text = "absent" if value is _ABSENT else repr(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
