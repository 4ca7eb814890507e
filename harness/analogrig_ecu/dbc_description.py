"""Messages of a device on a CAN bus that a DBC describes: tables of its device file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from analogrig.answers import AlarmIs
from analogrig.devices import Datasheet, DeviceDescription
from analogrig.devices.device import Stated
from analogrig.run import MAX_CODES, Channel
from analogrig_ecu.ecu_checksum import ChecksumSpec

Units = tuple[float, float] | Literal["codes", "volts", "physical"]
"""Value of a signal by the code of a sample: (scale, offset) of code * scale + offset; the code itself; the volts at
the rig; or the physical quantity of the rig's channel."""


@dataclass(frozen=True, kw_only=True)
class SampleUnits:
    """Units in which the samples travel, before the scaling in the DBC."""

    u: Units = "codes"
    y: Units = "codes"


@dataclass(frozen=True, kw_only=True)
class SentSignals:
    """Signals that carry a sample to the device, each as ``Message.Signal``."""

    u: str
    """Input of the plant."""
    y: str
    """Output of the plant."""
    valid: str = ""
    """1, or 0 for a missing sample. Without this signal, missing samples are not sent."""
    counter: tuple[str, ...] = ()
    """Index of the sample within the record, modulo the range of the signal."""
    order: tuple[str, ...] = ()
    """Messages in the order of their transmission; by default as the signals above name them."""
    constant: Mapping[str, float] = field(default_factory=dict)
    """Values of other signals, such as multiplexers. The rest have their start value in the DBC, or 0."""
    checksum: Mapping[str, ChecksumSpec] = field(default_factory=dict)
    """Checksums, at most one in a message, by their signals."""
    units: SampleUnits = field(default_factory=SampleUnits)
    codes: int = 4096
    """Number of codes of the rig's channels, against which the ranges of ``u`` and ``y`` are checked."""

    def __post_init__(self) -> None:
        if not 2 <= self.codes <= MAX_CODES:
            raise ValueError(f"codes must be 2 to {MAX_CODES}, not {self.codes}")


@dataclass(frozen=True, kw_only=True)
class ReceivedSignals:
    """Signals of the device's answer to a sample, each as ``Message.Signal``."""

    alarm: str = ""
    """Nonzero for an alarm."""
    alarm_is: AlarmIs = "event"
    """The same as ``alarm_is`` of the device. States are numbers, or names of values in the DBC."""
    armed: str = ""
    """Nonzero while the trigger is armed."""
    statistic: str = ""
    innovation: str = ""
    theta: tuple[str, ...] = ()
    counter: tuple[str, ...] = ()
    """Counters of the answer's messages, at most one each."""
    counter_is: Literal["echo", "own"] = "echo"
    """The counter of the sample that is answered, or the device's own count of the message."""
    events: tuple[str, ...] = ()
    """Messages that come only with something to report, such as an alarm. An answer is complete without them."""
    checksum: Mapping[str, ChecksumSpec] = field(default_factory=dict)
    """Checksums of the answers by their signals. A frame with a wrong one is not used."""
    complete: str = ""
    """Message that ends an answer; by default the last of the signals above does."""

    def quantities(self) -> Iterator[tuple[str, str]]:
        """Key and signal of each quantity, in the order of the keys."""
        for key in ("alarm", "armed", "statistic", "innovation"):
            if name := getattr(self, key):
                yield key, name
        yield from (("theta", name) for name in self.theta)


@dataclass(frozen=True, kw_only=True)
class Request:
    """Constant frame to the device."""

    message: str
    signals: Mapping[str, float] = field(default_factory=dict)
    """Values of its signals, by their names in the message."""
    answer: str = ""
    """Message that the device answers within the time-out; by default none is awaited."""
    answered: Mapping[str, float] = field(default_factory=dict)
    """Values of signals of the answer; another answer is passed over."""


@dataclass(frozen=True, kw_only=True)
class DbcDescription(Stated, DeviceDescription):
    """Device with messages of its own, which a DBC describes."""

    state_types: ClassVar[tuple[type[int | str], ...]] = (int, str)
    fd: bool
    data_bitrate: int | None
    dbc: str
    """DBC file, relative to the device file."""
    send: SentSignals
    receive: ReceivedSignals
    start: Request | None = None
    """Frame that begins a record: the device forgets all samples."""
    reset: Request | None = None
    """Frame that brings the device to a defined state when it is opened."""

    def __post_init__(self) -> None:
        alarm_is = self.alarm_is if self.receive.alarm_is == "event" else self.receive.alarm_is
        object.__setattr__(self, "alarm_is", alarm_is)
        object.__setattr__(self, "receive", dataclasses.replace(self.receive, alarm_is=alarm_is))
        super().__post_init__()
        self.known_datasheet()

    def known_datasheet(self) -> Datasheet:
        received = self.receive
        return dataclasses.replace(
            self.datasheet,
            theta_n=len(received.theta),
            innovation=bool(received.innovation),
            statistic=bool(received.statistic),
            armed=bool(received.armed),
            alarms=bool(received.alarm),
            cannot_tell=tuple(dict.fromkeys((*self.datasheet.cannot_tell, *self._untold()))),
        )

    def _untold(self) -> Iterator[str]:
        """Faults that these messages leave unnoticed."""
        received = self.receive
        if not received.checksum:
            yield "a changed value in a frame"
        yield "the direction in which a frame of an unanswered sample was lost"
        if not self.start:
            yield "an estimator that keeps its state from the record before"
        if not self.send.valid:
            yield "a missing sample, in a log"
        if not self.send.counter:
            yield "a sample that the device takes twice, or not at all, and answers once"
        if received.counter and received.counter_is == "echo":
            yield "an answer that is late by a whole cycle of its counter"
        elif not received.counter:
            yield "a lost answer together with a repeated one"
        if received.events:
            yield "a lost event, and by one sample the instant of an event that comes after its answer"


def scale(units: Units, channel: Channel | None) -> tuple[float, float] | None:
    """Scale and offset of the value of a code; None if they depend on a channel that is not known."""
    if units == "codes":
        return 1.0, 0.0
    if isinstance(units, tuple):
        return units
    if channel is None:
        return None
    unit_per_v = channel.unit_per_v if units == "physical" else 1.0
    return channel.lsb_v * unit_per_v, channel.low_v * unit_per_v
