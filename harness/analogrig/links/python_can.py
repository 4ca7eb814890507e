"""python-can, for all modules that use it: without asammdf, until a measurement file is written or read.

python-can imports asammdf with itself wherever it is installed, and pandas with it, which takes longer than a run.
"""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Callable
from typing import Any

_NOT_THERE: Any = None
"""What ``sys.modules`` has for a package that cannot be imported."""


def _import() -> None:
    """As if asammdf were absent; its formats look for it when they are first used, as they would have done at once."""
    sys.modules["asammdf"] = _NOT_THERE
    try:
        from can.io import mf4
    finally:
        del sys.modules["asammdf"]
    formats: Any = mf4
    kinds = {"MF4Writer": formats.MF4Writer, "MF4Reader": formats.MF4Reader}

    @functools.cache
    def look() -> None:
        """The names of asammdf go where the classes that there are look for them."""
        importlib.reload(mf4)
        vars(mf4).update(kinds)

    for kind in kinds.values():
        kind.__init__ = _after(look, kind.__init__)


def _after(look: Callable[[], None], init: Callable[..., None]) -> Callable[..., None]:
    @functools.wraps(init)
    def looking(*arguments: Any, **named: Any) -> None:
        look()
        init(*arguments, **named)

    return looking


if "can" not in sys.modules and "asammdf" not in sys.modules:
    _import()

import can  # noqa: E402 - not before
from can.interfaces import BACKENDS  # noqa: E402
from can.interfaces.slcan import slcanBus  # noqa: E402
from can.typechecking import BitTimingDict, BitTimingFdDict  # noqa: E402

__all__ = ["BACKENDS", "BitTimingDict", "BitTimingFdDict", "can", "slcanBus"]
