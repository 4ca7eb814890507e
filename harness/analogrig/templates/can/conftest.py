"""Start the ECU on a bus of this process, and allow that bus: no file may connect to one unless conftest.py does."""

import threading

import can
import ecu

BUS = can.Bus(interface="virtual", channel="ecu")


def pytest_configure(config):
    config.option.hil_allow.append("can:virtual/ecu")
    threading.Thread(target=ecu.serve, args=(BUS,), daemon=True).start()


def pytest_unconfigure():
    BUS.shutdown()
