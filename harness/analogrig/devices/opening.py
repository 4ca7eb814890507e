"""Open a device by its name, or as a recording describes it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.devices.description import DeviceDescription
from analogrig.devices.device import Device
from analogrig.devices.registry import recorded, trusted
from analogrig.errors import ConfigurationError
from analogrig.trust import Trust

if TYPE_CHECKING:
    from analogrig.links.link import CanListener


def open_dut(
    name: str,
    *,
    allow: Trust | Iterable[str] = (),
    listener: CanListener | None = None,
    in_real_time: bool = False,
    **changes: Any,
) -> Device:
    """Open a device by name: connected, configured and ready to start. Use it in a ``with`` statement.

    :param name: ``host``, ``inproc[:LIBRARY]``, ``qemu-m4[:ELF]``, ``serial:URL``, ``can:INTERFACE/CHANNEL``, a shipped
        name or a .toml file; ``?key=value`` appended to a name overrides fields of the description.
    :param allow: libraries, firmware, ports and buses that a file may name (``analogrig.trust``).
    :param listener: receives every frame of a CAN bus from its opening on.
    :param in_real_time: exchange = "stream", unless ``changes`` has one or this kind of device has no such field.
    :param changes: override fields of the description; None leaves a field as described.
    :raises ConfigurationError: no such device, its description is wrong, or a file names what is not allowed.
    :raises LinkError: the device cannot be reached.
    :raises DeviceError: it refuses the configuration, or was built from another catalogue.
    """
    return _override(trusted(name, Trust.of(allow)), changes, in_real_time=in_real_time).connect(listener)


def reopen_dut(
    description: Mapping[str, Any],
    file: str,
    *,
    allow: Trust | Iterable[str] = (),
    listener: CanListener | None = None,
    in_real_time: bool = False,
    **changes: Any,
) -> Device:
    """Open the device of a record of ``Device.description()`` in ``file``; parameters and errors as ``open_dut``."""
    described = recorded(description).placed(Path(file).parent)
    Trust.of(allow).check(described.things, file)
    return _override(described, changes, in_real_time=in_real_time).connect(listener)


def _override(description: DeviceDescription, changes: Mapping[str, Any], *, in_real_time: bool) -> DeviceDescription:
    """:raises ConfigurationError: a value is out of range, or this kind of device has no such field."""
    wanted = {key: value for key, value in changes.items() if value is not None}
    fields = {each.name for each in dataclasses.fields(description)}
    if in_real_time and "exchange" in fields:
        wanted.setdefault("exchange", "stream")
    for key in wanted.keys() - fields:
        raise ConfigurationError(f"device {description.name}: a device of the kind {description.kind} has no {key}")
    try:
        return dataclasses.replace(description, **wanted)
    except ValueError as error:
        raise ConfigurationError(f"device {description.name}: {error}") from error
