"""Builds that play a campaign, identified by file contents.

The trials of one campaign all come from one build. A name does not identify a build: the firmware, library or analogrig
behind it may differ on another machine, or when a campaign resumes.
"""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path

import analogrig
import analogrig_emulator
from analogrig.devices.description import DeviceDescription
from analogrig.devices.library import LIBRARY
from analogrig.errors import ConfigurationError
from analogrig.identity import version

DIGITS = 16
"""Hex digits of a SHA-256 that identify a build."""

_PACKAGES = tuple(Path(str(package.__file__)).parent for package in (analogrig_emulator, analogrig))


@functools.cache
def of_analogrig() -> str:
    """Version of analogrig and, after a space, the hash of all files that decide what is played."""
    sources = sorted(path for folder in _PACKAGES for kind in ("py", "so") for path in folder.rglob(f"*.{kind}"))
    whole = hashlib.sha256()
    for path in sources:
        whole.update(path.read_bytes())
    return f"{version()} {whole.hexdigest()[:DIGITS]}"


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
    """Check that this analogrig has the version of the one that began the campaign.

    The compilers may differ: the estimates are the same bits.

    :raises ConfigurationError: it has another.
    """
    begun_by = planned.partition(" ")[0]
    if version() != begun_by:
        raise ConfigurationError(f"this worker has analogrig {version()}, the campaign was begun by {begun_by}")


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
