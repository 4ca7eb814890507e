"""Allows the library that pytest.ini names: an ini file alone may not load code."""

from pathlib import Path


def pytest_configure(config):
    config.option.hil_allow = [str(Path(__file__).with_name("my_device.so"))]
