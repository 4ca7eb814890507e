"""Permission for pytest to load the device: the ini file names it, only code or the command line may allow it."""

from __future__ import annotations

import pytest


def pytest_configure(config: pytest.Config) -> None:
    config.option.hil_allow = ["./my_device.so"]
