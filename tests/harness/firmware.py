"""The firmware that the tests of QEMU need."""

from __future__ import annotations

import pytest

from tests import tools

FIRMWARE_IDS = {"m3": "QEMU_M3", "m4": "QEMU_M4", "m7": "QEMU_M7", "f405": "BOARD"}
"""Name in the identity of the device, of each image that has a kind of its own."""
CORES = tuple(FIRMWARE_IDS)

FOLDER = tools.FIRMWARE

needs_firmware = pytest.mark.tools("qemu-system-arm", "firmware")
