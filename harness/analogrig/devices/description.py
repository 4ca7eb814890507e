"""Description of a device: the base class of all kinds."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self
from urllib.parse import unquote

from analogrig import config
from analogrig.datasheet import Datasheet
from analogrig.errors import ConfigurationError, DeviceError
from analogrig.identity import DeviceFile
from analogrig.trust import Thing

if TYPE_CHECKING:
    from analogrig.devices.device import Device
    from analogrig.links.link import CanListener

LONGEST_TIMEOUT_S = 3600.0

MOST_LOST = 2**31

Capability = Literal["blocks", "configure", "faults", "identify", "in-process", "pace", "snapshot"]
"""Capability of a device beyond taking samples and raising alarms:

``blocks``      ``direct`` opens it without messages, with the same answers
``configure``   settings can be changed by name
``faults``      faults can be injected into its line
``identify``    it can tell whether it was reset
``in-process``  it runs in this process: a time-out costs no time, a crash ends the process
``pace``        samples can be sent in real time
``snapshot``    the state of its estimator can be saved and restored
"""


@dataclass(frozen=True, kw_only=True)
class DeviceDescription:
    """Description of a device: a table of a device file. Each kind is a subclass that ``registry.KINDS`` names."""

    kind: ClassVar[str]
    usage: ClassVar[str]
    """Name on the command line, with its parameters."""
    summary: ClassVar[str]
    """One line for `analogrig list`."""
    collects: ClassVar[str] = ""
    """Field that collects the keys of a name that are no fields; empty: they are refused."""
    name: str
    description: str = ""
    """One line for people."""
    most_lost_n: int = 0
    """Largest number of samples lost on the way to the device. Beyond it the run is INCONCLUSIVE."""
    timeout_s: float = 10.0
    """Time-out of all answers to one message."""

    def __post_init__(self) -> None:
        if not 0.0 < self.timeout_s <= LONGEST_TIMEOUT_S:
            raise ValueError(f"timeout_s must be more than 0 and at most {LONGEST_TIMEOUT_S:g}, not {self.timeout_s:g}")
        if not 0 <= self.most_lost_n <= MOST_LOST:
            raise ValueError(f"most_lost_n must be 0 to {MOST_LOST}, not {self.most_lost_n}")

    @classmethod
    def from_name(cls, name: str, rest: str) -> Self:
        """Device with the command-line name ``name``; ``rest`` is its part after the kind and the colon.

        :raises ConfigurationError: ``rest`` is not a place and KEY=VALUE pairs of this kind.
        """
        place, _, query = rest.partition("?")
        table = {"name": name, **cls._place(name, place)}
        for key, text in _pairs(name, query):
            if key in table:
                raise ConfigurationError(f"{name}: {key} is given twice")
            table[key] = _value(cls, key, text)
        return config.build(cls, cls._group_options(table), name)

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """:raises ConfigurationError: ``place`` is a colon alone, which would read as the default."""
        if place == ":":
            raise ConfigurationError(
                f"device {name!r}: nothing follows the colon: pass {cls.kind} for the default, or {cls.kind}:WHICH"
            )

    @classmethod
    def _group_options(cls, table: dict[str, Any]) -> dict[str, Any]:
        """The table with every key at its place in the description."""
        if not cls.collects:
            return table
        names = {field.name for field in dataclasses.fields(cls)}
        own = {key: value for key, value in table.items() if key in names}
        return {cls.collects: {key: value for key, value in table.items() if key not in own}, **own}

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:
        """Fields given by the part of a name between the colon and the question mark."""
        if place:
            raise ConfigurationError(f"{name}: a device of the kind {cls.kind} has no {place!r}")
        return {}

    @property
    def capabilities(self) -> frozenset[Capability]:
        """Capabilities of the device."""
        return frozenset()

    def known_datasheet(self) -> Datasheet:
        """Data sheet, as far as it is known before the device is opened."""
        return Datasheet()

    def open(self) -> Device:
        """Start the device, or connect to it. Nothing is sent yet.

        :raises LinkError: it cannot be reached.
        """
        raise NotImplementedError

    def connect(self, listener: CanListener | None = None) -> Device:
        """Open the device, bring it to a defined state and configure it; ready for ``Bench.play``.

        :param listener: receives every frame of a CAN bus from its opening on.
        :raises LinkError: it cannot be reached.
        :raises DeviceError: it refuses its configuration, or is not the device described.
        """
        files = self.files()
        device = self.open()
        try:
            if listener is not None:
                device.listen(listener)
            self._check_files(device, files)
            device.recover()
            device.configure()
        except BaseException:
            device.close()
            raise
        return device

    def _check_files(self, device: Device, before: tuple[DeviceFile, ...]) -> None:
        """:raises DeviceError: a file of the device is not the one before it was opened."""
        if device.files() != before:
            raise DeviceError(f"device {self.name}: its file was replaced while it was loaded: start again")

    def direct(self, *, alarms_only: bool = False) -> Device:  # noqa: ARG002
        """Device of the capability ``blocks`` without messages: its answers are those of ``connect`` to the bit.

        :param alarms_only: omit the estimates if that is faster.
        :raises ConfigurationError: the estimator refuses its configuration.
        :raises LinkError, DeviceError: as ``connect``.
        """
        return self.connect()

    def hint(self, link_name: str) -> str:  # noqa: ARG002
        """Advice for a device that has never answered on the link of that name; may be empty."""
        return ""

    def fault_kinds(self) -> Collection[str]:
        """Kinds of faults that its line can have; none without the capability ``faults``."""
        return ()

    @property
    def program(self) -> Path | None:
        """File with the device's code on this machine; None for a device elsewhere."""
        return None

    def files(self) -> tuple[DeviceFile, ...]:
        """Library, program or firmware that the device runs on this machine, if any."""
        return () if self.program is None else (DeviceFile.of(self.name, self.program),)

    @property
    def things(self) -> tuple[Thing, ...]:
        """Things outside analogrig that opening the device would load, run or connect to."""
        return ()

    def placed(self, folder: Path) -> Self:  # noqa: ARG002
        """The same device with its paths, relative to ``folder``, made absolute."""
        return self

    @property
    def only_one(self) -> str:
        """Name of the port or bus that two processes cannot share; empty if each can start a device of its own."""
        return ""

    @property
    def is_private(self) -> bool:
        """True if only this process reaches the device: it is an object at the other end of a virtual bus."""
        return False

    def as_table(self) -> dict[str, Any]:
        """Plain values; ``registry.from_table`` is the inverse."""
        table = {"kind": self.kind, **dataclasses.asdict(self)}
        return {key: value for key, value in table.items() if value is not None}


def _pairs(name: str, query: str) -> list[tuple[str, str]]:
    """KEY=VALUE pairs separated by ampersands, with percent escapes decoded.

    :raises ConfigurationError: a word is not KEY=VALUE.
    """
    words = [word.partition("=") for word in query.split("&") if word]
    for key, equals, value in words:
        if not (key and equals):
            raise ConfigurationError(f"{name}: {key + equals + value!r} is not KEY=VALUE")
    return [(unquote(key), unquote(value)) for key, _, value in words]


def _value(cls: type[DeviceDescription], key: str, text: str) -> Any:
    """Text as a number or truth value where possible, as python-can reads it. Text fields of ``cls`` stay text."""
    if isinstance(getattr(cls, key, None), str):
        return text
    is_flag = isinstance(getattr(cls, key, None), bool)
    if text.lower() in {"true", "false"} or (is_flag and text in {"1", "0"}):
        return text.lower() in {"true", "1"}
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return text
