"""Which commands have played a campaign: a file beside the results, which do not depend on it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from analogrig import config
from analogrig.campaigns.plan import device_as_planned
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.identity import DeviceFile, Identity
from analogrig.storage import replace_file

FORMAT, FORMAT_VERSION = "analogrig-campaign-identity", 1

MOST_BYTES = 10_000_000


def provenance_of(out: Path) -> Path:
    """Place of the file, by the results."""
    return out.with_name(f"{out.name}.identity")


def device_files(planned: Iterable[Mapping[str, Any]]) -> tuple[DeviceFile, ...]:
    """Libraries, programs and firmware that devices of a plan run on this machine."""
    devices = [device_as_planned(table) for table in planned]
    return tuple(DeviceFile.of(each.name, each.program) for each in devices if each.program is not None)


def load(path: Path) -> tuple[Identity, ...]:
    """Commands that have played, in order; none if there is no such file.

    :raises RecordingError: it cannot be read, or is another file.
    """
    if not path.exists():
        return ()
    other = RecordingError(f"{path}: is no file of identities of a campaign: remove it")
    try:
        if path.stat().st_size > MOST_BYTES:
            raise other
        table = json.loads(path.read_bytes())
        is_ours = (table["format"], table["version"]) == (FORMAT, FORMAT_VERSION)
        identities = tuple(config.build(Identity, each, str(path)) for each in table["played_by"])
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from error
    except (ConfigurationError, LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise other from error
    if not is_ours:
        raise other
    return identities


def save(path: Path, played_by: tuple[Identity, ...]) -> None:
    """:raises RecordingError: it cannot be written."""
    table = {"format": FORMAT, "version": FORMAT_VERSION, "played_by": [each.as_table() for each in played_by]}
    with replace_file(path) as file:
        file.write(f"{json.dumps(table, indent=1)}\n".encode())
