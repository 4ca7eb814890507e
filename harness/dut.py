"""The device under test: handshake, configuration, samples in and estimates out, and how each kind is opened.

The device never speaks without being asked, so every exchange is a question and its answers. It is lock-step: nothing
is sent before the answers to the last message are complete, and what is not as it should be is an error, never a guess.
"""

from __future__ import annotations

import dataclasses
import enum
import secrets
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from harness import config
from harness.catalogue import (
    BLOCK_SAMPLES,
    CATALOGUE_HASH,
    Alarm,
    Change,
    Command,
    Configure,
    Configured,
    Control,
    Controlled,
    Counter,
    Diagnosis,
    Element,
    Estimate,
    Firmware,
    FirmwareId,
    Hello,
    Identify,
    Message,
    Result,
    Sample,
    SampleBlock,
    SampleFlag,
    Status,
    Stepped,
)
from harness.conversation import Conversation
from harness.errors import (
    CatalogueMismatch,
    ConfigurationError,
    DeviceError,
    DeviceRefused,
    LinkClosed,
    LinkTimeout,
)
from harness.estimator_config import EstimatorConfig
from harness.host_process import HostProcess
from harness.link import DEFAULT_BAUD, Clock, Link, MemoryLink, SerialLink

DEFAULT_TIMEOUT_S = 2.0
LONGEST_TIMEOUT_S = 3600.0
MOST_BAUD = 100_000_000

_HELLO_AGAIN_S = 0.25
"""A board that resets when its port is opened does not hear the first call."""

_INDEX = 65536
"""Sample indices are modulo this on the line."""


@dataclass(frozen=True)
class Identity:
    """Who a device says it is."""

    firmware: str
    catalogue_hash: int
    boot_nonce: int
    """Another number after every boot."""
    theta_max: int
    """The most parameters that this build can estimate."""


@dataclass(frozen=True)
class RaisedAlarm:
    """An alarm of the device."""

    index: int
    """The sample, counted from the start, not modulo anything."""
    kind: int
    """The trigger that raised it."""
    statistic: float


@dataclass(frozen=True)
class StatedDiagnosis:
    """What the device says has changed."""

    index: int
    """The sample after which it was said; this and ``onset`` are counted from the start, not modulo anything."""
    change: int
    """As Change of the catalogue."""
    onset: int
    """The likeliest sample of the change; that of the alarm if several parameters have changed."""
    extent: float
    """Of the parameter, new over old; 1 if several have changed."""


@dataclass(frozen=True, eq=False)
class Replies:
    """What the device said to n samples; p parameters."""

    theta: NDArray[np.float32]
    """(n, p): the estimate after each sample, in the order of est.h, in codes."""
    innovation: NDArray[np.float32]
    """(n,) codes"""
    statistic: NDArray[np.float32]
    """(n,): of the trigger."""
    flags: NDArray[np.uint8]
    """(n,): SteppedFlag."""
    alarms: tuple[RaisedAlarm, ...]
    diagnoses: tuple[StatedDiagnosis, ...]


@dataclass(frozen=True)
class DeviceDescription:
    """A file of fixtures/devices, or as much as the command line says."""

    name: str
    kind: Literal["host", "inproc", "serial"]
    """host: a process of this computer on a pseudo-terminal. inproc: within this process. serial: at ``url``."""
    url: str | None = None
    """Anything pyserial can open."""
    baud: int = DEFAULT_BAUD
    exchange: Literal["sample", "block"] = "sample"
    """Whether samples go one at a time or in blocks. The answers are the same; blocks are faster."""
    timeout_s: float = DEFAULT_TIMEOUT_S
    """For the answers to one message."""
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)

    def __post_init__(self) -> None:
        if (self.kind == "serial") != (self.url is not None):
            raise ValueError("a url goes with the kind 'serial', and with no other")
        if not 0 < self.baud <= MOST_BAUD:
            raise ValueError(f"baud must be 1 to {MOST_BAUD}, not {self.baud}")
        if not 0.0 < self.timeout_s <= LONGEST_TIMEOUT_S:
            raise ValueError(f"timeout_s must be more than 0 and at most {LONGEST_TIMEOUT_S:g}, not {self.timeout_s:g}")

    def as_table(self) -> dict[str, Any]:
        """In plain values, from which the same can be made."""
        table = dataclasses.asdict(self) | {"estimator": self.estimator.as_table()}
        return {key: value for key, value in table.items() if value is not None}


