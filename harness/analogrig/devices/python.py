"""Devices of the kind ``python``: an object whose method ``step`` takes one sample."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from analogrig import config
from analogrig.datasheet import Datasheet
from analogrig.devices.child import START_TIMEOUT_S
from analogrig.devices.device import KEEPS_MEMORY, Capability, Device
from analogrig.devices.foreign_device import ForeignDescription, ForeignDevice
from analogrig.devices.foreign_host import ForeignCall, ForeignHost
from analogrig.devices.foreign_memory import MOST_MESSAGE, SLOTS
from analogrig.devices.python_object import ERRORS, LAYOUT, PythonObject
from analogrig.errors import DeviceError, DeviceRefused, TimeLimitReached
from analogrig.identity import DeviceFile
from analogrig.trust import Thing

HERE = (Exception, SystemExit, GeneratorExit)
"""Failures of an object in this process. Others may end a test or a task: pytest, asyncio and Ctrl-C."""


class PythonHost(ForeignHost):
    """A Python object in a child process."""

    layout = LAYOUT
    step_name = "step"
    what = "device"
    start_name = "the factory"

    def __init__(
        self, device: str, factory: str, stated: Mapping[str, Any], timeout_s: float, states: Sequence[int | str] = ()
    ) -> None:
        """Start the process, which imports the module.

        :param states: as for ``PythonObject``.
        :param stated: table of the data sheet as far as it is known.
        :raises ConfigurationError: the module cannot be imported, or has no such factory.
        :raises DeviceCrashed: the process ends or hangs while it imports the module.
        """
        order = {"device": device, "factory": factory, "stated": stated, "path": sys.path, "states": list(states)}
        command = [sys.executable, "-P", "-m", "analogrig.devices.python_child", json.dumps(order)]
        super().__init__(device, command, timeout_s)
        self._begun = b"", b""
        """Settings of the last record, and the reply, which hold the data sheet in use."""
        try:
            hello = self._table(self.hello())
        except BaseException:
            self.close()
            raise
        self.origin: str = hello["origin"]
        """File of the module; its name if it has none."""
        self._is_single = hello["is_single"]

    @cached_property
    def sha256(self) -> str:
        """Digest of the file of the module; empty if it has none."""
        with contextlib.suppress(OSError):
            return hashlib.sha256(Path(self.origin).read_bytes()).hexdigest()
        return ""

    def _start(self, settings: Mapping[str, Any]) -> None:
        text = json.dumps(dict(settings)).encode()
        if len(text) >= MOST_MESSAGE:
            raise DeviceRefused(f"device {self._device}: the settings are too long")
        _, reply = self.begin(text, START_TIMEOUT_S)
        if (text, reply) != self._begun:
            sheet = config.build(Datasheet, self._table(reply), f"device {self._device}: datasheet")
            self._take_sheet(sheet, settings)
            self._begun = text, reply

    def _take_sheet(self, sheet: Datasheet, settings: Mapping[str, Any]) -> None:
        """Take the data sheet of the object that begins a record with the settings."""
        facts = (sheet, dict(settings))
        if facts != getattr(self, "facts", None):
            self.lay_out(sheet.theta_n)
            self.sheet, self.facts = sheet, facts

    def _table(self, text: bytes) -> dict[str, Any]:
        """Table of a message.

        :raises ConfigurationError, DeviceError: the message is an error.
        """
        table: dict[str, Any] = json.loads(text)
        if (kind := ERRORS.get(str(table.get("error")))) is not None:
            raise kind(table["text"])
        return table


class PythonInProcess(PythonHost):
    """A Python object in this process, which it can end, stop or spoil. Its module outlives a record."""

    @property
    def is_ready(self) -> bool:
        return True

    def __init__(  # there is no process that the class above would start
        self, device: str, factory: str, stated: Mapping[str, Any], states: Sequence[int | str] = ()
    ) -> None:
        """Import the module; parameters and errors as ``PythonHost``."""
        self._use(device, self.layout.memory())
        self._object = PythonObject(device, factory, HERE, states)
        self.origin = self._object.origin
        self._stated = stated
        self._failures: list[BaseException | None] = [None] * SLOTS

    def close(self) -> None:
        """Do nothing: the module stays loaded."""

    def _start(self, settings: Mapping[str, Any]) -> None:
        self._take_sheet(self._object.begin(settings, self._stated), settings)

    def _post(self, slot: int, n: int) -> None:
        """Have the object answer, unless it has failed or the time limit has passed before."""
        failure = self._failures[slot - 1] if self._posted > self._taken + 1 else None
        if failure is None and time.monotonic() >= self._until_s:
            failure = TimeLimitReached("the time limit of the run is over")
        try:
            if failure is None:
                self._object.step(self._slots[slot], n)
        except (DeviceError, TimeLimitReached) as error:
            failure = error
        self._failures[slot] = failure

    def _await(self, call: ForeignCall) -> None:  # noqa: ARG002
        if (failure := self._failures[self._taken % SLOTS]) is not None:
            raise failure


_FACTORY = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")


@dataclass(frozen=True, kw_only=True)
class PythonDescription(ForeignDescription):
    """A Python object with a method ``step``.

    Modules of the working directory can be imported, before installed ones, as with ``python -m``.
    """

    kind: ClassVar[str] = "python"
    place_key: ClassVar[str] = "factory"
    no_place: ClassVar[str] = "device {name!r}: names no factory: pass {kind}:package.module:name"
    usage: ClassVar[str] = "python:MODULE:FACTORY[?SETTING=VALUE&...]"
    summary: ClassVar[str] = "Python object with a method step(u, y, valid)"
    state_types: ClassVar[tuple[type[int | str], ...]] = (int, str)
    in_process: bool = False
    """True: run in this process, which the object can end, stop or spoil; False: in a child process."""
    factory: str
    """Class or function that makes the object: ``package.module:name``. ``settings`` are its keyword arguments."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _FACTORY.fullmatch(self.factory):
            raise ValueError(f"factory must be package.module:name, not {self.factory!r}")

    @property
    def capabilities(self) -> frozenset[Capability]:
        here: frozenset[Capability] = frozenset({"in-process"} if self.in_process else ())
        return super().capabilities | here

    def known_datasheet(self) -> Datasheet:
        return self.datasheet.with_untold(KEEPS_MEMORY) if self.in_process else self.datasheet

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("Python module", f"{self.kind}:{self.factory}", "the device imports"),)

    def open(self) -> Device:
        return PythonDevice(self)

    def _check_files(self, device: Device, before: tuple[DeviceFile, ...]) -> None:
        """Accept any: to find the file of a module beforehand would already run its package."""


class PythonDevice(ForeignDevice[PythonHost]):
    """Python object with a method ``step`` or ``step_block`` (docs/howto/test-a-python-estimator.md)."""

    def __init__(self, description: PythonDescription) -> None:
        super().__init__(description)
        self._description: PythonDescription = description

    def load(self) -> PythonHost:
        described = self._description
        stated = described.known_datasheet().as_table()
        host: PythonHost = (
            PythonInProcess(self.name, described.factory, stated, described.states)
            if described.in_process
            else PythonHost(self.name, described.factory, stated, described.timeout_s, described.states)
        )
        self._files = (DeviceFile(self.name, host.origin, host.sha256),)
        return host

    def stated(self) -> tuple[Datasheet, Mapping[str, Any]]:
        return self._host.sheet, {}
