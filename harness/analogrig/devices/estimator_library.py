"""Devices of the kind ``library``: an estimator in a shared library with the interface of analogrig_estimator.h."""

from __future__ import annotations

import dataclasses
import enum
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from analogrig.datasheet import MOST_THETA, Datasheet
from analogrig.devices.child import PROGRAMS
from analogrig.devices.device import Device
from analogrig.devices.foreign_device import ForeignDescription, ForeignDevice
from analogrig.devices.foreign_host import ForeignCall, ForeignHost
from analogrig.devices.foreign_memory import MOST_MESSAGE, SharedLayout
from analogrig.errors import ConfigurationError, DeviceError, DeviceRefused
from analogrig.trust import Thing, absolute_path
from analogrig.wording import one_line

PROGRAM = PROGRAMS / "analogrig-library"

ABI = 1
"""ANALOGRIG_ABI."""

MOST_STATE_BYTES = 1 << 28

_MOST_SETTINGS = 256
"""SETTINGS_MAX of library_child.c."""

_LAYOUT = SharedLayout(np.dtype([("u", "<f4"), ("y", "<f4"), ("valid", "<u4")]))
"""Samples are analogrig_in_t."""

_HELLO = struct.Struct("=IIQI1024sI")


class Reports(enum.IntFlag):
    """Flags of analogrig_about_t.reports."""

    STATISTIC = 1
    INNOVATION = 2
    ARMED = 4


class About(NamedTuple):
    """Facts that a library states about itself: analogrig_about_t."""

    abi: int
    theta_n: int
    state_bytes: int
    reports: int
    name: str
    """Name and version; any characters."""


class LibraryHost(ForeignHost):
    """A library of analogrig_estimator.h in a child process."""

    layout = _LAYOUT
    step_name = "analogrig_step"
    what = "library"
    start_name = "analogrig_init"

    def __init__(self, device: str, library: Path, timeout_s: float) -> None:
        """Start the process, which loads the library.

        :raises ConfigurationError: the file is no library of analogrig_estimator.h.
        :raises DeviceCrashed: the library crashes or hangs while it is loaded.
        :raises LinkError: analogrig-library was not built.
        """
        super().__init__(device, [PROGRAM, library], timeout_s)
        try:
            self.about = self.facts = self._read_about(library)
            self.lay_out(self.about.theta_n)
        except BaseException:
            self.close()
            raise

    def _read_about(self, library: Path) -> About:
        hello, where = self.hello(), f"device {self._device}: {library}"
        if len(hello) != _HELLO.size:
            text = hello.decode(errors="replace").removeprefix(f"{library}: ")
            raise ConfigurationError(f"{where}: is no library of an estimator: {text}")
        abi, theta_n, state_bytes, reports, name, is_single = _HELLO.unpack(hello)
        self._is_single = bool(is_single)
        about = About(abi, theta_n, state_bytes, reports, name.rstrip(b"\0").decode(errors="replace"))
        if abi != ABI:
            built = f"was built for ABI {abi} of analogrig_estimator.h, and this analogrig has {ABI}"
            raise ConfigurationError(f"{where}: {built}: compile it again")
        limits = (("theta_n", MOST_THETA), ("state_bytes", MOST_STATE_BYTES), ("reports", sum(Reports)))
        for key, most in limits:
            if (value := getattr(about, key)) > most:
                raise ConfigurationError(f"{where}: analogrig_about gives {key} = {value}, and the largest is {most}")
        return about

    def overrun(self, call: ForeignCall, what: str) -> DeviceError:
        size = f", which has state_bytes = {self.about.state_bytes}" if what == "its state" else ""
        return super().overrun(call, f"{what}{size}")

    def _start(self, settings: Mapping[str, float]) -> None:
        words = b"".join(f"{name}={float(value).hex()}\0".encode() for name, value in settings.items())
        if len(settings) > _MOST_SETTINGS or len(words) >= MOST_MESSAGE:
            raise DeviceRefused(f"device {self._device}: the settings are more than {_MOST_SETTINGS}, or too long")
        result, _ = self.begin(words, self._timeout_s)
        if 0 < result <= len(settings):
            name, value = list(settings.items())[result - 1]
            raise DeviceRefused(f"device {self._device}: the library refuses the setting {name} = {value:g}")
        if result:
            raise DeviceError(f"device {self._device}: cannot start: analogrig_init returned {result}")


@dataclass(frozen=True, kw_only=True)
class EstimatorLibrary(ForeignDescription):
    """An estimator of your own in a shared library. `analogrig include` prints the folder of its header."""

    kind: ClassVar[str] = "library"
    place_key: ClassVar[str] = "library"
    no_place: ClassVar[str] = "device {name!r}: names no library: use {kind}:./my_estimator.so"
    usage: ClassVar[str] = "library:FILE.so[?SETTING=VALUE&...]"
    summary: ClassVar[str] = "estimator of your own in a shared library with three functions"
    state_types: ClassVar[tuple[type[int | str], ...]] = (int,)
    library: str
    """Shared library."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.library:
            raise ValueError("library must name a shared library, such as ./my_estimator.so")
        for name, value in self.settings.items():
            if not name.isidentifier():
                raise ValueError(f"settings: {name!r} is no name of a setting: use letters, digits and _")
            if isinstance(value, str) or not math.isfinite(value):
                raise ValueError(f"settings: {name} must be a finite number, not {value!r}")

    def open(self) -> Device:
        return EstimatorLibraryDevice(self)

    def direct(self, *, alarms_only: bool = False) -> Device:
        device = EstimatorLibraryDevice(self, alarms_only=alarms_only)
        try:
            device.recover()
            device.configure()
        except BaseException:
            device.close()
            raise
        return device

    @property
    def program(self) -> Path:
        return Path(self.library).absolute()

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("library", self.library, "the device loads the library"),)

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, library=absolute_path(self.library, folder))


class EstimatorLibraryDevice(ForeignDevice[LibraryHost]):
    """Estimator in a shared library."""

    reports_states = True

    def __init__(self, description: EstimatorLibrary, *, alarms_only: bool = False) -> None:
        """Nothing is loaded yet: ``recover`` does so.

        :param alarms_only: omit the estimates: theta has no columns.
        """
        super().__init__(description)
        self._description: EstimatorLibrary = description
        self._alarms_only = alarms_only

    def load(self) -> LibraryHost:
        described = self._description
        if not described.program.is_file():
            raise ConfigurationError(f"device {self.name}: there is no file {described.library}")
        return LibraryHost(self.name, described.program, described.timeout_s)

    def numbers(self) -> Mapping[str, float]:
        return {name: float(value) for name, value in self._description.settings.items()}

    def recover(self) -> None:
        if self._description.files() != self._files:
            self.close()
            raise DeviceError(f"device {self.name}: its file was replaced since it was opened: start again")
        super().recover()

    def stated(self) -> tuple[Datasheet, Mapping[str, Any]]:
        about = self._host.about
        try:
            sheet = dataclasses.replace(
                self._description.known_datasheet(),
                **({"theta_n": 0, "model": None} if self._alarms_only else {"theta_n": about.theta_n}),
                statistic=bool(about.reports & Reports.STATISTIC),
                innovation=bool(about.reports & Reports.INNOVATION),
                armed=bool(about.reports & Reports.ARMED),
            )
        except ValueError as error:
            raise ConfigurationError(f"device {self.name}: datasheet: {error}") from error
        return sheet, {"identity": {"firmware": one_line(about.name)}}
