"""Allow the library that device.toml names: no file may load code unless conftest.py or the command line allows it."""

from pathlib import Path


def pytest_configure(config):
    config.option.hil_allow.append(str(Path(__file__).with_name("estimator.so")))
