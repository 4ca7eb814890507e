"""Run the tests of suite/ in a guest; results in build/can_guest. python -m tests.soak.can_guest [ARGUMENT...]."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from . import guest

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
RESULTS = ROOT / "build" / "can_guest"
REPORT = "junit.xml"

TIME_LIMIT_S = 3000.0
"""Limit for the whole suite in the guest, which takes a minute on an idle machine."""
WITHIN = "ANALOGRIG_CAN_GUEST"
"""Variable that is set in the guest. The tests take interfaces down and disturb the bus: elsewhere they are unsafe."""

_NO_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}
_ENVIRONMENT = {
    WITHIN: "1",
    "ANALOGRIG_CI": "1",  # all that the tests may need is there
    "HOME": "/run",
    "TMPDIR": "/run",
    "PYTHONPATH": str(HERE / "without"),
    "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # each takes seconds to import
    "HYPOTHESIS_STORAGE_DIRECTORY": "/run/hypothesis",  # its own place is read-only
}
_PYTEST = (
    *(sys.executable, "-m", "pytest", "-p", "pytest_timeout", "-p", "no:cacheprovider", "--color=no"),
    *("-W", "ignore:unclosed <socket:ResourceWarning"),  # python-can's, when there is no such interface
    HERE / "suite",
)


def run_suite(results: Path, arguments: Sequence[str] = (), console: IO[bytes] | None = None) -> int:
    """Run pytest in the guest and return its status. Its report is in ``results``.

    :raises GuestError: it did not come to an end.
    """
    _compile()
    results.mkdir(parents=True, exist_ok=True)
    (results / REPORT).unlink(missing_ok=True)
    return guest.run(
        [*_PYTEST, "--verbose", "--durations=10", f"--junitxml={guest.RESULTS / REPORT}", *arguments],
        results,
        folder=ROOT,
        environment=_ENVIRONMENT | _NO_BYTECODE,
        time_limit_s=TIME_LIMIT_S,
        console=console,
    )


def _compile() -> None:
    """Compile the Python sources on the host. The guest would compile them at every run, ten times as slowly."""
    command = [*map(str, _PYTEST), "--collect-only", "-q"]
    environment = {**_ENVIRONMENT, "PATH": os.environ.get("PATH", "")}
    subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, check=False)  # what fails will fail there


def throughput_in_guest() -> dict[str, float]:
    """Samples per second over SocketCAN in the guest, slower than on a real machine. Empty if there is no guest."""
    if guest.lacking() is not None:
        return {}
    report = "throughput.json"
    with tempfile.TemporaryDirectory() as results, (Path(results) / "console").open("w+b") as console:
        status = guest.run(
            [sys.executable, "-m", "tests.soak.can_guest.throughput", guest.RESULTS / report],
            Path(results),
            folder=ROOT,
            environment=_ENVIRONMENT | _NO_BYTECODE,
            time_limit_s=TIME_LIMIT_S,
            console=console,
        )
        if status != 0:
            raise guest.GuestError(Path(console.name).read_text(errors="replace"))
        return dict(json.loads((Path(results) / report).read_text()))


def main(arguments: Sequence[str]) -> int:
    try:
        return run_suite(RESULTS, arguments)
    except guest.GuestError as error:
        sys.stderr.write(f"can-guest: {error}\n")
        return os.EX_UNAVAILABLE


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
