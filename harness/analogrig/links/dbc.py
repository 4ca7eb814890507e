"""Message databases in the DBC format, read by cantools."""

from __future__ import annotations

import contextlib
import functools
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from analogrig import config
from analogrig.errors import ConfigurationError

__all__ = ["check_layout", "load_dbc"]
"""Names for packages beside the core."""

MAX_DBC_BYTES = 4_000_000
"""Size that cantools takes some ten seconds to parse."""

MOST_MESSAGE_BYTES = 1785
"""Longest message that a DBC may state: that of a J1939 transport session. Only those of one frame can be used."""
_MOST_SELECTORS = 65_536
"""Values of a multiplexer in one range; cantools lists them all."""

_SIZES = re.compile(r"\bBO_\s+\d+\s+\w+\s*:\s*(\d+)|\bSG_\s+\w+[\s\w]*:\s*(\d+)\s*\|\s*(\d+)")
"""Length of a message, or start and length of a signal."""
_RANGES = re.compile(r"\bSG_MUL_VAL_\s[^;]*;")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")


@contextlib.contextmanager
def silence_logger(library: str) -> Iterator[None]:
    """Suppress the log of a library, whose exception is already reported in one line."""
    logger = logging.getLogger(library)
    before = logger.level, logger.disabled
    logger.setLevel(logging.CRITICAL + 1)  # also silences child loggers
    logger.disabled = True  # the library may set the level when it is loaded later
    try:
        yield
    finally:
        logger.disabled = before[1]
        logger.setLevel(before[0])


def load_dbc(path: Path) -> Any:
    """``cantools.database.Database`` of a file. The layout of its messages is not checked: see ``check_layout``.

    :raises ConfigurationError: it cannot be read, or is not a DBC.
    """
    try:
        text = config.read_bounded(path, MAX_DBC_BYTES).decode("cp1252", "replace")  # as cantools reads files
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror or error}") from error
    try:
        _check_sizes(text)
        return _parse(text)
    except Exception as error:  # the exceptions of the parser are undocumented
        cause = " ".join(str(error).split()) or type(error).__name__
        raise ConfigurationError(f"{path}: not a DBC: {cause}") from error


@functools.lru_cache(maxsize=4)
def _parse(text: str) -> Any:
    import cantools

    with silence_logger("cantools"):
        return cantools.database.load_string(text, database_format="dbc", strict=False)


def _check_sizes(text: str) -> None:
    """:raises ValueError: a message, a signal or a multiplexer is so large that cantools would exhaust the memory."""
    for sizes in _SIZES.finditer(text):
        length, start, bits = (int(size or 0) for size in sizes.groups())
        if length > MOST_MESSAGE_BYTES or max(start, bits) > 8 * MOST_MESSAGE_BYTES:
            raise ValueError(f"{' '.join(sizes[0].split())}: longer than {MOST_MESSAGE_BYTES} bytes")
    for values in _RANGES.finditer(text):
        for first, last in _RANGE.findall(values[0]):
            if int(last) - int(first) > _MOST_SELECTORS:
                raise ValueError(f"{' '.join(values[0].split())}: more than {_MOST_SELECTORS} values")


def check_layout(message: Any) -> None:
    """Check that the signals of ``message`` fit into it and do not overlap.

    :raises ValueError: names the signals.
    """
    try:
        message.refresh(strict=True)
    except Exception as error:  # errors of cantools, and of bitstruct for impossible lengths
        raise ValueError(str(error)) from error
