"""Every command of README.md, by copy and paste, in order, in one shell.

The shell runs in a copy of this checkout, with the environment and the build products of the checkout. A command whose
tool is not installed is left out, and its test skips. `make test` would run this file again: it
gets one other test module to run. Its `check` is quick, by the caches of the `make test` around this one.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

from tests import tools

CHECKOUT = Path(__file__).parents[1]
README = (CHECKOUT / "README.md").read_text(encoding="utf-8")

NEEDS = {"make firmware": ("arm-none-eabi-gcc",), "qemu-": ("arm-none-eabi-gcc", "qemu-system-arm")}
"""Tools by a part of the command that needs them."""

SERVED_PORT = 5000
"""The rig red-pitaya names it, so that no other can be taken."""

END_OF = "=== ended with status"

NOT_COPIED = (
    ".git",
    ".venv",
    ".hypothesis",
    ".mypy_cache",
    ".pytest_cache",
    ".ruff_cache",
    "__pycache__",
    "*.egg-info",
)

pytestmark = [pytest.mark.timeout(3600), pytest.mark.heavy]  # 90 s of CPU time, 15 minutes at a load of twenty


def commands() -> list[tuple[str, str]]:
    """Each line of the shell blocks: the command and its comment."""
    blocks = re.findall(r"^```sh\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines() if line.strip()]
    return [(command.strip(), comment) for command, _, comment in (line.partition(" # ") for line in lines)]


COMMANDS = commands()
ENTER = ". .venv/bin/activate"


def statuses(comment: str) -> set[int]:
    """The exit statuses that a comment allows."""
    stated = re.search(r"status (\d+)( if)?", comment)
    return {0} if stated is None else {int(stated[1])} | ({0} if stated[2] else set())


def needed(command: str) -> tuple[str, ...]:
    """The tools that a command needs beside those of every machine."""
    return tuple(tool for part, needs in NEEDS.items() if part in command for tool in needs)


def copy(folder: Path) -> Path:
    """This checkout with what was built, such that make finds nothing out of date."""
    checkout = shutil.copytree(CHECKOUT, folder, ignore=shutil.ignore_patterns(*NOT_COPIED, "build"))
    for path in [*checkout.rglob("*.[chS]"), *checkout.rglob("*.py"), *checkout.rglob("*.dbc"), *checkout.glob("*.*")]:
        if path.name != "_catalogue.py":
            os.utime(path, (0, 0))
    os.utime(checkout / "Makefile", (0, 0))
    (checkout / ".venv").symlink_to(sys.prefix, target_is_directory=True)
    for made in ("build/firmware", "build/generated", "build/strict", ".mypy_cache"):
        if (CHECKOUT / made).is_dir():
            shutil.copytree(CHECKOUT / made, checkout / made)
    return checkout


def wait_for_port() -> None:
    """Wait until nobody else on this machine serves where the README does."""
    deadline_s = time.monotonic() + 600.0
    while time.monotonic() < deadline_s:
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", SERVED_PORT))
            return
        time.sleep(0.2)
    pytest.fail(f"port {SERVED_PORT} is in use, and README.md serves there")


def chosen(tests: Iterable[pytest.Item]) -> list[str]:
    """Commands to run, in order: those that need tools work without the others, and the others without those.

    A session with the tests of one sort alone, as `.ci/run` has two, runs that sort and enters the environment.
    """
    sorts = {
        bool(needed(str(test.callspec.params["command"])))
        for test in tests
        if isinstance(test, pytest.Function) and test.path == Path(__file__) and hasattr(test, "callspec")
    }
    return [
        command
        for command, _ in COMMANDS
        if (bool(needed(command)) in (sorts or {False}) or command == ENTER) and not tools.missing(needed(command))
    ]


@pytest.fixture(scope="module")
def ended(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, tuple[int, str]]:
    """Status and output of each command that was run."""
    run = chosen(request.session.items)
    checkout = copy(tmp_path_factory.mktemp("readme") / "checkout")
    pasted = [f"{command}\nprintf '\\n%s %s\\n' '{END_OF}' $?\n" for command in run]
    drop = ("ANALOGRIG", "HIL", "PYTEST", "VIRTUAL_ENV", "MAKE", "MFLAGS", "NO_COLOR", "FORCE_COLOR", "CLICOLOR")
    environment = {key: value for key, value in os.environ.items() if not key.startswith(drop)}
    environment |= {
        "PYTHONPATH": f"{checkout / 'harness'}{os.pathsep}{checkout / 'emulator'}",  # of the copy, not of the checkout
        "PYTEST_ARGS": "-p no:cacheprovider tests/harness/test_frame.py",
        "JOBS": "1",
    }
    wait_for_port()
    shell = subprocess.run(
        ["sh"], input="".join(pasted), cwd=checkout, env=environment, text=True, check=False,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    parts = re.split(rf"^{END_OF} (\d+)\n", shell.stdout, flags=re.MULTILINE)
    assert len(parts) == 2 * len(run) + 1, (
        f"a command has read the lines that follow it, or ended the shell:\n{shell.stdout}"
    )
    return {command: (int(parts[2 * i + 1]), parts[2 * i]) for i, command in enumerate(run)}


def test_readme_has_its_commands() -> None:
    assert len(COMMANDS) >= 20
    assert len({command for command, _ in COMMANDS}) == len(COMMANDS)


@pytest.mark.parametrize(
    ("command", "comment"),
    [pytest.param(*each, marks=pytest.mark.tools(*needed(each[0])), id=each[0]) for each in COMMANDS],
)
def test_command_ends_with_the_status_that_the_readme_states(
    command: str, comment: str, ended: Mapping[str, tuple[int, str]]
) -> None:
    status, output = ended[command]
    assert status in statuses(comment), output


def test_the_copy_was_run_and_not_the_checkout(ended: Mapping[str, tuple[int, str]]) -> None:
    assert "build/run/report.html" in ended["make run"][1]
    assert "passed" in ended["make test"][1]
    for command, (_, output) in ended.items():
        assert "Traceback" not in output, command
