"""Firmware that is a function of the bytes it receives, on a wire in memory whose clock only time-outs advance."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from analogrig.answers import Answers, Samples
from analogrig.errors import DeviceError, LinkError
from analogrig.links.link import VirtualClock, Wire
from analogrig_lines.line_device import LineDevice
from analogrig_lines.lines import FramesDevice, LinesDevice

Firmware = Callable[[bytes], bytes | list[bytes]]
"""Function of the bytes of one write. A list holds what each read of the harness returns; b"" is a time-out."""


class FunctionWire:
    """Wire to a firmware, which may say something when it is opened."""

    def __init__(self, firmware: Firmware, boot: bytes | list[bytes] = b"") -> None:
        self.name = "memory"
        self._clock = VirtualClock()
        self.clock = self._clock
        self._firmware = firmware
        self._reads = _reads(boot)

    def write(self, sent: bytes) -> None:
        self._reads = [*self._reads, *_reads(self._firmware(sent))]

    def read(self, timeout_s: float) -> bytes:
        received = self._reads[0] if self._reads else b""
        if received or timeout_s:
            self._reads = self._reads[1:]
        if not received:
            self._clock.advance(timeout_s)
        return received

    def close(self) -> None:
        pass


def _reads(said: bytes | list[bytes]) -> list[bytes]:
    return said if isinstance(said, list) else [said] if said else []


@dataclass(frozen=True, kw_only=True)
class _InMemory:
    """Firmware behind a ``FunctionWire``."""

    url: str = "memory"
    firmware: Firmware = bytes
    boot: bytes | list[bytes] = b""

    def wire(self) -> Wire:
        return FunctionWire(self.firmware, self.boot)


@dataclass(frozen=True, kw_only=True)
class OnFunction(_InMemory, LinesDevice):
    """Device that exchanges lines of text with a function."""


@dataclass(frozen=True, kw_only=True)
class FramesOnFunction(_InMemory, FramesDevice):
    """Device that exchanges binary frames with a function."""


def opened(firmware: Firmware, boot: bytes | list[bytes] = b"", **changes: Any) -> LineDevice:
    """Device of this firmware, recovered."""
    kind = FramesOnFunction if "framing" in changes or changes.get("format") == "binary" else OnFunction
    described = dataclasses.replace(kind(name="bob", firmware=firmware, boot=boot, timeout_s=1.0), **changes)
    device = LineDevice(described)
    device.recover()
    return device


def samples(n: int, missing: tuple[int, ...] = ()) -> Samples:
    index = np.arange(n)
    return Samples(0, (100 + index).astype(np.uint16), index.astype(np.uint16), ~np.isin(index, missing))


def played(device: LineDevice, n: int = 12, missing: tuple[int, ...] = ()) -> tuple[Answers | None, str]:
    """Answers to n samples, and the error that ended them."""

    def answers() -> Iterator[Answers]:
        device.start()
        yield from device.play([samples(n, missing)])
        device.stop()

    found: list[Answers] = []
    try:
        found += answers()
    except (DeviceError, LinkError) as error:
        return (found[-1] if found else None), str(error)
    return found[-1], ""
