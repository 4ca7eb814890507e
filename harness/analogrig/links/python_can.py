"""python-can, imported without asammdf until a measurement file is read or written.

python-can imports asammdf and thus pandas if they are installed, which takes longer than a run.
"""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Callable
from typing import Any

_ABSENT: Any = None
"""Entry of ``sys.modules`` for a package that cannot be imported."""


def _import() -> None:
    """Import python-can with asammdf hidden, and have its formats load asammdf on first use."""
    sys.modules["asammdf"] = _ABSENT
    try:
        from can.io import mf4
    finally:
        del sys.modules["asammdf"]
    formats: Any = mf4
    kinds = {"MF4Writer": formats.MF4Writer, "MF4Reader": formats.MF4Reader}

    @functools.cache
    def load() -> None:
        """Import asammdf into the module of the formats, and keep their patched classes."""
        importlib.reload(mf4)
        vars(mf4).update(kinds)

    for kind in kinds.values():
        kind.__init__ = _after(load, kind.__init__)


def _after(load: Callable[[], None], init: Callable[..., None]) -> Callable[..., None]:
    @functools.wraps(init)
    def loading(*arguments: Any, **named: Any) -> None:
        load()
        init(*arguments, **named)

    return loading


if "can" not in sys.modules and "asammdf" not in sys.modules:
    _import()

import can  # noqa: E402 - after the workaround above
from can.interfaces import BACKENDS  # noqa: E402
from can.interfaces.slcan import slcanBus  # noqa: E402
from can.typechecking import BitTimingDict, BitTimingFdDict  # noqa: E402

__all__ = ["BACKENDS", "BitTimingDict", "BitTimingFdDict", "can", "slcanBus"]
