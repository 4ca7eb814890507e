"""Descriptions of devices with a protocol of their own: the base class of adapters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from analogrig.datasheet import Datasheet
from analogrig.devices.description import DeviceDescription


@dataclass(frozen=True, kw_only=True)
class AdaptedDescription(DeviceDescription):
    """Description of a device with a protocol of its own."""

    datasheet: Datasheet = field(default_factory=Datasheet)
    """Figures that the owner states. What the device itself reports replaces them when it is opened."""
    settings: Mapping[str, bool | int | float | str] = field(default_factory=dict)
    """Settings of its estimator by name, if the kind has the capability ``configure``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.settings and "configure" not in self.capabilities:
            raise ValueError(f"settings: a device of the kind {self.kind} has none")

    def known_datasheet(self) -> Datasheet:
        return self.datasheet

    def as_table(self) -> dict[str, Any]:
        return super().as_table() | {"datasheet": self.datasheet.as_table(), "settings": dict(self.settings)}
