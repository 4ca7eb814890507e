"""The device as a shared library: loading it, and its serial port in memory."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from analogrig.catalogue import CATALOGUE_HASH, FirmwareId
from analogrig.errors import ConfigurationError, LinkError
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.link import VirtualClock

LIBRARY = Path(__file__).parents[1] / "_device.so"
"""The project's own device."""

WIDE_LIBRARY = LIBRARY.with_name("_device_wide.so")
"""The same with room for plants of higher order."""

FIXED_LIBRARY = LIBRARY.with_name("_device_fixed.so")
"""The same with fixed orders, which takes fewer instructions."""

OWN_LIBRARIES = (LIBRARY, WIDE_LIBRARY, FIXED_LIBRARY)

_FIXED_ORDERS = {"na": 2, "nb": 3, "nk": 0, "nc": 0, "offset": True}
"""FIXED_ORDERS of setup.py."""

ALWAYS_ROOM = 255
"""Input blocks of a device that handles every message before the call returns: no message ever waits."""

_OUTPUT_BYTES = 65_536


class ProgressStruct(ctypes.Structure):
    """device_progress_t of estimator_c/device/device.h."""

    _fields_ = (("taken", ctypes.c_size_t), ("given", ctypes.c_size_t))


class IdentityStruct(ctypes.Structure):
    """device_identity_t of estimator_c/device/device.h."""

    _fields_ = (
        ("catalogue_hash", ctypes.c_uint32),
        ("boot_nonce", ctypes.c_uint32),
        ("input_blocks", ctypes.c_uint8),
        ("firmware_id", ctypes.c_uint8),
    )


_HOW_TO = "sources to compile: harness/docs/howto/check-a-port-of-the-estimator.md"


def load_library(library: Path, functions: Iterable[str]) -> ctypes.CDLL:
    """The library of the project's device or of a user's own, with all of ``functions``.

    :raises LinkError: the project's library was not built.
    :raises ConfigurationError: the user's library cannot be loaded, or lacks a function.
    """
    if library.exists() and not library.is_file():
        raise ConfigurationError(f"{library}: not a file")
    try:
        c = ctypes.CDLL(str(library))
    except OSError as error:
        if library in OWN_LIBRARIES:
            raise LinkError(f"{library} cannot be loaded: run `make setup` ({error})") from error
        reason = str(error).removeprefix(f"{library}: ")
        raise ConfigurationError(f"{library}: cannot be loaded as a library of a device: {reason}") from error
    lacking = [function for function in functions if not hasattr(c, function)]
    if lacking:
        raise ConfigurationError(f"{library}: is no library of a device: it lacks {', '.join(lacking)} ({_HOW_TO})")
    return c


def library_for(estimator: EstimatorConfig) -> Path:
    """The project's own device, with room for these settings."""
    return WIDE_LIBRARY if estimator.is_wide else LIBRARY


def estimator_library_for(estimator: EstimatorConfig) -> Path:
    """The fastest build of the estimator alone for these settings, whose orders are final."""
    is_fixed = all(getattr(estimator, name) == order for name, order in _FIXED_ORDERS.items())
    return FIXED_LIBRARY if is_fixed else library_for(estimator)


def unwritten(size: int) -> ctypes.Array[ctypes.c_char]:
    """Buffer of ``size`` bytes that are not zero, so that a device which relies on zeroed memory fails."""
    return ctypes.create_string_buffer(b"\xa5" * size, size)


class LibraryDevice:
    """The device in a shared library, behind its serial port or its CAN port."""

    def __init__(
        self,
        port: Literal["serial", "can"],
        *arguments: object,
        boot_nonce: int,
        catalogue_hash: int = CATALOGUE_HASH,
        input_blocks: int = ALWAYS_ROOM,
        library: Path = LIBRARY,
    ) -> None:
        """Load and boot a device; ``arguments`` go to its port.

        :param catalogue_hash: another one stands for a device built from another catalogue.
        :raises LinkError: the project's library was not built.
        :raises ConfigurationError: the user's library is not one of a device.
        """
        names = [f"{port}_device_{name}" for name in ("size", "init", "run")]
        c = load_library(library, names)
        size, init, self.run = (getattr(c, name) for name in names)
        size.restype = ctypes.c_size_t
        self.run.restype = ProgressStruct
        self.run.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t]
        self.state = unwritten(size())
        identity = IdentityStruct(catalogue_hash, boot_nonce, input_blocks, FirmwareId.LIBRARY)
        init(self.state, ctypes.byref(identity), *arguments)


class MemoryWire(LibraryDevice):
    """Wire to a device in this process: the same C code and frames as elsewhere, on a virtual clock."""

    name = "memory"

    def __init__(
        self,
        boot_nonce: int,
        *,
        catalogue_hash: int = CATALOGUE_HASH,
        clock: VirtualClock | None = None,
        library: Path = LIBRARY,
    ) -> None:
        """Boot a device; parameters and errors as ``LibraryDevice``."""
        super().__init__("serial", boot_nonce=boot_nonce, catalogue_hash=catalogue_hash, library=library)
        self._output = unwritten(_OUTPUT_BYTES)
        self._given = memoryview(self._output)
        self.clock = VirtualClock() if clock is None else clock
        self._answers = b""

    def write(self, sent: bytes) -> None:
        while True:
            progress = self.run(self.state, sent, len(sent), self._output, _OUTPUT_BYTES)
            self._answers += self._given[: progress.given]
            sent = sent[progress.taken :]
            if not progress.given and not sent:
                return

    def read(self, timeout_s: float) -> bytes:
        """All unread answers. Without any, the clock advances by the whole time-out, since none can follow."""
        answers, self._answers = self._answers, b""
        if not answers:
            self.clock.advance(timeout_s)
        return answers

    def close(self) -> None:
        """Do nothing: nothing is held."""
