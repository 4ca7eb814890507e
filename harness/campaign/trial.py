"""What a worker does: play the trials of one chunk, and say of each what came of it."""

from __future__ import annotations

import contextlib
import functools
import json
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from harness.bench import INTERRUPTED_BY_USER, Bench
from harness.campaign.spec import Case, Chunk, Plan, device_of, open_table
from harness.dut import Dut, connect
from harness.errors import AnalogrigError
from harness.rigs.emulator import EmulatorRig
from harness.rigs.rig import Rig
from harness.run import Run
from harness.trials import Trials, are_possible
from harness.verdict import TweakVerdict, Verdict, judge

Row = dict[str, Any]
"""Of one trial, in plain values; see ``row``."""


def play_chunk(plan: str, chunk: tuple[int, int]) -> list[Row]:
    """The rows of a chunk of the plan (``Plan.as_json``): the same in every process on every machine.

    :raises ConfigurationError: a case cannot be played; names cell and seed.
    :raises LinkError, DeviceError, RigError: a device or a rig cannot be had.
    """
    planned, cells = _plan(plan)
    numbered = Chunk(chunk)
    rows = []
    for seed in planned.seeds(numbered):
        case = planned.case(cells[numbered.cell], seed)
        try:
            run = _players.player(case).play(case)
        except AnalogrigError as error:
            raise type(error)(f"campaign {planned.spec.name}, cell {numbered.cell}, seed {seed}: {error}") from error
        rows.append(row(run, judge(run), case.drawn))
    return rows


def _change(tweak: TweakVerdict) -> list[int | None]:
    """At its likeliest instant; one that was not found in the samples is as one that nobody could see."""
    if tweak.unseen:
        return [None, None, False, False]
    return [tweak.latency_n, tweak.bound_n, tweak.missed, tweak.late]


def row(run: Run, verdict: Verdict, drawn: Mapping[str, float] | None = None) -> Row:
    """What is kept of a trial.

    ``changes``: for each [latency or null, bound or null, missed, late], in samples. ``errors``: relative errors of M,
    B, K at the end, or null. ``theta``: the first digits of the hash of all estimates, which tells builds apart.
    """
    out: Row = {
        "seed": run.conditions.seed,
        "outcome": verdict.outcome,
        "samples": run.samples,
        "false_alarms": len(verdict.false_alarms),
        "changes": [_change(tweak) for tweak in verdict.tweaks],
        "errors": list(verdict.estimates[-1].error.values()) if verdict.estimates else [],
        "theta": verdict.theta_hash[:16],
    }
    if drawn:
        out["drawn"] = dict(drawn)
    if verdict.reasons:
        out["why"] = verdict.reasons[0]
    return out


@dataclass(frozen=True)
class Count:
    """The alarms of a trial in which nothing changes."""

    alarms: int
    updated: int
    """Samples that the estimator took in."""
    fault: str = ""
    """Why the trial is not valid."""


def count_alarms(case: Case) -> Count:
    """As fast as it goes; errors as ``play_chunk``."""
    return _players.player(case).count(case)


class _InProcess:
    """Plays by trials without a line."""

    def __init__(self, rig: EmulatorRig, case: Case) -> None:
        self._trials = Trials(rig, device_of(case.device))

    def play(self, case: Case) -> Run:
        return self._trials.run(case.scenario, case.seed)

    def count(self, case: Case) -> Count:
        alarms = self._trials.alarms(case.scenario, case.seed)
        return Count(len(alarms), self._trials.counters["updated"])

    def close(self) -> None:
        """Nothing is held."""


class _OnBench:
    """Plays on a bench. After a run that was not valid the device is reached anew: what hung must not hang the next."""

    def __init__(self, rig: Rig, case: Case) -> None:
        self._rig = rig
        self._device = device_of(case.device)
        self._dut: Dut | None = None

    def play(self, case: Case) -> Run:
        if self._dut is None:
            self._dut = connect(self._device)
        try:
            run = Bench(self._rig, self._dut).play(case.scenario, case.seed)
        except BaseException:
            self.close()
            raise
        if run.conditions.faults:
            self.close()
        if INTERRUPTED_BY_USER in run.conditions.faults:
            raise KeyboardInterrupt
        return run

    def count(self, case: Case) -> Count:
        run = self.play(case)
        verdict = judge(run)
        fault = "" if verdict.valid else f"seed {case.seed}: {verdict.reasons[0]}"
        return Count(len(run.alarm_index), run.conditions.counters.get("updated", 0), fault)

    def close(self) -> None:
        dut, self._dut = self._dut, None
        if dut is not None:
            with contextlib.suppress(AnalogrigError):
                dut.close()


class _Players(threading.local):
    """The last rig and device of each thread: cells come in turn, so a few are kept."""

    MOST = 64

    def __init__(self) -> None:
        self._kept: dict[str, tuple[_InProcess | _OnBench, contextlib.ExitStack]] = {}

    def player(self, case: Case) -> _InProcess | _OnBench:
        key = json.dumps([case.rig, case.device], sort_keys=True)
        if key not in self._kept:
            while len(self._kept) >= self.MOST:
                self._kept.pop(next(iter(self._kept)))[1].close()
            with contextlib.ExitStack() as held:
                player = _player(held.enter_context(open_table(case.rig)), case)
                held.callback(player.close)
                self._kept[key] = player, held.pop_all()
        return self._kept[key][0]

    def close(self) -> None:
        while self._kept:
            self._kept.popitem()[1][1].close()


_players = _Players()


def close_devices() -> None:
    """Let go of the devices and rigs that this thread's chunks have opened."""
    _players.close()


def _player(rig: Rig, case: Case) -> _InProcess | _OnBench:
    if isinstance(rig, EmulatorRig) and are_possible(rig, device_of(case.device)):
        return _InProcess(rig, case)
    return _OnBench(rig, case)


@functools.lru_cache(maxsize=2)
def _plan(text: str) -> tuple[Plan, list[Any]]:
    plan = Plan.from_json(text)
    return plan, plan.cells()


def samples_of(rows: list[Row]) -> Mapping[str, int]:
    """Counts of valid trials: ``samples``, ``false_alarms``, ``visible`` changes, ``missed`` ones."""
    valid = [each for each in rows if each["outcome"] != "inconclusive"]
    changes = [change for each in valid for change in each["changes"] if change[1] is not None]
    return {
        "samples": sum(each["samples"] for each in valid),
        "false_alarms": sum(each["false_alarms"] for each in valid),
        "visible": len(changes),
        "missed": sum(change[2] for change in changes),
    }
