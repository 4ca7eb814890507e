"""The device as a shared library: loading it, and its serial port in memory."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from pathlib import Path

from analogrig.catalogue import CATALOGUE_HASH, FirmwareId
from analogrig.errors import ConfigurationError, LinkError
from analogrig.links.wire import VirtualClock

LIBRARY = Path(__file__).parents[1] / "_device.so"
"""The project's own device."""

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


def load_library(library: Path, functions: Iterable[str]) -> ctypes.CDLL:
    """The library of the project's device or of a user's own, with all of ``functions``.

    :raises LinkError: the project's library was not built.
    :raises ConfigurationError: the user's library cannot be loaded, or lacks a function.
    """
    try:
        c = ctypes.CDLL(str(library))
    except OSError as error:
        if library == LIBRARY:
            raise LinkError(f"{library} cannot be loaded: run `make setup` ({error})") from error
        reason = str(error).removeprefix(f"{library}: ")
        raise ConfigurationError(f"{library}: cannot be loaded as a library of a device: {reason}") from error
    lacking = [function for function in functions if not hasattr(c, function)]
    if lacking:
        raise ConfigurationError(
            f"{library}: is no library of a device: it lacks {', '.join(lacking)}"
            " (sources to compile: harness/docs/tutorials/your-estimator.md)"
        )
    return c


class MemoryWire:
    """Wire to a device in this process: the same C code and frames as elsewhere, on a virtual clock."""

    name = "memory"

    def __init__(
        self,
        boot_nonce: int,
        *,
        catalogue_hash: int = CATALOGUE_HASH,
        clock: VirtualClock | None = None,
        input_blocks: int = ALWAYS_ROOM,
        library: Path = LIBRARY,
    ) -> None:
        """Boot a device. Another ``catalogue_hash`` stands for a device built from another catalogue.

        :raises LinkError: the project's library was not built.
        :raises ConfigurationError: the user's library is not one of a device.
        """
        c = load_library(library, ("serial_device_size", "serial_device_init", "serial_device_run"))
        c.serial_device_run.restype = ProgressStruct
        c.serial_device_size.restype = ctypes.c_size_t
        self._run = c.serial_device_run
        self._init = c.serial_device_init
        self._catalogue_hash, self._input_blocks = catalogue_hash, input_blocks
        self._device = ctypes.create_string_buffer(c.serial_device_size())
        self._output = ctypes.create_string_buffer(_OUTPUT_BYTES)
        self._answers = b""
        self.clock = VirtualClock() if clock is None else clock
        self.boot(boot_nonce)

    def boot(self, boot_nonce: int) -> None:
        """Power-cycle the device. Unread answers are lost."""
        self._answers = b""
        identity = IdentityStruct(self._catalogue_hash, boot_nonce, self._input_blocks, FirmwareId.LIBRARY)
        self._init(self._device, ctypes.byref(identity))

    def write(self, sent: bytes) -> None:
        while True:
            progress = self._run(
                self._device, sent, ctypes.c_size_t(len(sent)), self._output, ctypes.c_size_t(_OUTPUT_BYTES)
            )
            self._answers += ctypes.string_at(self._output, progress.given)
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
