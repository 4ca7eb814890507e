"""What is left of a play that failed: files of scenario, rig and device, the recording, and the one line that repeats
it."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from harness import config
from harness.run import Run

SCENARIO_FILE, RIG_FILE, DEVICE_FILE = "scenario.toml", "rig.toml", "dut.toml"
RUN_FILE, REPORT_FILE = "run.npz", "report.html"


def write(run: Run, folder: Path) -> str:
    """Into ``folder``, which is made; returns the command that repeats it.

    The scenario file names its seed and its rig, so that `analogrig run --scenario FILE` is enough on the emulator, and
    a folder of such files is a regression suite: `pytest --scenario-dir FOLDER`. A device that its name alone does not
    describe has a file too.

    :raises RecordingError: the recording cannot be written. OSError: the folder or a file cannot.
    """
    from harness.report import write_report
    from harness.verdict import judge

    folder.mkdir(parents=True, exist_ok=True)
    conditions = run.conditions
    scenario: dict[str, Any] = {**conditions.scenario, "seed": conditions.seed}
    name = str(conditions.rig["name"])
    shipped = name if name in config.names("rigs") and _is_rig(name, run) else None
    if shipped is None and conditions.rig.get("kind") in ("emulator", "real"):
        rig = {key: value for key, value in conditions.rig.items() if key != "name"}
        (folder / RIG_FILE).write_text(config.to_toml(rig), encoding="utf-8")
        scenario["rig"] = RIG_FILE
    elif shipped is not None:
        scenario["rig"] = shipped
    scenario.pop("name", None)
    (folder / SCENARIO_FILE).write_text(config.to_toml(scenario), encoding="utf-8")
    run.save(folder / RUN_FILE)
    write_report(run, judge(run), folder / REPORT_FILE)
    device = str(conditions.dut["name"])
    if not _is_device(device, run):
        table = {key: value for key, value in conditions.dut.items() if key not in {"name", "identity"}}
        (folder / DEVICE_FILE).write_text(config.to_toml(table), encoding="utf-8")
        device = str(folder / DEVICE_FILE)
    return shlex.join(["analogrig", "run", "--scenario", str(folder / SCENARIO_FILE), "--dut", device])


def command_of(run: Run, scenario: str = "", rig: str = "", dut: str = "") -> str:
    """The command that plays a run again, if names or files say what was played; else "", and it takes ``write``.

    ``scenario``, ``rig``, ``dut``: how the user named them, if that is known: a file is recorded without its folder.
    """
    words = ["analogrig", "run", "--seed", str(run.conditions.seed)]
    for flag, given, recorded, is_it in (
        ("--scenario", scenario, run.conditions.scenario, _is_scenario),
        ("--rig", rig, run.conditions.rig, _is_rig),
        ("--dut", dut, run.conditions.dut, _is_device),
    ):
        name = next((name for name in (given, str(recorded["name"])) if name and is_it(name, run)), None)
        if name is None:
            return ""
        words += [flag, name]
    return shlex.join(words)


def _is_scenario(name: str, run: Run) -> bool:
    """Whether that is what was played; so the others."""
    from harness.errors import AnalogrigError
    from harness.scenario import Scenario

    try:
        return dict(Scenario.load(name).as_table()) == dict(run.conditions.scenario)
    except AnalogrigError:
        return False


def _is_rig(name: str, run: Run) -> bool:
    from harness.errors import AnalogrigError
    from harness.rigs.description import open_rig

    try:
        with open_rig(name) as opened:
            return dict(opened.description()) == dict(run.conditions.rig)
    except AnalogrigError:
        return False


def _is_device(name: str, run: Run) -> bool:
    from harness.devices import describe
    from harness.errors import AnalogrigError

    try:
        described = describe(name).as_table()
    except AnalogrigError:
        return False
    return described == {key: value for key, value in run.conditions.dut.items() if key != "identity"}
