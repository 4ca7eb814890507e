"""Allows the library that pytest.ini names: an ini file alone may not load code."""


def pytest_configure(config):
    config.option.hil_allow = ["./my_device.so"]
