"""Devices by name: kinds, shipped descriptions, files, tables of plain values; and opening them."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig import config
from analogrig.devices.device import Device, DeviceDescription
from analogrig.errors import ConfigurationError
from analogrig.trust import Thing, Trust, file_of, folder_of

if TYPE_CHECKING:
    from analogrig.links.link import CanListener

_FOUND_OUT = ("identity", "datasheet")
"""Tables of a record that the device, once opened, adds to its description."""

_WORD = re.compile(r"[\w-]{1,40}")
"""Name of a kind or a shipped device."""

_ELF = b"\x7fELF"
"""First bytes of libraries, programs and firmware."""

KINDS = config.Kinds(
    DeviceDescription,
    "analogrig.devices",
    {
        "host": "analogrig.devices.processes:HostDevice",
        "inproc": "analogrig.devices.library:InprocDevice",
        "library": "analogrig.devices.estimator_library:EstimatorLibrary",
        "qemu-m3": "analogrig.devices.processes:QemuM3",
        "qemu-m4": "analogrig.devices.processes:QemuM4",
        "qemu-m7": "analogrig.devices.processes:QemuM7",
        "qemu-f405": "analogrig.devices.processes:QemuF405",
        "serial": "analogrig.devices.port:SerialDevice",
        "can": "analogrig.devices.can:CanDevice",
        "python": "analogrig.devices.python:PythonDescription",
    },
)
"""Description of each kind of device."""


def describe(name: str) -> DeviceDescription:
    """Description of the device ``name``: a shipped description, a .toml file, or a kind with its parameters.

    To read only. A device to be opened comes from ``trusted``, which checks what a file names.

    :raises ConfigurationError: there is no such device, or its description is wrong.
    """
    return _read(name)[0]


def trusted(name: str, trust: Trust) -> DeviceDescription:
    """Description of the device ``name``, to be opened.

    :raises ConfigurationError: as ``describe``, or a file names a thing that is not trusted.
    """
    description, file = _read(name)
    trust.check(description.things, file or file_of(name))
    return description


def named_things(name: str) -> tuple[Thing, ...]:
    """Things that ``name`` itself states, not a file that it refers to; none if it is no device."""
    with contextlib.suppress(ConfigurationError):
        description, file = _read(name)
        return () if file else description.things
    return ()


def _read(name: str) -> tuple[DeviceDescription, str]:
    """The description, and the file that holds it; no file if the name states everything."""
    kind = re.split("[:?]", name, maxsplit=1)[0]
    if kind in KINDS and name not in config.names("devices"):
        try:
            return KINDS[kind].from_name(name, name[len(kind) :]).placed(folder_of(name)), ""
        except ValueError as error:  # of the description of another package
            raise ConfigurationError(f"{name}: {error}") from error
    _check_known(name, kind)
    _check_not_compiled(name)
    path = config.locate("devices", name)
    description = from_table({"name": path.stem, **config.read_toml(path)}, str(path))
    try:
        return description.placed(path.parent), str(path)
    except ConfigurationError as error:  # of a second file that the description names
        raise ConfigurationError(f"{path}: {error}") from error


def _check_known(name: str, kind: str) -> None:
    """:raises ConfigurationError: the name is like that of a kind or a shipped device, and there is none."""
    known = dict.fromkeys([*KINDS, *config.names("devices")])
    if _WORD.fullmatch(kind) and kind not in config.names("devices") and not os.path.exists(name):  # noqa: PTH110 - of any length
        hint = config.suggest(kind, known)
        raise ConfigurationError(
            f"no device is called {kind!r}{hint or ':'} there are {', '.join(known)}, or give a .toml file"
        )


def _check_not_compiled(name: str) -> None:
    """:raises ConfigurationError: the file is a library, program or firmware, not a description."""
    path = Path(name)
    is_compiled = path.suffix == ".so"
    with contextlib.suppress(OSError, ValueError):  # the reader of the description reports these
        if path.is_file():
            with path.open("rb") as file:
                is_compiled = is_compiled or file.read(len(_ELF)) == _ELF
    if is_compiled:
        raise ConfigurationError(
            f"{name}: is a compiled file, not a description of a device: use library:{name} for an estimator,"
            f" inproc:{name} for a device of our catalogue, qemu-m4:{name} for firmware"
        )


def kinds_that_decode_logs() -> list[str]:
    """Kinds of devices whose description decodes a CAN log with messages of the device's own."""
    found = []
    for kind in KINDS:
        with contextlib.suppress(ConfigurationError):  # of a broken package
            found += [kind] * KINDS[kind].decodes_logs
    return found


def recorded(description: Mapping[str, Any]) -> DeviceDescription:
    """Description from the record of ``Device.description()``.

    :raises ConfigurationError: it describes no device.
    """
    kind = KINDS.get(str(description.get("kind")))
    fields = frozenset(() if kind is None else kind.__dataclass_fields__)
    table = {key: value for key, value in description.items() if key in fields or key not in _FOUND_OUT}
    return from_table(table, "the recorded device")


def from_table(table: Mapping[str, Any], where: str) -> DeviceDescription:
    """Description from plain values; ``where`` begins every error message.

    :raises ConfigurationError: they describe no device.
    """
    described = KINDS.get(str(table.get("kind")))
    if described is None:
        known = ", ".join(map(repr, KINDS))
        raise ConfigurationError(f"{where}: kind: must be one of {known}, not {table.get('kind')!r}")
    return config.build(described, {key: value for key, value in table.items() if key != "kind"}, where)


def open_dut(
    name: str | Path,
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
    named = str(name) if isinstance(name, Path) else name
    return _override(trusted(named, Trust.of(allow)), changes, in_real_time=in_real_time).connect(listener)


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
