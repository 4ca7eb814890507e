"""Devices of the kind ``lines``: a firmware that speaks lines of text at a serial port, or at any URL of pyserial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from analogrig.devices.port_description import PortDescription
from analogrig.devices.template_description import TemplateDescription
from analogrig.errors import ConfigurationError
from analogrig.links.wire import DEFAULT_BAUD

MOST_BAUD = 100_000_000


@dataclass(frozen=True, kw_only=True)
class LinesDevice(PortDescription, TemplateDescription):
    """A firmware that speaks lines of text at a serial port, or at any URL of pyserial."""

    kind: ClassVar[str] = "lines"
    usage: ClassVar[str] = "lines:URL[?send=...&receive=...]"
    summary: ClassVar[str] = "firmware that speaks lines of text at a serial port; its templates are in a device file"
    loses_lines: ClassVar[bool] = True
    baud: int = DEFAULT_BAUD

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.baud <= MOST_BAUD:
            raise ValueError(f"baud must be 1 to {MOST_BAUD}, not {self.baud}")

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """Accept any place: ``_place`` reports a missing URL."""

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:
        if not place:
            raise ConfigurationError(
                f"{name}: no port: use {cls.kind}:/dev/ttyACM0, or a device file with its templates"
            )
        return {"url": place}
