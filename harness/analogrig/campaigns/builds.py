"""Builds that play a campaign, identified by file contents, and the commands that played it.

The trials of one campaign all come from one build. A name does not identify a build: the firmware, library or analogrig
behind it may differ on another machine, or when a campaign resumes. The commands stand in a file beside the results,
which do not depend on it.
"""

from __future__ import annotations

import functools
import hashlib
import json
from pathlib import Path

import analogrig
import analogrig_emulator
from analogrig import config
from analogrig.devices.description import DeviceDescription
from analogrig.devices.library import LIBRARY
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.identity import Identity, version
from analogrig.storage import replace_file

DIGITS = 16
"""Hex digits of a SHA-256 that identify a build."""

FORMAT, FORMAT_VERSION = "analogrig-campaign-identity", 1

MOST_BYTES = 10_000_000
"""Largest size of the file of commands."""

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


def commands_of(out: Path) -> Path:
    """Path of the file of the commands that have played the results ``out``."""
    return out.with_name(f"{out.name}.identity")


def load_commands(path: Path) -> tuple[Identity, ...]:
    """Commands that have played, in order; none if there is no such file.

    :raises RecordingError: it cannot be read, or is another file.
    """
    if not path.exists():
        return ()
    other = RecordingError(f"{path}: is no file of identities of a campaign: remove it")
    try:
        table = json.loads(config.read_bounded(path, MOST_BYTES))
        is_ours = (table["format"], table["version"]) == (FORMAT, FORMAT_VERSION)
        identities = tuple(config.build(Identity, each, str(path)) for each in table["played_by"])
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from error
    except (ConfigurationError, LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise other from error
    if not is_ours:
        raise other
    return identities


def save_commands(path: Path, played_by: tuple[Identity, ...]) -> None:
    """:raises RecordingError: it cannot be written."""
    table = {"format": FORMAT, "version": FORMAT_VERSION, "played_by": [each.as_table() for each in played_by]}
    with replace_file(path) as file:
        file.write(f"{json.dumps(table, indent=1)}\n".encode())
