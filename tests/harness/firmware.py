"""The firmware that the tests of QEMU need."""

from __future__ import annotations

import pytest

from tests import tools

CORES = ("m3", "m4", "m7")
"""Cores that QEMU has a board of."""

FOLDER = tools.FIRMWARE

needs_firmware = pytest.mark.tools("qemu-system-arm", "firmware")
