"""CAN interfaces of the guest, their manipulation by ip and tc, and the device on them."""

from __future__ import annotations

import contextlib
import json
import subprocess
from collections.abc import Iterator
from typing import Any

import can

from analogrig.devices.child import Child
from analogrig.devices.processes import HOST_PROGRAM

VIRTUAL = "vcan0"
CONTROLLERS = ("can0", "can1", "can2")
"""Interfaces on one bus. Classic CAN only: an SJA1000 has no CAN FD."""


def state(interface: str) -> dict[str, Any]:
    """Details of an interface from the kernel."""
    told = subprocess.run(
        ["ip", "-details", "-json", "link", "show", interface], check=True, capture_output=True, text=True
    )
    (link,) = json.loads(told.stdout)
    return dict(link)


def set_link(interface: str, *words: str) -> None:
    subprocess.run(["ip", "link", "set", interface, *words], check=True)


@contextlib.contextmanager
def down(interface: str) -> Iterator[None]:
    """Take an interface down within the context."""
    set_link(interface, "down")
    try:
        yield
    finally:
        set_link(interface, "up")


@contextlib.contextmanager
def queue(interface: str, *, limit_n: int, bitrate: int) -> Iterator[None]:
    """Limit the queue to ``limit_n`` frames and the rate at which they leave, within the context."""
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
    """Device as a process on an interface."""
    child = Child([HOST_PROGRAM, "--can", *arguments], "the device")
    try:
        assert child.first_line() == arguments[0]
        yield child
    finally:
        child.end()
