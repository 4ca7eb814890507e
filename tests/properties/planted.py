"""Defects planted in the C of the device, one at a time.

`make defects` plants each of defects.toml, runs the property that is to find it until the failure is shrunk to the
simplest scenario, and writes the table of README.md. test_planted_defects.py does it without shrinking.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
SOURCES = ROOT / "estimator_c"
GENERATED = ROOT / "build" / "generated"
README = Path(__file__).with_name("README.md")
TABLE = "| defect | property | simplest scenario that shows it | what it shows |\n|---|---|---|---|\n"

FOLDERS = ("core", "isolation", "fit", "device", "ports/loop", "ports/library")
FLAGS = ("-O1", "-w", "-shared", "-fPIC", "-std=c99", "-ffp-contract=off", "-DEST_NC_MAX=2U", "-DNDEBUG")

FOUND_ONLY = "tests.properties.found_only"
"""A plugin of pytest under which a property that fails is not shrunk."""


@dataclass(frozen=True)
class Defect:
    """One piece of text of the C, altered."""

    name: str
    file: str
    """Below estimator_c."""
    before: str
    after: str
    property: str
    """The test of analogrig.testing.properties that finds it."""


@dataclass(frozen=True)
class Found:
    """Result of pytest on a device with a defect."""

    failed: bool
    output: str
    runs: Path
    """The folder of the counterexample."""

    @property
    def why(self) -> str:
        """Finding of the property, as the plugin reports it; empty without one."""
        found = re.findall(r"^found: (.*)$", self.output, re.MULTILINE)
        return re.sub(r"device \S+: ", "", found[0])[:110] if found else ""


def defects() -> list[Defect]:
    with Path(__file__).with_name("defects.toml").open("rb") as file:
        return [Defect(**table) for table in tomllib.load(file)["defect"]]


def planted(defect: Defect | None, folder: Path) -> Path:
    """The device with the defect (None: as it is) as a shared library in ``folder``.

    :raises ValueError: the text to be altered does not stand there once.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sources = folder / "estimator_c"
    shutil.rmtree(sources, ignore_errors=True)
    shutil.copytree(SOURCES, sources, ignore=shutil.ignore_patterns("fuzz", "evidence", "cortex*", "__pycache__"))
    if defect is not None:
        path = sources / defect.file
        text = path.read_text(encoding="utf-8")
        if text.count(defect.before) != 1 or defect.before == defect.after:
            raise ValueError(f"{defect.name}: its text stands {text.count(defect.before)} times in {defect.file}")
        path.write_text(text.replace(defect.before, defect.after), encoding="utf-8")
    library = folder / "device.so"
    files = [
        file
        for part in ("core", "isolation", "fit", "device", "ports/library")
        for file in sorted(sources.glob(f"{part}/*.c"))
    ]
    include = [f"-I{sources / part}" for part in FOLDERS] + [f"-I{GENERATED}"]
    command: list[str | Path] = [
        os.environ.get("CC", "cc"),
        *FLAGS,
        *include,
        *files,
        *sorted(GENERATED.glob("*.c")),
        "-o",
        library,
    ]
    subprocess.run(command, check=True)
    return library


def tried(library: Path, name: str, folder: Path, *, shrunk: bool) -> Found:
    """Runs one property against a device."""
    runs = folder / "runs"
    command: list[str | Path] = [
        *(sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--rootdir", folder, "-p", "no:cacheprovider"),
        *("-p", "no:xdist", "-p", "no:randomly", "--tb=short", "-x"),
        *("--pyargs", "analogrig.testing.properties", "-k", name),
        *("--hil-dut", f"inproc:{library}", "--hil-runs-dir", runs),
        *(() if shrunk else ("-p", FOUND_ONLY)),
    ]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("ANALOGRIG_", "PYTEST_"))}
    environment["PYTHONPATH"] = str(ROOT)
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"pytest ended with status {done.returncode}:\n{done.stdout}{done.stderr}")
    return Found(done.returncode == 1, done.stdout, runs)


def simplest(runs: Path) -> str:
    """The scenario that is left, in a few words."""
    files = sorted(runs.glob("*/scenario.toml"))
    return _words(tomllib.loads(files[0].read_text(encoding="utf-8"))) if files else "-"


def _values(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in values.items())


def _words(scenario: dict[str, Any]) -> str:
    if scenario.get("description"):
        rig = Path(str(scenario.get("rig", ""))).stem or "emulator"
        return f"{rig}: {scenario['description']}; {scenario['samples']} samples, seed {scenario['seed']}"
    excitation = scenario["excitation"]
    words = [_values(scenario.get("set", {})) or str(scenario["program"])]
    levels = f"{excitation['low_v']:g} to {excitation['high_v']:g} V"
    words.append(f"{excitation['shape']} {levels}, {excitation['frequency_hz']:g} Hz")
    words += [f"at {change['sample']} {_values(change['set'])}" for change in scenario.get("changes", [])]
    return f"{'; '.join(words)}; {scenario['samples']} samples, seed {scenario['seed']}"


def main() -> int:
    parser = argparse.ArgumentParser(description="Plant each defect of defects.toml, and write the table of README.md.")
    parser.add_argument("--new", action="store_true", help="try only defects that the table lacks")
    is_new_only = parser.parse_args().new
    head, _, table = README.read_text(encoding="utf-8").partition(TABLE)
    rows = {row.split(" | ")[0].removeprefix("| "): row for row in table.splitlines()} if is_new_only else {}
    missed = []
    for defect in defects():
        if defect.name in rows:
            continue
        folder = ROOT / "build" / "defects" / re.sub(r"\W+", "-", defect.name)
        shutil.rmtree(folder, ignore_errors=True)
        found = tried(planted(defect, folder), defect.property, folder, shrunk=True)
        (folder / "output.txt").write_text(found.output, encoding="utf-8")
        if not found.failed:
            missed.append(defect.name)
        cells = defect.name, f"`{defect.property}`", simplest(found.runs), found.why.replace("|", "/")
        rows[defect.name] = f"| {' | '.join(cells)} |"
        sys.stdout.write(f"{'found ' if found.failed else 'MISSED'} {defect.name}\n")
        sys.stdout.flush()
        kept = [rows[each.name] for each in defects() if each.name in rows]
        README.write_text(head + TABLE + "\n".join(kept) + "\n", encoding="utf-8")
    sys.stdout.write(json.dumps({"missed": missed}) + "\n")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
