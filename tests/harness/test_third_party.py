"""Kinds of devices and rigs that another package adds, through every command; and packages that are broken."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from analogrig.config import Kinds
from analogrig.devices.device import DeviceDescription
from analogrig.devices.registry import KINDS
from analogrig.run import Run

ROOT = Path(__file__).parents[2]
PAGES = {
    page: ROOT / f"harness/docs/howto/{page}.md"
    for page in ("add-a-kind-of-device", "add-a-rig", "add-an-instrument", "add-a-command")
}
SCENARIO = """\
samples = 400
rig = "flat"
dut = "jump:80"
[excitation]
low_v = 0.1
high_v = 9.9
[expect]
missed = 0
"""
CAMPAIGN = 'trials = 2\nscenario = "scenario.toml"\nrigs = ["flat"]\ndevices = ["jump:80", "jump:5000"]\n'
PLAYS = """\
def test_it(hil_play):
    assert hil_play("scenario.toml").run.alarm_index.tolist() == [251]
"""
BROKEN = {
    "devices": {
        "absent": ("no_such_module:It", "kind 'absent': the package broken"),
        "failing": ("broken_kinds_fail:It", "cannot be imported: ZeroDivisionError: division by zero"),
        "leaving": ("broken_kinds_leave:It", "cannot be imported: SystemExit: bye"),
        "alien": ("json:JSONDecoder", "is no subclass of DeviceDescription"),
        "misnamed": ("my_kinds:JumpDescription", "states the kind 'jump'"),
        "dumb": ("broken_kinds_dumb:It", "has no usage"),
        "inproc": ("my_kinds:JumpDescription", "ignored: the package broken"),
        "jump": ("broken_kinds_fail:It", "cannot be imported"),
    },
    "rigs": {
        "emulator": ("my_rigs:FlatDescription", "cannot replace a kind that there is"),
        "gone": ("no_such_module:It", "No module named 'no_such_module'"),
    },
}


def install(site: Path, package: str, **groups: dict[str, str]) -> None:
    """Files that pip leaves of a package, except its modules."""
    info = site / f"{package}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    text = "".join(
        f"[analogrig.{group}]\n" + "".join(f"{kind} = {target}\n" for kind, target in kinds.items())
        for group, kinds in groups.items()
    )
    (info / "entry_points.txt").write_text(text)


def files_of(page: str) -> dict[str, str]:
    """Files that a page shows, by name: the first line of each block has it as a comment."""
    text = PAGES[page].read_text(encoding="utf-8")
    return dict(re.findall(r"^```\w+\n# ([\w.]+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the packages of the pages as pip installs them."""
    folder = tmp_path_factory.mktemp("site")
    packages = [tmp_path_factory.mktemp(page) for page in PAGES]
    for package, page in zip(packages, PAGES, strict=True):
        for name, text in files_of(page).items():
            (package / name).write_text(text)
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation")
    subprocess.run([*pip, "--target", folder, *packages], check=True)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    (tmp_path / "test_plays.py").write_text(PLAYS)
    return tmp_path


