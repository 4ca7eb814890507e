"""Devices of the kind ``can-dbc``: an ECU with messages of its own, which a DBC describes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Self

from analogrig import ConfigurationError
from analogrig.devices import Capability, Device
from analogrig.devices.can import CanPort
from analogrig.trust import absolute_path
from analogrig_ecu.dbc_description import DbcDescription

if TYPE_CHECKING:
    import can

    from analogrig.devices import CaptureDecoding
    from analogrig.run import Channel
    from analogrig_ecu.ecu_messages import EcuMessages


@dataclass(frozen=True, kw_only=True)
class CanDbcDevice(CanPort, DbcDescription):
    """ECU on a CAN bus, with messages of its own."""

    kind: ClassVar[str] = "can-dbc"
    usage: ClassVar[str] = "FILE.toml"
    summary: ClassVar[str] = "ECU with messages of its own, which a DBC and a device file describe"
    decodes_logs: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_rates()

    @classmethod
    def from_name(cls, name: str, rest: str) -> Self:  # noqa: ARG003
        raise ConfigurationError(f"{name}: the signals of a device of the kind {cls.kind} need a device file (.toml)")

    @property
    def only_one(self) -> str:
        """The bus, also a virtual one: a second process would not find the ECU there."""
        return self.bus_name

    @property
    def is_private(self) -> bool:
        return self.interface == "virtual"

    @property
    def capabilities(self) -> frozenset[Capability]:
        return frozenset({"pace"})

    def messages(self) -> EcuMessages:
        """Messages of the device file, found in the DBC.

        :raises ConfigurationError: the DBC is wrong, or the device file does not fit it.
        """
        from analogrig_ecu.ecu_messages import EcuMessages

        return EcuMessages(self)

    def placed(self, folder: Path) -> Self:
        """The same device with its DBC as an absolute path.

        :raises ConfigurationError: as ``messages``.
        """
        placed = dataclasses.replace(self, dbc=absolute_path(self.dbc, folder))
        placed.messages()
        return placed

    def log_decoder(
        self, channels: Mapping[str, Channel], frames: Iterable[can.Message], *, most_n: int
    ) -> CaptureDecoding:
        from analogrig_ecu.ecu_decoder import EcuDecoder

        return EcuDecoder(self, channels, frames, most_n=most_n)

    def open(self) -> Device:
        from analogrig.links.can_bus import PythonCanBus
        from analogrig_ecu.ecu_device import EcuDevice

        return EcuDevice(self, PythonCanBus(self.bus_config()))
