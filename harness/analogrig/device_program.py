"""Command ``analogrig-device``: the device as a program, from wherever the package is installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NoReturn

PROGRAM = Path(__file__).parent / "bin" / "analogrig-device"


def main() -> NoReturn:
    """Replace this process by the device, with the same arguments."""
    try:
        os.execv(PROGRAM, ["analogrig-device", *sys.argv[1:]])  # noqa: S606 - no shell is wanted
    except OSError as error:
        sys.stderr.write(f"analogrig-device: cannot execute {PROGRAM}: {error.strerror}; install analogrig again\n")
        sys.exit(2)
