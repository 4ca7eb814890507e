"""Sides of a comparison: their trials, and a check that both played the same."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analogrig.campaigns.difference import differences, named
from analogrig.campaigns.plan import Plan
from analogrig.campaigns.results import Results
from analogrig.campaigns.rows import Row, is_valid, row
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.judging.verdict import judge
from analogrig.run import Run

Observation = tuple[tuple[object, ...], Row]
"""Key of a trial, seed included, and its row."""


@dataclass(frozen=True)
class Side:
    """One side of a comparison."""

    trials: tuple[Observation, ...]
    """Trials, valid or not."""
    plan: Plan | None = None
    """Plan of the campaign; None: the trials come from recordings."""


def load(path: Path) -> Side:
    """Trials of a results file, of a recording, or of all recordings below a folder.

    :raises RecordingError: it cannot be read, or there is nothing valid in it.
    :raises ConfigurationError: two recordings are of one play; names them.
    """
    if path.is_dir() or path.suffix == ".npz":
        side = Side(_recordings(sorted(path.rglob("*.npz")) if path.is_dir() else [path]))
    else:
        results = Results.load(path)
        cells = zip(results.plan.cells(), results.rows, strict=True)
        rows = ((cell, each) for cell, its_rows in cells for each in its_rows)
        side = Side(
            tuple(((cell.rig, cell.device, *cell.values.items(), each["seed"]), each) for cell, each in rows),
            results.plan,
        )
    if not valid(side.trials):
        raise RecordingError(f"{path}: holds no valid trial")
    return side


def matched(a: Side, b: Side) -> tuple[Sequence[Observation], Sequence[Observation]]:
    """Trials of both sides that played the same; the devices may differ.

    :raises ConfigurationError: they are of different campaigns, or played nothing in common; names what differs.
    """
    if a.plan is not None and b.plan is not None:
        _check_same("A and B are different campaigns", _played(a.plan), _played(b.plan))
        return a.trials, _in_order(b, _names(a.plan), _names(b.plan))
    if a.plan is not None or b.plan is not None:
        raise ConfigurationError("A and B cannot be compared: one is a campaign, the other are recordings")
    common = {key[:-1] for key, _ in a.trials} & {key[:-1] for key, _ in b.trials}
    if not common:
        _check_same("A and B played nothing in common", *(_recorded_play(side.trials[0]) for side in (a, b)))
    ours, theirs = ([each for each in side.trials if each[0][:-1] in common] for side in (a, b))
    return ours, theirs


def _check_same(otherwise: str, ours: Any, theirs: Any) -> None:
    found = list(differences(ours, theirs))
    if found:
        raise ConfigurationError(f"{otherwise}: {named(found, ('in A', 'in B'))}")


def _names(plan: Plan) -> list[str]:
    """Names of the devices."""
    return [str(device["name"]) for device in plan.devices]


def _in_order(side: Side, wanted: Sequence[str], names: Sequence[str]) -> Sequence[Observation]:
    """Trials with the devices numbered as on the other side, if their names match; else numbered by position."""
    if set(wanted) != set(names):
        return side.trials
    return [((key[0], wanted.index(names[int(str(key[1]))]), *key[2:]), each) for key, each in side.trials]


def _recorded_play(trial: Observation) -> dict[str, Any]:
    (scenario, rig, _), _ = trial
    return {"scenario": json.loads(str(scenario)), "rig": json.loads(str(rig))}


def _played(plan: Plan) -> dict[str, Any]:
    """Settings that decide what a campaign played, without its devices and names."""
    table = plan.as_table()
    spec = {key: value for key, value in table["spec"].items() if key not in _NAMES}
    if "stop" not in spec:
        del spec["chunk"]  # says who plays what, and then no more
    return {
        **spec,
        "devices": len(plan.devices),
        "scenario": _unnamed(table["scenario"]),
        "rigs": [_unnamed(rig) for rig in table["rigs"]],
    }


_NAMES = frozenset({"name", "description", "scenario", "rigs", "devices", "samples"})
"""Keys of a campaign's file that are irrelevant, or whose contents are in the plan."""


def _unnamed(table: Mapping[str, Any]) -> dict[str, Any]:
    """Table without its name and description, unless it has nothing else."""
    rest = {key: value for key, value in table.items() if key not in {"name", "description"}}
    return rest or dict(table)


def valid(trials: Sequence[Observation]) -> dict[tuple[object, ...], Row]:
    """Rows of the valid trials, by key."""
    return {key: each for key, each in trials if is_valid(each)}


def _recordings(paths: Sequence[Path]) -> tuple[Observation, ...]:
    found: dict[tuple[object, ...], tuple[Path, Row]] = {}
    for path in paths:
        key, trial = _recorded(path)
        if key in found:
            raise ConfigurationError(f"{found[key][0]} and {path} are of one scenario, rig and seed: which is meant?")
        found[key] = path, trial
    return tuple((key, trial) for key, (_, trial) in found.items())


def _recorded(path: Path) -> Observation:
    run = Run.load(path)
    of = run.conditions
    played = json.dumps(dict(of.scenario), sort_keys=True)  # many may have one name: what strategies draw
    machine = json.dumps(_unnamed(of.rig), sort_keys=True)
    return (played, machine, of.seed), row(run, judge(run))
