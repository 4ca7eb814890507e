"""What the tests do to the CAN interfaces of the guest, in the words of ip and tc."""

from __future__ import annotations

import contextlib
import json
import subprocess
from collections.abc import Iterator
from typing import Any

import can

VIRTUAL = "vcan0"
CONTROLLERS = ("can0", "can1")
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
