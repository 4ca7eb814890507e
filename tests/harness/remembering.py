"""Python estimators that count samples in a place which outlives an object."""

from __future__ import annotations

import builtins
import contextlib
import decimal
import functools
import itertools
import locale
import os
import random
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

GLOBAL = [0]
DRAWS = itertools.count()
TICKS: list[int] = []


class Counts:
    """Returns the count before each sample as its statistic."""

    datasheet: ClassVar[dict[str, Any]] = {"statistic": True}

    def __init__(self, count: Callable[[], float]) -> None:
        self._count = count

    def step(self, u: int, y: int, valid: bool) -> dict[str, Any]:  # noqa: ARG002, FBT001
        return {"alarm": False, "statistic": float(self._count())}


def _global() -> int:
    GLOBAL[0] += 1
    return GLOBAL[0] - 1


def _default(seen: list[int] = []) -> int:  # noqa: B006 - this is the place
    seen.append(0)
    return len(seen) - 1


@functools.cache
def _cached() -> list[int]:
    return []


def _cache() -> int:
    _cached().append(0)
    return len(_cached()) - 1


def _attribute() -> int:
    before: int = getattr(Counts, "counted", 0)
    Counts.counted = before + 1  # type: ignore[attr-defined]
    return before


def _builtin() -> int:
    before: int = getattr(builtins, "analogrig_counted", 0)
    builtins.analogrig_counted = before + 1  # type: ignore[attr-defined]
    return before


def _environment() -> int:
    before = int(os.environ.get("ANALOGRIG_TEST_COUNT", "0"))
    os.environ["ANALOGRIG_TEST_COUNT"] = str(before + 1)
    return before


def _folder() -> bool:
    is_root = os.getcwd() == "/"  # noqa: PTH109
    os.chdir("/")
    return is_root


def _path() -> int:
    sys.path.append("/nowhere")
    return sys.path.count("/nowhere") - 1


def _decimals() -> int:
    decimal.getcontext().prec += 1
    return decimal.getcontext().prec


def _locale() -> bool:
    before = locale.setlocale(locale.LC_NUMERIC)
    with contextlib.suppress(locale.Error):
        locale.setlocale(locale.LC_NUMERIC, "C.UTF-8" if before == "C" else before)
    return before != "C"


def _filters() -> int:
    warnings.simplefilter("ignore", append=True)
    return len(warnings.filters)


def _thread() -> int:
    before = len(TICKS)
    thread = threading.Thread(target=TICKS.append, args=(0,))
    thread.start()
    thread.join()
    return before


def _file() -> int:
    if not hasattr(_file, "file"):
        _file.file = tempfile.TemporaryFile()  # type: ignore[attr-defined]  # noqa: SIM115
    return int(_file.file.write(b".")) * int(_file.file.tell()) - 1  # type: ignore[attr-defined]


random.seed(1)
np.random.seed(1)  # noqa: NPY002

PLACES: dict[str, Callable[[], float]] = {
    "global": _global,
    "default argument": _default,
    "cache": _cache,
    "attribute of a class": _attribute,
    "builtins": _builtin,
    "environment": _environment,
    "working directory": _folder,
    "import path": _path,
    "decimal context": _decimals,
    "locale": _locale,
    "filters of warnings": _filters,
    "thread": _thread,
    "offset of a file": _file,
    "iterator of the module": lambda: next(DRAWS),
    "random of Python": random.random,
    "random of numpy": lambda: float(np.random.random()),  # noqa: NPY002
}


def make(place: str) -> Counts:
    """Estimator that counts in the place."""
    return Counts(PLACES[place])
