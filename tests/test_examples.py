"""Every example of harness/examples, run in a copy of its folder as its README states."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from analogrig.cli import command_line
from tests.harness.processes import LONG_S

pytestmark = pytest.mark.heavy

CHECKOUT = Path(__file__).parents[1]
EXAMPLES = CHECKOUT / "harness" / "examples"
LIBRARY_PAGE = CHECKOUT / "harness/docs/howto/test-a-c-library.md"
BIN = Path(sys.executable).parent
PORT_OF_THE_EXAMPLES = "5000"
THESIS_7 = "54f04f72e4f6d22a"
"""First digits of the theta hash of the scenario thesis, seed 7."""
GROUP_OF_THE_EXAMPLES = "239.74.163.2"


def run(command: str, folder: Path, status: int = 0) -> str:
    """Run a shell command with this environment's Python first; return its output."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("ANALOGRIG", "PYTEST"))}
    done = subprocess.run(
        ["sh", "-c", command], cwd=folder, env=environment | {"PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False, timeout=LONG_S,
    )  # fmt: skip
    assert done.returncode == status, done.stdout
    return done.stdout


@pytest.fixture
def example(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A copy of the example that the parameter names."""
    ignored = shutil.ignore_patterns("*.so", "my_program", "text_firmware", "text_firmware.elf", "build", "__pycache__")
    copy = tmp_path / str(request.param)
    shutil.copytree(EXAMPLES / request.param, copy, ignore=ignored)
    return copy


@pytest.mark.parametrize("example", ["first_test"], indirect=True)
def test_first_test_passes_with_the_projects_estimator(example: Path) -> None:
    assert "3 passed" in run("pytest -q --hil-dut inproc", example)


@pytest.mark.parametrize("example", ["own_estimator"], indirect=True)
def test_estimator_compiles_and_its_tests_run(example: Path) -> None:
    assert "1 passed, 1 xfailed" in run("make && pytest -q", example)
    for line in scripts():
        if line.startswith("pytest"):
            assert "1 passed" in run(line, example)
        elif line.startswith("analogrig"):
            assert "PASSED" in run(line, example)


@pytest.mark.parametrize("example", ["text_firmware"], indirect=True)
def test_text_firmware_answers_as_a_program(example: Path) -> None:
    told = run("make --silent && printf 'R\\n7,1000,2000\\n' | ./text_firmware", example)
    first = "44fa0000"  # the offset is at first the first output, 2000
    assert told.splitlines() == ["text firmware with est", "OK", f"7,{5 * '00000000,'}{first},0"]


@pytest.mark.parametrize(
    ("example", "program"), [("program", "my_program"), ("text_firmware", "text_firmware")], indirect=["example"]
)
def test_program_is_judged(example: Path, program: str) -> None:
    file = {"my_program": "my_program.toml", "text_firmware": "program.toml"}[program]
    played = f"analogrig run --scenario thesis --seed 7 --dut {file}"
    shown = run(f"make --silent && {played} --allow ./{program}", example)
    assert "PASSED" in shown
    assert f"theta hash {THESIS_7}" in shown
    assert "--allow" in run(played, example, status=2)


@pytest.mark.tools("arm-none-eabi-gcc")
@pytest.mark.parametrize("example", ["text_firmware"], indirect=True)
def test_text_firmware_compiles_for_its_board(example: Path) -> None:
    run("make --silent text_firmware.elf", example)
    assert (example / "text_firmware.elf").read_bytes().startswith(b"\x7fELF")


def test_page_on_c_libraries_leads_to_its_verdicts(tmp_path: Path) -> None:
    (script,) = re.findall(r"^```sh\n(.*?)^```$", LIBRARY_PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    verdicts = re.findall(r"seed \d+: (\w+)$", run(f"set -e\n{script}", tmp_path), re.MULTILINE)
    assert verdicts == ["PASSED", "FAILED"]


def test_page_on_kalman_filters_leads_to_its_verdicts(tmp_path: Path) -> None:
    page = (LIBRARY_PAGE.parent / "test-a-kalman-filter.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```sh\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    shown = run("set -e\n" + "".join(blocks), tmp_path)
    assert re.findall(r"seed \d+: (\w+)$", shown, re.MULTILINE) == ["PASSED"] * 3
    assert len(re.findall("^10 passed", shown, re.MULTILINE)) == 2
    assert "in a row" not in shown
    (matrices,) = re.findall(r"^```text\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert set(matrices.splitlines()) <= set(run("analogrig patch dc-motor", tmp_path).splitlines())


@pytest.mark.parametrize("example", ["own_dbc"], indirect=True)
def test_ecu_is_judged_on_its_bus_and_by_its_log(example: Path) -> None:
    group = f"239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"  # of this process alone on this machine
    file = example / "ecu.toml"
    file.write_text(file.read_text(encoding="utf-8").replace(GROUP_OF_THE_EXAMPLES, group), encoding="utf-8")
    command = [sys.executable, "ecu.py", "udp_multicast", group]
    with subprocess.Popen(command, cwd=example, stdout=subprocess.PIPE, text=True) as ecu:
        try:
            assert ecu.stdout is not None and "listening" in ecu.stdout.readline()
            played = f"analogrig run --dut ecu.toml --scenario ./mass.toml --allow can:udp_multicast/{group}"
            live = run(played, example)
        finally:
            ecu.terminate()
    logged = run("analogrig judge build/run/can.log --dut ecu.toml --scenario ./mass.toml", example)
    assert "PASSED" in live and "PASSED" in logged
    assert re.findall("theta hash .*", live) == re.findall("theta hash .*", logged) != []


@pytest.mark.parametrize("example", ["rig"], indirect=True)
def test_rig_is_played_behind_the_served_instrument(example: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    file = example / "rigs.toml"
    file.write_text(file.read_text(encoding="utf-8").replace(PORT_OF_THE_EXAMPLES, port), encoding="utf-8")
    played = f"analogrig run --rig bench --dut inproc --allow 127.0.0.1:{port}"
    assert "PASSED" in run(f"analogrig serve --port {port} -- {played}", example)
    assert "--allow" in run("analogrig run --rig bench --dut inproc", example, status=2)


@pytest.mark.parametrize("example", ["campaign"], indirect=True)
def test_campaign_is_played(example: Path) -> None:
    run("analogrig campaign campaign.toml --workers 1", example)
    assert list((example / "build" / "campaign").glob("*.sqlite"))


def scripts() -> list[str]:
    """Shell lines of the CI examples."""
    github = yaml.safe_load((EXAMPLES / "ci/github.yml").read_text(encoding="utf-8"))
    gitlab = yaml.safe_load((EXAMPLES / "ci/gitlab.yml").read_text(encoding="utf-8"))
    steps = github["jobs"]["test"]["steps"]
    lines = [step["run"] for step in steps if "run" in step]
    assert lines == gitlab["estimator"]["script"]
    return lines


def test_ci_files_run_the_same_lines_and_each_is_understood() -> None:
    for line in scripts():
        words = shlex.split(line)
        if words[0] == "analogrig":
            command_line.make_parser().parse_args(words[1:])
        else:
            assert words[0] in {"pip", "make", "pytest"}
