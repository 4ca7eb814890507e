"""Start the ECU on a bus of this process. Remove this file for an ECU on a real bus."""

import threading

import can
import ecu

BUS = can.Bus(interface="virtual", channel="ecu")


def pytest_configure():
    threading.Thread(target=ecu.serve, args=(BUS,), daemon=True).start()


def pytest_unconfigure():
    BUS.shutdown()
