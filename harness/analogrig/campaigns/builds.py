"""Builds that play a campaign, identified by file contents.

The trials of one campaign all come from one build. A name does not identify a build: the firmware, library or analogrig
behind it may differ on another machine, or when a campaign resumes.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path

import analogrig
import analogrig_emulator
from analogrig.devices.device import DeviceDescription
from analogrig.devices.library import LIBRARY
from analogrig.errors import ConfigurationError
from analogrig.identity import version
from analogrig.output import replace_file

DIGITS = 16
"""Hex digits of a SHA-256 that identify a build."""

_PACKAGES = tuple(Path(str(package.__file__)).parent for package in (analogrig_emulator, analogrig))


@functools.cache
def of_analogrig() -> str:
    """Version of analogrig, the hash of all files that decide what is played, and that of its Python alone."""
    return f"{version()} {_hash_of('py', 'so')} {_hash_of('py')}"


def _hash_of(*kinds: str) -> str:
    whole = hashlib.sha256()
    for path in sorted(path for folder in _PACKAGES for kind in kinds for path in folder.rglob(f"*.{kind}")):
        whole.update(path.read_bytes())
    return whole.hexdigest()[:DIGITS]


def of_device(device: DeviceDescription) -> str:
    """Hash of the file that the device runs; "" if that file is not on this computer.

    :raises ConfigurationError: the file cannot be read.
    """
    if device.program is None:
        return ""
    try:
        return hashlib.sha256(device.program.read_bytes()).hexdigest()[:DIGITS]
    except OSError as error:
        raise ConfigurationError(f"device {device.name}: {device.program}: {error.strerror or error}") from error


def check_analogrig(planned: str) -> None:
    """Check that this analogrig has the version and the Python of the one that began the campaign.

    The compilers may differ: the estimates are the same bits.

    :raises ConfigurationError: it has others.
    """
    begun_by, *_, sources = planned.split()
    if version() != begun_by:
        raise ConfigurationError(f"this worker has analogrig {version()}, the campaign was begun by {begun_by}")
    here = of_analogrig().split()[-1]
    if here != sources:
        raise ConfigurationError(
            f"this worker has analogrig {version()} with the sources {here}, the campaign was begun by {sources}:"
            " install the same build"
        )


_supplied: dict[str, Path] = {}
"""Files of devices that came with a campaign from another machine, by their hash."""


def supply(files: Mapping[str, bytes], folder: Path) -> None:
    """Keep files of devices in a folder of this worker; each is used only where its hash is the planned one."""
    for digest, content in files.items():
        if hashlib.sha256(content).hexdigest()[:DIGITS] == digest:
            path = folder / f"analogrig-{digest}"
            with replace_file(path) as file:
                file.write(content)
            path.chmod(0o700)
            _supplied[digest] = path


def supplied(device: DeviceDescription, planned: str) -> Path | None:
    """File that came with the campaign for a device whose own file is absent here, or another."""
    if device.program is None or planned not in _supplied:
        return None
    if device.program.is_file() and of_device(device) == planned:
        return None
    return _supplied[planned]


def check_device(device: DeviceDescription, planned: str) -> None:
    """Check that the device runs the file with which the campaign was begun.

    Analogrig's own library and program may come from other compilers: the estimates are the same bits.

    :raises ConfigurationError: it runs another.
    """
    is_own = device.program is not None and device.program.is_relative_to(LIBRARY.parent)
    if not is_own and of_device(device) != planned:
        raise ConfigurationError(
            f"device {device.name}: {device.program} is another build than the one that the campaign was begun with"
        )
