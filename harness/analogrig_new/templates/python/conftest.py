"""Allow the module that device.toml names: no file may run code unless conftest.py or the command line allows it."""


def pytest_configure(config):
    config.option.hil_allow.append("python:estimator:Estimator")
