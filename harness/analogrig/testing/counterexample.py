"""Counterexamples: files that repeat a failed play.

A counterexample holds the scenario, rig and device, the recording, and the command that repeats the play.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import shutil
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from analogrig import config
from analogrig.devices.registry import describe, recorded
from analogrig.errors import AnalogrigError
from analogrig.rigs import description as rigs
from analogrig.rigs.recording import RECORDING
from analogrig.run import Run
from analogrig.scenario import Scenario, Statement
from analogrig.trust import Thing

SCENARIO_FILE, RIG_FILE, DEVICE_FILE = "scenario.toml", "rig.toml", "dut.toml"
RUN_FILE, REPORT_FILE = "run.npz", "report.html"


@dataclasses.dataclass(frozen=True)
class Counterexample:
    """A play for which a statement does not hold."""

    run: Run
    statement: Statement | None = None
    """Statement that failed; None if no file can express it: then the scenario's ``[expect]`` counts."""
    seed: int | None = None
    """First seed of the statement; None: the seed of the run."""
    dut: str = ""
    """Device name as the user gave it; empty if unknown."""
    why: str = ""
    """Reason why the statement does not hold."""

    def command(self, scenario: Path) -> str:
        """Command that plays the run again from its scenario file, and from its device file if the device has no
        name. A device that only the process of the tests reaches needs pytest."""
        if self.is_private:
            return self._pytest(scenario, scenario.parent)
        words = ["analogrig", "run", "--scenario", str(scenario)]
        if self.seed not in (None, self.run.conditions.seed):
            words += ["--seed", str(self.run.conditions.seed)]
        device = self._device()
        words += ["--dut", device or str(scenario.with_name(DEVICE_FILE))]
        return shlex.join([*words, *self._options("--allow", with_device=not device)])

    def suite_command(self, folder: Path) -> str:
        """Command that judges the play again as a test, and allows the things that the files name."""
        return self._pytest(folder, folder)

    @property
    def is_private(self) -> bool:
        """True if no other process reaches the device."""
        return recorded(self.run.conditions.dut).is_private

    def _pytest(self, what: Path, folder: Path) -> str:
        options = self._options("--hil-allow", with_device=True)
        return shlex.join(["pytest", str(what), "--hil-scenario-dir", str(folder), *options])

    def _options(self, allow: str, *, with_device: bool) -> list[str]:
        """Options that allow the things which the files of the counterexample name."""
        things: list[Thing] = list(recorded(self.run.conditions.dut).things) if with_device else []
        table = self.run.conditions.rig
        if table.get("kind") in rigs.KINDS and not str(table["name"]).startswith(RECORDING):
            plain = tomllib.loads(config.to_toml(table))  # as a file has it: lists for tuples, and nothing that is None
            things += rigs.from_table(plain, "the recorded rig").things
        return [word for thing in things for word in (allow, thing.display_name())]

    def write(self, folder: Path, *, page: bool = True) -> None:
        """Write the counterexample into ``folder``, all or nothing: the old content stays until the new one is
        complete.

        The scenario file names its seed, its rig, its device and what did not hold, so that a folder of such files is a
        regression suite: `pytest --hil-scenario-dir FOLDER`. A rig or a device that its name alone does not describe
        has a file too.

        :param page: with the report, which takes longer than all the rest.
        :raises RecordingError: the recording cannot be written. OSError: the folder or a file cannot.
        """
        new, old = (folder.with_name(f".{folder.name}.{each}") for each in ("new", "old"))
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir(parents=True)
        try:
            for name, table in self._tables().items():
                (new / name).write_text(config.to_toml(table), encoding="utf-8")
            self.run.save(new / RUN_FILE)
            if page:
                from analogrig.judging.verdict import judge
                from analogrig.reporting import write_report

                write_report(self.run, judge(self.run), new / REPORT_FILE)
            if folder.exists():  # a process that is killed here leaves it under the name ``old``
                shutil.rmtree(old, ignore_errors=True)
                folder.rename(old)
            new.rename(folder)
            shutil.rmtree(old, ignore_errors=True)
        finally:
            shutil.rmtree(new, ignore_errors=True)

    def _tables(self) -> dict[str, dict[str, Any]]:
        """Tables to write, by file name."""
        conditions, device = self.run.conditions, self._device()
        scenario = {key: value for key, value in conditions.scenario.items() if key not in ("name", "rig", "statement")}
        scenario["seed"] = conditions.seed if self.seed is None else self.seed
        place = device.partition(":")[2].partition("?")[0]
        needs_file = not device or (
            any(thing.is_path for thing in describe(device).things) and not Path(place).is_absolute()
        )
        scenario["dut"] = DEVICE_FILE if needs_file else device
        tables = {SCENARIO_FILE: scenario}
        if needs_file:
            tables[DEVICE_FILE] = {key: value for key, value in _settings(conditions.dut).items() if key != "name"}
        name = conditions.source.name
        if name.startswith(RECORDING):
            scenario["rig"] = f"{RECORDING}{RUN_FILE}"
        elif name in config.names("rigs") and _is_rig(name, self.run):
            scenario["rig"] = name
        elif conditions.source.kind in rigs.KINDS:
            scenario["rig"] = RIG_FILE
            tables[RIG_FILE] = {key: value for key, value in conditions.rig.items() if key != "name"}
        if self.statement is not None:
            scenario["statement"] = dataclasses.asdict(self.statement)
        return tables

    def _device(self) -> str:
        """Name that describes the device; empty if the device needs a file."""
        names = (str(self.dut), self.run.conditions.device.name)  # as the command line would read them
        return next((each for each in names if each and not each.endswith(".toml") and _is_device(each, self.run)), "")


