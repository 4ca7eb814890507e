"""What pytest may load here: an ini file names the device, and only code or the command line may allow that."""

from __future__ import annotations

import pytest


def pytest_configure(config: pytest.Config) -> None:
    config.option.hil_allow = ["./my_device.so"]
