"""The CAN interfaces of the guest: what the tests do to them, in the words of ip and tc, and the device on them."""

from __future__ import annotations

import contextlib
import json
import subprocess
from collections.abc import Iterator
from typing import Any

import can

from analogrig.devices.child import Child
from analogrig.devices.host import HOST_PROGRAM

VIRTUAL = "vcan0"
CONTROLLERS = ("can0", "can1", "can2")
"""On one bus. Classic: an SJA1000 knows no CAN FD."""


def state(interface: str) -> dict[str, Any]:
    """All that the kernel says about it."""
    told = subprocess.run(
        ["ip", "-details", "-json", "link", "show", interface], check=True, capture_output=True, text=True
    )
    (link,) = json.loads(told.stdout)
    return dict(link)


def set_link(interface: str, *words: str) -> None:
    subprocess.run(["ip", "link", "set", interface, *words], check=True)


@contextlib.contextmanager
def down(interface: str) -> Iterator[None]:
    """For a while."""
    set_link(interface, "down")
    try:
        yield
    finally:
        set_link(interface, "up")


@contextlib.contextmanager
def queue(interface: str, *, limit_n: int, bitrate: int) -> Iterator[None]:
    """For a while no more frames wait than ``limit_n``, and they leave at this rate."""
    device = ["dev", interface, "root"]
    subprocess.run(["tc", "qdisc", "add", *device, "netem", "limit", str(limit_n), "rate", f"{bitrate}bit"], check=True)
    try:
        yield
    finally:
        subprocess.run(["tc", "qdisc", "del", *device], check=True)


def socketcan(channel: str, **settings: Any) -> can.BusABC:
    return can.Bus(interface="socketcan", channel=channel, ignore_config=True, **settings)


@contextlib.contextmanager
def device(*arguments: str) -> Iterator[Child]:
    """The device as a process, on the interface and with the options that are its arguments."""
    child = Child([HOST_PROGRAM, "--can", *arguments], "the device")
    try:
        assert child.first_line() == arguments[0]
        yield child
    finally:
        child.end()