def command_of(run: Run, scenario: str = "", rig: str = "", dut: str = "") -> str:
    """Command that plays a run again, if names or files describe what was played; else "": the run needs files.

    ``scenario``, ``rig``, ``dut``: how the user named them, if that is known: a file is recorded without its folder.
    """
    words = ["analogrig", "run", "--seed", str(run.conditions.seed)]
    for flag, given, table, is_it in (
        ("--scenario", scenario, run.conditions.scenario, _is_scenario),
        ("--rig", rig, run.conditions.rig, _is_rig),
        ("--dut", dut, run.conditions.dut, _is_device),
    ):
        name = next((name for name in (given, str(table["name"])) if name and is_it(name, run)), None)
        if name is None and flag == "--scenario" and run.conditions.source.name.startswith(RECORDING):
            continue  # a recording plays its own
        if name is None:
            return ""
        words += [flag, name]
    return shlex.join(words)


def _is_scenario(name: str, run: Run) -> bool:
    """True if the named scenario is the one that the run played."""
    with contextlib.suppress(AnalogrigError):
        return dict(Scenario.load(name).as_table()) == dict(run.conditions.scenario)
    return False


def _is_rig(name: str, run: Run) -> bool:
    with contextlib.suppress(AnalogrigError):
        return dict(rigs.describe(name).as_table()) == dict(run.conditions.rig)
    return False


def _is_device(name: str, run: Run) -> bool:
    with contextlib.suppress(AnalogrigError):
        described, played = _settings(describe(name).as_table()), _settings(run.conditions.dut)
        return {**described, "datasheet": {}} == {**played, "datasheet": {}}  # the device itself completes it
    return False


def _settings(dut: Mapping[str, Any]) -> dict[str, Any]:
    """Device settings without its identity, and without the zero of the input: the bench sets that by the rig's
    card."""
    table = {key: value for key, value in dut.items() if key != "identity"}
    if "estimator" in table:
        table["estimator"] = {key: value for key, value in dut["estimator"].items() if key != "force_zero"}
    return table