class Dut:
    """A device behind a link. Every error names the device, what was expected and what came instead."""

    def __init__(self, link: Link, description: DeviceDescription, clock: Clock = time.monotonic) -> None:
        """Take over ``link``; nothing is sent yet."""
        self._description = description
        self._talk = Conversation(link, description.name, description.timeout_s, clock)
        self._identity: Identity | None = None
        self._next_index = 0

    @property
    def name(self) -> str:
        return self._description.name

    @property
    def link_name(self) -> str:
        return self._talk.link.name

    @property
    def parameters(self) -> int:
        """Elements of theta."""
        return self._description.estimator.parameters

    def description(self) -> Mapping[str, Any]:
        """Description and identity in plain values, for the record."""
        table = self._description.as_table()
        return table if self._identity is None else {**table, "identity": dataclasses.asdict(self._identity)}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the device; one that was started for this is ended."""
        self._talk.link.close()

    # ---------------------------------------------------------------------------------------- before and after the run

    def handshake(self) -> Identity:
        """Find out who is there, whatever it was doing, and reset it to a known state.

        :raises LinkTimeout: nobody answers.
        :raises CatalogueMismatch: it speaks another catalogue.
        """
        deadline_s = self._talk.clock() + self._talk.timeout_s
        while self._identity is None:
            try:
                self._identity = self._identify(min(deadline_s, self._talk.clock() + _HELLO_AGAIN_S))
            except LinkTimeout:
                if self._talk.clock() >= deadline_s:
                    raise
        self._control(Command.RESET)
        return self._identity

    def identity(self) -> Identity:
        """Ask again who is there.

        :raises DeviceError: not who answered the handshake: it was reset meanwhile.
        """
        identity = self._identify(self._talk.clock() + self._talk.timeout_s)
        if self._identity is not None and identity != self._identity:
            raise DeviceError(
                f"device {self.name}: it was reset after the handshake"
                f" (boot nonce {self._identity.boot_nonce:#010x} became {identity.boot_nonce:#010x})"
            )
        return identity

    def configure(self, estimator: EstimatorConfig | None = None) -> None:
        """Set every field of the device's configuration, by default as described, and make sure that it took it.

        :raises DeviceRefused: it did not; names the key, what was wanted and what is set.
        """
        if estimator is not None:
            self._description = dataclasses.replace(self._description, estimator=estimator)
        for key, value in self._description.estimator.settings():
            wanted = _float32(value)
            answer = self._talk.ask(Configure(self._talk.next_seq(), key, wanted), Configured)
            if answer.key != key or answer.result != Result.APPLIED or answer.value != wanted:
                raise DeviceRefused(
                    f"device {self.name}: {key.name.lower()} = {value:g} was not applied:"
                    f" {_word(Result, answer.result)}, it has {answer.value:g}"
                )

    def set_force_zero(self, code: float) -> None:
        """Tell the device which code of the force is none; errors as ``configure``."""
        self.configure(dataclasses.replace(self._description.estimator, force_zero=code))

    def start(self) -> None:
        """Begin a run; its first sample has the index 0.

        :raises DeviceRefused: the device cannot.
        """
        self._control(Command.START)
        self._next_index = 0

    def stop(self) -> dict[str, int]:
        """End the run and return the device's counters by name.

        :raises DeviceError: the device was reset during the run.
        """
        self.identity()
        self._control(Command.STOP)
        return self.status()

    def status(self) -> dict[str, int]:
        """The device's counters by name."""
        request = Control(self._talk.next_seq(), Command.STATUS, 0)
        deadline_s = self._talk.send(request)
        counters = {}
        for counter in Counter:
            answer = self._talk.answer(request, Status, deadline_s)
            if answer.counter != counter:
                raise DeviceError(f"device {self.name}: the counter {counter.name} was due, {answer} came")
            counters[counter.name.lower()] = answer.value
        return counters

    def _control(self, command: Command) -> None:
        answer = self._talk.ask(Control(self._talk.next_seq(), command, 0), Controlled)
        if answer.result != Result.APPLIED:
            raise DeviceRefused(f"device {self.name}: {command.name} was refused: {_word(Result, answer.result)}")

    def _identify(self, deadline_s: float) -> Identity:
        self._talk.begin()
        request = Identify(self._talk.next_seq())
        self._talk.send(request)
        hello = self._talk.answer(request, Hello, deadline_s)
        if hello.catalogue_hash != CATALOGUE_HASH:
            raise CatalogueMismatch(
                f"device {self.name}: it speaks catalogue {hello.catalogue_hash:#010x}, this harness"
                f" {CATALOGUE_HASH:#010x}: build both from the same analogrig.dbc"
            )
        firmware = self._talk.answer(request, Firmware, deadline_s)
        return Identity(
            firmware=_word(FirmwareId, firmware.firmware_id),
            catalogue_hash=hello.catalogue_hash,
            boot_nonce=firmware.boot_nonce,
            theta_max=hello.theta_max,
        )

    # --------------------------------------------------------------------------------------------------------- samples

    def feed(
        self,
        first_index: int,
        force: NDArray[np.uint16],
        displacement: NDArray[np.uint16],
        missing: NDArray[np.bool_],
    ) -> Replies:
        """Enter n consecutive samples (codes) and collect the answers to each; all arrays are (n,).

        Indices that were skipped since the last call are missing samples to the device.

        :raises LinkTimeout: an answer is lacking.
        :raises LinkError: the line failed, or lost a message of the device.
        :raises DeviceError: an answer is not the one that was due, or the device was reset.
        :raises ValueError: the arrays differ in length, or the samples have been fed before.
        """
        if first_index < self._next_index:
            raise ValueError(f"sample {first_index} comes again: the next one is {self._next_index}")
        samples = list(zip(force.tolist(), displacement.tolist(), missing.tolist(), strict=True))
        per_message = 1 if self._description.exchange == "sample" else BLOCK_SAMPLES
        collected = _Collected((*range(self.parameters), Element.INNOVATION))
        for start in range(0, len(samples), per_message):
            self._exchange(first_index + start, samples[start : start + per_message], collected)
        self._next_index = first_index + len(samples)
        return collected.replies()

    def _exchange(self, first: int, samples: Sequence[_Codes], collected: _Collected) -> None:
        """One message of samples and all its answers."""
        index = first
        try:
            deadline_s = self._talk.send(self._message(first, samples))
            for index in range(first, first + len(samples)):
                if not self._collect(index, deadline_s, collected):
                    raise self._silence(index)
        except LinkClosed as error:
            place = f"after sample {index - 1}" if index > 0 else "before the first sample"
            raise LinkClosed(f"{error} {place}") from error

    def _message(self, first: int, samples: Sequence[_Codes]) -> Message:
        seq = self._talk.next_seq()
        if self._description.exchange == "sample":
            force, displacement, missing = samples[0]
            return Sample(seq, SampleFlag.MISSING if missing else 0, first % _INDEX, force, displacement)
        mask = sum(1 << i for i, (_, _, missing) in enumerate(samples) if missing)
        codes = [code for force, displacement, _ in samples for code in (force, displacement)]
        codes += [0] * (2 * BLOCK_SAMPLES - len(codes))
        return SampleBlock(seq, len(samples), first % _INDEX, mask, tuple(codes))

    def _collect(self, index: int, deadline_s: float, collected: _Collected) -> bool:
        """All answers to one sample: alarm and diagnosis if any, theta, the innovation, Stepped. False: too late."""
        wire_index = index % _INDEX
        elements = iter(collected.elements)
        due = next(elements, None)
        while (message := self._talk.receive(deadline_s)) is not None:
            if isinstance(message, Estimate) and message.element == due and message.sample_index == wire_index:
                collected.values.append(message.value)
                due = next(elements, None)
            elif isinstance(message, Stepped) and due is None and message.sample_index == wire_index:
                collected.flags.append(message.flags)
                collected.statistics.append(message.statistic)
                return True
            elif isinstance(message, Alarm) and message.sample_index == wire_index:
                collected.alarms.append(RaisedAlarm(index, message.trigger, message.statistic))
            elif isinstance(message, Diagnosis) and message.change in _SAID:
                onset = index - (index - message.onset_index) % _INDEX
                collected.diagnoses.append(StatedDiagnosis(index, message.change, onset, message.extent))
            else:
                wanted = "Stepped" if due is None else f"Estimate of {_word(Element, due)}"
                raise DeviceError(f"device {self.name}: {wanted} for sample {index} was due, {message} came")
        return False

    def _silence(self, index: int) -> DeviceError | LinkTimeout:
        """Why there is no answer to sample ``index``: ask the device, if it still speaks."""
        heard = (
            f"device {self.name}: no estimate for sample {index} within {self._talk.timeout_s:g} s"
            f" (last message: {self._talk.last})"
        )
        try:
            self.identity()
            dropped = self.status()["frames_dropped"]
        except DeviceError as error:
            return error
        except LinkTimeout:
            return LinkTimeout(f"{heard}; it answers nothing else either")
        return LinkTimeout(f"{heard}; it is alive and has dropped {dropped} damaged frames")


