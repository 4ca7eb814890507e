"""Allow the program that device.toml names: no file may run code unless conftest.py or the command line allows it."""

from pathlib import Path


def pytest_configure(config):
    config.option.hil_allow.append(str(Path(__file__).with_name("firmware")))
