"""Silence for the loggers of libraries whose errors are reported in one line."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator


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
