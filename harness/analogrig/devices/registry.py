"""Devices by name: kinds, shipped descriptions, files, and tables of plain values."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from analogrig import config
from analogrig.devices.description import DeviceDescription
from analogrig.errors import ConfigurationError
from analogrig.kinds import Kinds
from analogrig.trust import Thing, Trust, file_of, folder_of

_FOUND_OUT = ("identity", "datasheet")
"""Tables of a record that the device, once opened, adds to its description."""

_WORD = re.compile(r"[\w-]{1,40}")
"""Name of a kind or a shipped device."""

_ELF = b"\x7fELF"
"""First bytes of libraries, programs and firmware."""

KINDS = Kinds(
    DeviceDescription,
    "analogrig.devices",
    {
        "host": "analogrig.devices.host:HostDevice",
        "inproc": "analogrig.devices.inproc:InprocDevice",
        "library": "analogrig.devices.estimator_library:EstimatorLibrary",
        "qemu-m3": "analogrig.devices.qemu:QemuM3",
        "qemu-m4": "analogrig.devices.qemu:QemuM4",
        "qemu-m7": "analogrig.devices.qemu:QemuM7",
        "qemu-f405": "analogrig.devices.qemu:QemuF405",
        "serial": "analogrig.devices.serial:SerialDevice",
        "can": "analogrig.devices.can:CanDevice",
        "can-dbc": "analogrig.devices.can_dbc:CanDbcDevice",
        "python": "analogrig.devices.python:PythonDescription",
        "lines": "analogrig.devices.lines:LinesDevice",
        "exec": "analogrig.devices.program:ProgramDevice",
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
        KINDS[kind].check_place(name, name[len(kind) :].partition("?")[0])
        try:
            return KINDS[kind].from_name(name, name[len(kind) :].removeprefix(":")).placed(folder_of(name)), ""
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
