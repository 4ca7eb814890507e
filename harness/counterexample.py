"""What is left of a play that failed: a scenario file, the rig and the recording, and the one line that repeats it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness import config
from harness.run import Run

SCENARIO_FILE, RIG_FILE, RUN_FILE, REPORT_FILE = "scenario.toml", "rig.toml", "run.npz", "report.html"


def write(run: Run, folder: Path) -> str:
    """Into ``folder``, which is made; returns the command that repeats it.

    The scenario file names its seed and its rig, so that `analogrig run --scenario FILE` is enough on the emulator, and
    a folder of such files is a regression suite: `pytest --scenario-dir FOLDER`.

    :raises RecordingError: the recording cannot be written. OSError: the folder or a file cannot.
    """
    from harness.report import write_report
    from harness.verdict import judge

    folder.mkdir(parents=True, exist_ok=True)
    conditions = run.conditions
    scenario: dict[str, Any] = {**conditions.scenario, "seed": conditions.seed}
    shipped = _shipped_rig(conditions.rig)
    if shipped is None and conditions.rig.get("kind") == "emulator":
        rig = {key: value for key, value in conditions.rig.items() if key != "name"}
        (folder / RIG_FILE).write_text(config.to_toml(rig), encoding="utf-8")
        scenario["rig"] = RIG_FILE
    elif shipped is not None:
        scenario["rig"] = shipped
    scenario.pop("name", None)
    (folder / SCENARIO_FILE).write_text(config.to_toml(scenario), encoding="utf-8")
    run.save(folder / RUN_FILE)
    write_report(run, judge(run), folder / REPORT_FILE)
    return command_of(run, str(folder / SCENARIO_FILE))


def command_of(run: Run, scenario: str | None = None) -> str:
    """The command that plays a run again; ``scenario``: a file that names seed and rig."""
    conditions = run.conditions
    words = ["analogrig", "run", "--scenario", scenario or str(conditions.scenario["name"])]
    if scenario is None:
        words += ["--rig", str(conditions.rig["name"]), "--seed", str(conditions.seed)]
    return shlex.join([*words, "--dut", str(conditions.dut["name"])])


def _shipped_rig(rig: Mapping[str, Any]) -> str | None:
    """Its name, if the shipped description of that name is the same."""
    from harness.errors import AnalogrigError
    from harness.rig import open_rig

    name = str(rig.get("name", ""))
    if name not in config.names("rigs"):
        return None
    try:
        with open_rig(name) as opened:
            return name if dict(opened.description()) == dict(rig) else None
    except AnalogrigError:
        return None
