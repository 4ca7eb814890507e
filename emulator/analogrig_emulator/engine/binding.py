"""The compiled half of the emulator (engine/), found beside the packages and loaded on first use."""

from __future__ import annotations

import ctypes
import functools
from ctypes import POINTER, c_double, c_int, c_int64, c_uint, c_uint32, c_void_p
from pathlib import Path

from analogrig_emulator.exceptions import EngineError

# The limits of engine/engine.h.
MAX_STATES = 96
MAX_NOISE_STATES = 128
MAX_INPUTS = 24
MAX_PRODUCTS = 16
MAX_KINKS = 192
MAX_OUTPUTS = 256
MAX_UNKNOWNS = 640
MAX_FACTOR_TERMS = 16
DRIVE_TERMS = 5

_HERE = Path(__file__).parents[1]
_BUILD = "make setup"


class Counts(ctypes.Structure):
    """The C type engine_counts_t."""

    _fields_ = tuple((name, c_int64) for name in ("samples", "events", "steps", "quiet", "modes_built"))


class System(ctypes.Structure):
    """The C type engine_system_t."""

    _fields_ = tuple((name, c_void_p) for name in ("abc", "g", "cde", "w_phi", "lmn", "y_phi", "kinks", "products"))


class Schedule(ctypes.Structure):
    """The C type engine_schedule_t."""

    _fields_ = (
        ("turns", c_int64),
        ("circuit", POINTER(System)),
        ("until", c_void_p),
        ("patience", c_int64),
        ("numbers", c_void_p),
        ("row", c_int64),
        ("places", c_int64),
        ("place", c_void_p),
    )


class Noise(ctypes.Structure):
    """The C type engine_noise_t."""

    _fields_ = (("samples", c_int64), *((name, c_void_p) for name in ("phi", "factor", "reading")))


_PROTOTYPES: tuple[tuple[str, type | None, tuple[type, ...]], ...] = (
    ("engine_new", c_void_p, (c_int, c_int, c_int, c_int, c_int, c_double, c_int64)),
    ("engine_free", None, (c_void_p,)),
    ("engine_restart", None, (c_void_p,)),
    ("engine_set_system", c_int, (c_void_p, POINTER(System))),
    ("engine_get_state", None, (c_void_p, c_void_p)),
    ("engine_set_state", c_int, (c_void_p, c_void_p)),
    ("engine_run", c_int, (c_void_p, c_int64, c_int64, c_void_p, c_void_p, c_void_p, c_void_p)),
    ("engine_play", c_int, (c_void_p, c_int64, POINTER(System), c_void_p, c_int64, *(c_void_p,) * 4)),
    ("engine_play_all", c_int, (c_void_p, POINTER(Schedule), c_int64, *(c_void_p,) * 3, c_int64, *(c_void_p,) * 6)),
    ("engine_drive", c_int, (c_void_p, c_int, c_int64, c_int64, c_void_p)),
    ("engine_look_ahead", None, (c_void_p, c_int64)),
    ("engine_watch", None, (c_void_p, c_int64)),
    ("engine_get_overdue", None, (c_void_p, c_void_p)),
    ("engine_get_counts", None, (c_void_p, POINTER(Counts))),
    ("engine_solve", c_int, (c_int, c_int, c_void_p, c_void_p)),
    ("engine_noise_gather", c_int, (c_int, c_double, *(c_void_p,) * 5)),
    ("engine_noise_add", None, (c_int, c_int, c_int64, POINTER(Noise), *(c_void_p,) * 4)),
    ("engine_take", None, (c_int64, c_int, c_int64, c_void_p, c_double, *(c_void_p,) * 4)),
    ("engine_edges", None, (*(c_int64,) * 5, *(c_void_p,) * 4)),
    ("engine_see", c_int, (c_int64, c_int64, c_int, c_void_p, c_double, *(c_void_p,) * 4)),
    ("engine_seed", None, (c_int64, c_void_p, c_uint32, c_void_p)),
    ("engine_draw", None, (c_int64, c_int64, c_void_p, c_void_p)),
    ("engine_learn", None, (c_void_p, c_void_p, c_void_p)),
    ("engine_normals", None, (c_void_p, c_void_p, c_void_p, c_int64, c_int64, c_void_p, c_void_p)),
    ("engine_convert", None, (c_int64, c_int, c_void_p, c_uint, c_uint, *(c_void_p,) * 3)),
)

FAST = ("engine_seed", "engine_draw", "engine_learn", "engine_normals")
"""Functions that an engine without its fast parts (ENGINE_FAST=0) does not have."""


@functools.cache
def load() -> ctypes.CDLL:
    """The library, with its prototypes declared. Raises EngineError with the build command if it is absent."""
    paths = sorted(_HERE.glob("_engine*.so"))
    if not paths:
        raise EngineError(f"the circuit engine is not built in {_HERE}: run `pip install -e .`, or `{_BUILD}`")
    return load_from(paths[0])


def load_from(path: Path) -> ctypes.CDLL:
    """The library of this file, with its prototypes declared. Raises EngineError with the build command."""
    try:
        library = ctypes.CDLL(str(path))
    except OSError as cause:
        raise EngineError(f"the circuit engine {path} does not load ({cause}): rebuild it with `{_BUILD}`") from cause
    for name, result, arguments in _PROTOTYPES:
        if name in FAST and not hasattr(library, name):
            continue
        function = getattr(library, name)
        function.restype = result
        function.argtypes = arguments
    return library


def has_streams() -> bool:
    """True unless the library was built without its fast parts."""
    return hasattr(load(), FAST[0])