_SAID = frozenset(Change) - {Change.UNDECIDED}

_Codes = tuple[int, int, bool]
"""Force, displacement, and whether they are missing."""


@dataclass
class _Collected:
    """Answers as they come; in plain lists, since numpy takes as long for one number as for a hundred."""

    elements: Sequence[int]
    """What is due for each sample, in this order."""
    values: list[float] = field(default_factory=list)
    statistics: list[float] = field(default_factory=list)
    flags: list[int] = field(default_factory=list)
    alarms: list[RaisedAlarm] = field(default_factory=list)
    diagnoses: list[StatedDiagnosis] = field(default_factory=list)

    def replies(self) -> Replies:
        values = np.array(self.values, dtype=np.float32).reshape(len(self.flags), len(self.elements))
        return Replies(
            theta=values[:, :-1],
            innovation=values[:, -1],
            statistic=np.array(self.statistics, dtype=np.float32),
            flags=np.array(self.flags, dtype=np.uint8),
            alarms=tuple(self.alarms),
            diagnoses=tuple(self.diagnoses),
        )


def open_dut(name: str) -> Dut:
    """A shipped or own description by name, ``inproc``, or ``serial:URL``; connected, configured, ready to start.

    :raises ConfigurationError: there is none, or it is wrong.
    :raises LinkError: the device cannot be reached.
    :raises DeviceError: it refuses the configuration, or was built from another catalogue.
    """
    kind, _, url = name.partition(":")
    if kind == "serial" and url:
        return connect(DeviceDescription(name=name, kind="serial", url=url))
    if name == "inproc":
        return connect(DeviceDescription(name="inproc", kind="inproc"))
    path = config.locate("devices", name)
    return connect(config.build(DeviceDescription, {"name": path.stem, **config.read_toml(path)}, str(path)))