def run(site: Path | str, cwd: Path, command: str) -> subprocess.CompletedProcess[str]:
    """End of a command of Python, such as ``pytest -q``, in whose environment the folder is installed."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("ANALOGRIG", "PYTEST"))}
    return subprocess.run(
        [sys.executable, "-m", *command.split()],
        cwd=cwd,
        env=kept | {"PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )


def analogrig(site: Path | str, cwd: Path, command: str) -> subprocess.CompletedProcess[str]:
    return run(site, cwd, f"analogrig.cli {command}")


PLAY = "run --dut jump:80 --rig flat --scenario scenario.toml --out out"


def test_page_shows_a_kind_in_forty_lines(site: Path) -> None:
    lines = [line for line in (site / "my_kinds.py").read_text().splitlines() if line.strip()]
    assert len(lines) <= 40


def test_kinds_of_another_package_play(site: Path, folder: Path) -> None:
    done = analogrig(site, folder, PLAY)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    played = Run.load(folder / "out" / "run.npz")
    assert played.alarm_index.tolist() == [251]
    assert played.datasheet.statistic and played.alarm_statistic[0] > 80.0
    assert played.conditions.rig == {"name": "flat", "kind": "flat", "jump_at": 250}
    assert played.conditions.dut["codes"] == 80
    again = analogrig(site, folder, "replay out/run.npz --out again")
    assert (again.returncode, again.stderr) == (0, ""), "the device is opened from the record"


def test_kinds_of_another_package_play_in_pytest_and_in_campaigns(site: Path, folder: Path) -> None:
    done = run(site, folder, "pytest -q -p no:cacheprovider --hil-rig flat --hil-dut jump")
    assert "1 passed" in done.stdout, done.stdout
    done = analogrig(site, folder, "campaign campaign.toml --workers 2 --out out.sqlite --json")
    assert done.stderr == ""
    assert [cell["missed"] for cell in json.loads(done.stdout)["cells"]] == [0, 2]


def test_broken_packages_are_listed_and_break_nothing_else(site: Path, folder: Path) -> None:
    (folder / "broken_kinds_fail.py").write_text("1 / 0")
    (folder / "broken_kinds_leave.py").write_text("raise SystemExit('bye')")
    (folder / "broken_kinds_dumb.py").write_text(
        "import analogrig.devices\nclass It(analogrig.devices.DeviceDescription):\n    kind = 'dumb'\n"
    )
    install(folder, "broken", **{group: {k: v[0] for k, v in kinds.items()} for group, kinds in BROKEN.items()})
    both = f"{site}{os.pathsep}{folder}"
    done = analogrig(both, folder, "list --json")
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    listed = json.loads(done.stdout)
    for group, kinds in BROKEN.items():
        rows = [(row["name"], row["description"]) for row in listed[group]]
        for kind, (_, text) in kinds.items():
            assert any(name == kind and text in shown for name, shown in rows), (kind, rows)
    assert "host[?baud=...]" in {row["name"] for row in listed["devices"]}
    played = analogrig(both, folder, "run --dut inproc --out out")
    assert (played.returncode, played.stderr) == (0, "")
    failed = analogrig(both, folder, "run --dut failing")
    assert failed.returncode == 2
    assert failed.stderr.startswith("analogrig: kind 'failing': the package broken (analogrig.devices: ")
    assert failed.stderr.count("\n") == 1


@pytest.mark.parametrize("fault", ["open", "things", "play"])
def test_package_that_fails_is_named(site: Path, folder: Path, fault: str) -> None:
    member = "@property\n    def things(self" if fault == "things" else "def open(self"
    body = "return Failing(self)" if fault == "play" else "raise LookupError('no such board')"
    (folder / "failing_kinds.py").write_text(
        "from my_kinds import JumpDescription, JumpDevice\n"
        "class Failing(JumpDevice):\n    def play(self, blocks):\n        raise LookupError('no such board')\n"
        f"class It(JumpDescription):\n    kind = 'it'\n    {member}):\n        {body}\n"
    )
    install(folder, "failing", devices={"it": "failing_kinds:It"})
    done = analogrig(f"{site}{os.pathsep}{folder}", folder, "run --dut it")
    package = "the package failing (analogrig.devices: failing_kinds:It)"
    assert (done.returncode, done.stderr) == (
        3,
        f"analogrig: {package}: LookupError: no such board (ANALOGRIG_DEBUG=1 shows where)\n",
    )


def test_every_kind_states_what_a_list_shows() -> None:
    assert all(cls.kind == kind and cls.usage and cls.summary for kind, cls in KINDS.items())


def test_package_that_states_its_entry_points_wrongly_harms_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path / "good", "good", devices={"fine": "pathlib:Path"})
    folder = tmp_path / "bad" / "bad-1.0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: bad\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[analogrig.devices]\nfoo\n")
    for name in ("bad", "good"):
        monkeypatch.syspath_prepend(tmp_path / name)
    kinds = Kinds(DeviceDescription, "analogrig.devices", {})
    assert "fine" in list(kinds)


def test_command_of_another_package_is_listed_and_runs(site: Path, folder: Path) -> None:
    assert "\n    span        print the span" in analogrig(site, folder, "--help").stdout
    analogrig(site, folder, PLAY)
    done = analogrig(site, folder, "span out/run.npz --json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["force"] == 0
    wrong = analogrig(site, folder, "span none.npz")
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1)


def test_instrument_of_another_package_records(site: Path, folder: Path) -> None:
    (folder / "rigs.toml").write_text(files_of("add-an-instrument")["rigs.toml"])
    refused = analogrig(site, folder, "doctor --rig loop")
    assert refused.returncode == 2
    assert "--allow loop://bench" in refused.stderr
    done = analogrig(site, folder, "doctor --rig loop --allow loop://bench --json")
    assert (done.returncode, done.stderr) == (1, ""), done.stdout
    assert any(check["state"] == "wrong" for check in json.loads(done.stdout)["checks"])


@pytest.mark.parametrize(
    ("target", "text"),
    [
        ("no_such_module:add", "No module named 'no_such_module'"),
        ("json:loads", "TypeError: "),
        ("nothing:add", "adds no command of this name"),
    ],
)
def test_broken_command_harms_no_other(site: Path, folder: Path, target: str, text: str) -> None:
    (folder / "nothing.py").write_text("def add(commands): pass\n")
    install(folder, "broken", commands={"broke": target, "run": "my_command:add"})
    both = f"{site}{os.pathsep}{folder}"
    helped = analogrig(both, folder, "--help")
    assert helped.returncode == 0
    assert "command 'run' of the package broken (analogrig.commands: my_command:add) is ignored" in helped.stderr
    broken = analogrig(both, folder, "broke --any thing")
    assert broken.returncode == 2
    assert text in broken.stderr.splitlines()[-1]
    assert analogrig(both, folder, "span none.npz").returncode == 2
