"""Files that are either whole or not there."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from analogrig.errors import RecordingError

__all__ = ["replace_file"]
"""Names for packages beside the core."""


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write to that takes the place of ``path`` when the block ends well; folders are made as needed.

    :raises RecordingError: it cannot be written; whatever stood at ``path`` before still does.
    """
    if not path.name or (path.exists() and not path.is_file()):  # replaced by a file, /dev/null would serve nobody
        raise RecordingError(f"{path}: cannot be written: it is a folder, or no regular file")
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                yield file
            partial.replace(path)
        finally:
            with contextlib.suppress(OSError):
                partial.unlink()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error
