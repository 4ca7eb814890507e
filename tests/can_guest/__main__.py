"""The tests of suite/ in a guest: results in build/can_guest. python -m tests.can_guest [ARGUMENT OF PYTEST...]."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from . import guest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
RESULTS = ROOT / "build" / "can_guest"
REPORT = "junit.xml"

TIME_LIMIT_S = 600.0
"""Ten times what it takes on an idle machine."""
WITHIN = "ANALOGRIG_CAN_GUEST"
"""Set in the guest, where alone the tests are safe: they take interfaces down and disturb the bus."""

_ENVIRONMENT = {
    WITHIN: "1",
    "ANALOGRIG_CI": "1",  # all that the tests may need is there
    "HOME": "/run",
    "TMPDIR": "/run",
    "PYTHONDONTWRITEBYTECODE": "1",
    "PYTHONPATH": str(HERE / "without"),
    "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # each takes seconds to import
}
_PYTEST = (
    *(sys.executable, "-m", "pytest", "-p", "pytest_timeout", "-p", "no:cacheprovider"),
    *("--color=no", "--verbose", "--durations=10", f"--junitxml={guest.RESULTS / REPORT}", HERE / "suite"),
)


def run_suite(results: Path, arguments: Sequence[str] = (), console: IO[bytes] | None = None) -> int:
    """Pytest's status; its report is then in ``results``.

    :raises GuestError: it did not come to an end.
    """
    results.mkdir(parents=True, exist_ok=True)
    (results / REPORT).unlink(missing_ok=True)
    return guest.run(
        [*_PYTEST, *arguments],
        results,
        folder=ROOT,
        environment=_ENVIRONMENT,
        time_limit_s=TIME_LIMIT_S,
        console=console,
    )


def main(arguments: Sequence[str]) -> int:
    try:
        return run_suite(RESULTS, arguments)
    except guest.GuestError as error:
        sys.stderr.write(f"can-guest: {error}\n")
        return os.EX_UNAVAILABLE


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
