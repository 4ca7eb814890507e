"""Findings of static checkers: those that MISRA.md explains for core and isolation, none for the device."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from estimator_c.evidence import eva

ESTIMATOR = Path(__file__).parents[2] / "estimator_c"
CORE = ESTIMATOR / "core"
GENERATED = ESTIMATOR.parent / "build" / "generated"
SOURCES = sorted(path for part in ("core", "isolation", "fit") for path in (ESTIMATOR / part).glob("*.c"))
INCLUDE = f"-I{CORE}"

EVERYTHING = "-DEST_NC_MAX=2U"
"""Option of the build that leaves nothing out."""


@pytest.mark.heavy
@pytest.mark.tools("gcc")
@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.name)
def test_gcc_analyzer_finds_nothing(source: Path, tmp_path: Path) -> None:
    command = ["gcc", "-std=c99", "-O2", "-fanalyzer", "-Wall", "-Wextra", "-Werror", EVERYTHING, INCLUDE]
    command += ["-c", str(source)]
    done = subprocess.run([*command, "-o", str(tmp_path / "o")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.heavy
@pytest.mark.tools("clang-tidy")
@pytest.mark.parametrize("part", ["core", "isolation", "fit", "device"])
def test_clang_tidy_finds_nothing(part: str) -> None:
    """The checks are those of estimator_c/.clang-tidy."""
    folders = [ESTIMATOR / name for name in ("core", "isolation", "fit", "device")]
    options = ["-std=c99", "-DEST_NC_MAX=2U", *(f"-I{folder}" for folder in (*folders, GENERATED))]
    sources = map(str, sorted((ESTIMATOR / part).glob("*.c")))
    done = subprocess.run(
        ["clang-tidy", "--quiet", *sources, "--", *options], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


DEVICE_FOLDERS = [*(ESTIMATOR / name for name in ("core", "isolation", "fit", "device", "ports/loop")), GENERATED]
DEVICE_SOURCES = sorted(
    path for part in ("device", "ports/loop", "ports/host") for path in (ESTIMATOR / part).glob("*.c")
)


@pytest.mark.heavy
@pytest.mark.tools("gcc")
def test_gcc_analyzer_finds_nothing_in_the_device_and_its_port_to_this_computer(tmp_path: Path) -> None:
    command = ["gcc", "-std=c99", "-D_XOPEN_SOURCE=700", "-O2", "-fanalyzer", "-Wall", "-Wextra", "-Werror", "-c"]
    command += [*(f"-I{folder}" for folder in DEVICE_FOLDERS), *map(str, DEVICE_SOURCES)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.tools("cppcheck")
def test_cppcheck_finds_nothing_in_the_device() -> None:
    """Findings of its own rules; those of MISRA are for core and isolation."""
    command = [
        "cppcheck",
        "--quiet",
        "--enable=warning,style,performance,portability",
        "--std=c99",
        "--error-exitcode=1",
    ]
    command += ["-DEST_NC_MAX=2U", *(f"-I{folder}" for folder in DEVICE_FOLDERS)]
    sources = map(str, sorted((ESTIMATOR / "device").glob("*.c")))
    done = subprocess.run([*command, *sources], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.heavy
@pytest.mark.tools("frama-c")
def test_eva_finds_that_nothing_undefined_can_happen() -> None:
    """In the default shape, with any configuration and any samples; `make eva` has all shapes."""
    found = eva.analysed(eva.DEFAULT)
    assert found.alarms == ()
    assert found.reached > 0.9, "what is not reached is not analysed"


def explained() -> dict[str, str]:
    """The number of each deviation of MISRA.md, by the rule, or cppcheck's word for it."""
    headings = re.findall(r"^## ([DF]\d+): (?:rule )?([\w.]+)", (ESTIMATOR / "MISRA.md").read_text(), re.MULTILINE)
    return {(f"misra-c2012-{what}" if number[0] == "D" else what): number for number, what in headings}


def disapplied() -> set[str]:
    """The rules of MISRA.md that apply nowhere."""
    headings = re.findall(r"^## Rule ([\w.]+)", (ESTIMATOR / "MISRA.md").read_text(), re.MULTILINE)
    return {f"misra-c2012-{number}" for number in headings}


def numbers_in_the_code() -> set[tuple[str, int, str]]:
    """File, line and number of each `MISRA D1` or `cppcheck F1`."""
    return {
        (path.name, number, tag)
        for folder in {source.parent for source in SOURCES}
        for path in folder.glob("*.[ch]")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        for tag in re.findall(r"//.*?\b(?:MISRA|cppcheck) ([DF]\d+)\b", line)
    }


@pytest.mark.heavy
@pytest.mark.tools("cppcheck")
def test_what_cppcheck_with_misra_finds_is_explained_and_numbered_at_its_line(tmp_path: Path) -> None:
    command = ["cppcheck", "--quiet", "--addon=misra", "--enable=warning,style,performance,portability", "--std=c99"]
    command += ["--template={id} {file}:{line} {message}", "-DEST_NC_MAX=2U", INCLUDE]
    command += [f"--cppcheck-build-dir={tmp_path}"]
    done = subprocess.run([*command, *map(str, SOURCES)], capture_output=True, text=True, check=False, env=os.environ)
    assert done.returncode == 0, done.stdout + done.stderr
    numbers = explained()
    findings = re.findall(r"^(\S+) (\S+?):(\d+) (.*)$", done.stderr, re.MULTILINE)
    assert disapplied() <= {what for what, *_ in findings}, "disapplied, but nowhere found"
    findings = [finding for finding in findings if finding[0] not in disapplied()]
    found = {(Path(file).name, int(line), numbers.get(what, what)) for what, file, line, _ in findings}
    assert found - numbers_in_the_code() == set(), "not numbered at its line"
    assert numbers_in_the_code() - found == set(), "numbered, but no finding"
    assert set(numbers.values()) - {number for *_, number in found} == set(), "explained in MISRA.md, but nowhere found"
