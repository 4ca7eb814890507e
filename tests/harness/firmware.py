"""The firmware that the tests of QEMU need."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from analogrig.devices.devices import FIRMWARE, QEMU

CORES = ("m3", "m4", "m7")
"""Those that QEMU has a board of."""

FOLDER = Path(os.environ.get("ANALOGRIG_FIRMWARE", FIRMWARE))

needs_firmware = [
    pytest.mark.skipif(shutil.which(QEMU) is None, reason=f"no {QEMU}: apt-get install qemu-system-arm"),
    pytest.mark.skipif(
        not all((FOLDER / f"analogrig-{core}.elf").exists() for core in ("m0", *CORES)),
        reason="no firmware: make firmware",
    ),
]