def reopen_dut(description: Mapping[str, Any]) -> Dut:
    """A device as in a record of ``Dut.description()``; errors as ``open_dut``.

    What a file names is not opened on its word alone: a device at a URL must be named again.
    """
    table = {key: value for key, value in description.items() if key != "identity"}
    recorded = config.build(DeviceDescription, table, "the recorded device")
    if recorded.kind == "serial":
        raise ConfigurationError(
            f"the recorded device was at {recorded.url}: say --dut serial:{recorded.url}, or another"
        )
    return connect(recorded)


def connect(description: DeviceDescription) -> Dut:
    """Reach the device, shake hands, configure it; errors as ``open_dut``."""
    dut = Dut(_link(description), description)
    try:
        _handshake(dut, description)
        dut.configure()
    except BaseException:
        dut.close()
        raise
    return dut


def _handshake(dut: Dut, description: DeviceDescription) -> None:
    try:
        dut.handshake()
    except LinkTimeout as error:
        if description.kind != "serial":
            raise
        raise LinkTimeout(f"{error}; the line was opened at {description.baud} baud") from error


def _link(description: DeviceDescription) -> Link:
    if description.kind == "host":
        return HostProcess()
    if description.kind == "inproc":
        return MemoryLink(boot_nonce=secrets.randbits(32))
    return SerialLink(str(description.url), description.baud)


def _float32(value: float) -> float:
    """The nearest number that the device can hold."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def _word(kind: type[enum.IntEnum], value: int) -> str:
    """The name of a value, or its number if it has none."""
    return kind(value).name if value in kind.__members__.values() else f"number {value}"
