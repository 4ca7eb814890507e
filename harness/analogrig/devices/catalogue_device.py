"""Devices that exchange our catalogue's messages: descriptions, and the device behind a link.

The device sends nothing without a request. Any other message than the expected answer is an error.
"""

from __future__ import annotations

import dataclasses
import enum
import secrets
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeGuard

import numpy as np

from analogrig.answers import Answers, Samples
from analogrig.catalogue import (
    BLOCK_SAMPLES,
    CATALOGUE_HASH,
    RUNS,
    Command,
    Configure,
    Configured,
    Control,
    Controlled,
    Counter,
    Firmware,
    FirmwareId,
    Hello,
    Identify,
    Result,
    Status,
)
from analogrig.datasheet import Datasheet
from analogrig.devices.device import Capability, Device, DeviceDescription
from analogrig.devices.exchange import Conversation, Exchange, Packing
from analogrig.devices.pace import Pace, check_line
from analogrig.errors import (
    CatalogueMismatch,
    ConfigurationError,
    DeviceError,
    DeviceRefused,
    LinkClosed,
    LinkError,
    LinkTimeout,
)
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.line import SerialLine
from analogrig.links.link import CanListener, FramedLink, Link, Wire
from analogrig.links.wire_faults import FaultyLine, FaultyWire, WireFaults
from analogrig.run import Channel

if TYPE_CHECKING:
    from analogrig.links.can_bus import CanBus

EXCHANGES = Literal["sample", "block", "stream"]
"""Ways in which samples go to a device."""


@dataclass(frozen=True, kw_only=True)
class CatalogueDescription(DeviceDescription):
    """Description of a device with our estimator's settings, behind a link that carries our catalogue's messages."""

    starting_s: ClassVar[float] = 0.0
    """Longest start-up time, added to the time-out of the handshake."""
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"window": (1, 255), "report_interval_n": (1, 65535)}
    is_in_process: ClassVar[bool] = False
    """True if the device runs in this process, on a virtual clock: time-outs cost nothing, a crash ends the process."""
    exchange: EXCHANGES = "sample"
    """Samples go one at a time, in blocks, or in blocks without waiting for the answers to earlier ones. The answers
    are the same. A line of 8-byte messages carries single samples even for ``stream``."""
    window: int = 255
    """For ``stream``: the largest number of unanswered sample messages, if the device can buffer them."""
    report_interval_n: int = 1
    """Samples between two reports of the estimate. Alarms are always reported."""
    wire_faults: str = ""
    """Faults of the line, in the notation of ``WireFaults.parse``."""
    computes: Literal["est", "own"] = "est"
    """The estimator that the device computes: that of estimator_c/core, which the shipped properties compare with the
    bundled library, or one of your own."""
    estimator: EstimatorConfig = field(default_factory=lambda: EstimatorConfig(orders="program"))

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            self.faults()
        except ConfigurationError as error:
            raise ValueError(str(error)) from error

    @property
    def capabilities(self) -> frozenset[Capability]:
        found: set[Capability] = {"configure", "faults", "identify", "pace"}
        if self.is_in_process:
            found.add("in-process")
        return frozenset(found)

    def known_datasheet(self) -> Datasheet:
        return Datasheet.of_estimator(self.estimator.as_table())

    def suited(self, poles: Sequence[complex]) -> EstimatorConfig:
        """Settings of the device for a plant with these poles: chosen by them, or those given.

        :raises ConfigurationError: the estimator has no such order.
        """
        try:
            return self.estimator.suited(poles)
        except ValueError as error:
            cure = "give the device settings of its own: [estimator]"
            where = f"device {self.name}: a program of order {len(poles)}"
            raise ConfigurationError(f"{where}: {error}; {cure}") from error

    def open(self) -> Device:
        return CatalogueDevice(self.open_link(), self)

    @property
    def is_on_can(self) -> bool:
        """True if its line is a CAN bus, False if it carries bytes."""
        return False

    def open_link(self) -> Link:
        """Start the device, or connect to it.

        :raises LinkError: it cannot be reached.
        """
        faults = self.faults()
        if self.is_on_can:
            from analogrig.links.can_link import CanLink
            from analogrig.links.faulty_bus import FaultyBus

            return CanLink(self.bus() if faults is None else FaultyBus(self.bus, faults))
        if faults is None:
            return FramedLink(self.wire(), self.serial_line())
        faulty = FaultyWire(self.wire, faults)
        return FramedLink(faulty, self.serial_line(), faulty=faulty)

    def wire(self) -> Wire:
        """Wire to the started device; errors as ``open_link``."""
        raise NotImplementedError

    def bus(self) -> CanBus:
        """Bus with the started device; errors as ``open_link``."""
        raise NotImplementedError

    def serial_line(self) -> SerialLine | None:
        """Speed of a line of bytes, if it is stated."""
        return None

    def fault_kinds(self) -> Collection[str]:
        if self.is_on_can:
            from analogrig.links.faulty_bus import FaultyBus

            return FaultyBus.KINDS
        return FaultyWire.KINDS

    def faults(self) -> WireFaults | None:
        """Faults of its line; None if there are none.

        :raises ConfigurationError: the line has no such faults.
        """
        return WireFaults.parse(self.wire_faults, self.fault_kinds()) if self.wire_faults else None


def has_our_estimator(description: DeviceDescription) -> TypeGuard[CatalogueDescription]:
    """True if the device has the settings of ``EstimatorConfig``."""
    return isinstance(description, CatalogueDescription)


_HELLO_AGAIN_S = 0.25
"""Time after which the handshake is repeated: a board that resets when its port is opened misses the first request."""


@dataclass(frozen=True)
class DeviceIdentity:
    """Identity of a device, from its answer to the handshake."""

    firmware: str
    catalogue_hash: int
    boot_nonce: int
    """Random number, new after every boot."""
    theta_max: int
    """Largest number of parameters that this build can estimate."""
    input_blocks: int
    """Number of blocks of samples that fit in its input buffer."""


class CatalogueDevice(Device):
    """Device behind a link that carries our catalogue's messages.

    Methods raise LinkError if the link fails or the device does not answer in time, and DeviceError for a wrong answer.
    Every message names the device, the expected answer and the actual one.
    """

    def __init__(self, link: Link, description: CatalogueDescription) -> None:
        """Take over ``link``. Nothing is sent yet."""
        super().__init__(description)
        self._description: CatalogueDescription = description
        self._as_opened = description.estimator
        self._talk = Conversation(link, description.name, description.timeout_s)
        self._listener: CanListener | None = None
        self._identity: DeviceIdentity | None = None
        self._run = secrets.randbelow(RUNS)
        """Id of the last run. It starts at random, to differ from that of samples still buffered in the line."""
        self._exchange: Exchange | None = None
        self._counted: Mapping[str, int] = {}
        self._line_s = 0.0

    @property
    def link_name(self) -> str:
        return self._talk.link.name

    @property
    def link_counters(self) -> dict[str, int]:
        return dict(self._talk.link.counters)

    @property
    def line_s(self) -> float:
        return self._talk.link.line_s - self._line_s

    @property
    def line(self) -> dict[str, int]:
        line, packing = self._talk.link.line, self._packing()
        rates = {} if line is None else line.rates()
        return {**rates, "samples_per_message": packing.per_message, "window": packing.window}

    @property
    def estimator(self) -> EstimatorConfig:
        """Present configuration of its estimator."""
        return self._description.estimator

    @property
    def parameters(self) -> int:
        """Number of elements of theta."""
        return self.estimator.parameters

    @property
    def faulty_line(self) -> FaultyLine[Any, Any] | None:
        return self._talk.link.faulty

    def listen(self, listener: CanListener) -> None:
        self._listener = listener
        self._talk.link.listen(listener)

    def limit(self, left_s: float) -> None:
        self._talk.limit_s = self._talk.clock() + left_s

    def description(self) -> Mapping[str, Any]:
        table = self._description.as_table()
        return table if self._identity is None else {**table, "identity": dataclasses.asdict(self._identity)}

    def close(self) -> None:
        self._talk.link.close()

    # ---------------------------------------------------------------------------------------- before and after the run

    def recover(self) -> DeviceIdentity:
        """Identify the device and reset it, in any state.

        :raises LinkTimeout: no answer came in time.
        :raises CatalogueMismatch: the device was built from another catalogue.
        :raises ConfigurationError: the line does not carry the messages of the described exchange.
        """
        if self._description.exchange == "block" and not self._talk.link.carries_blocks:
            raise ConfigurationError(
                f"device {self.name}: exchange: a block has 64 bytes, and a frame of classic CAN carries 8: set"
                " sample or stream, or use CAN FD (fd)"
            )
        try:
            self._identity = self._request_identity(anew=True, starting_s=self._description.starting_s)
        except LinkTimeout as error:
            hint = self._description.hint(self.link_name)
            raise LinkTimeout(f"{error}; {hint}" if hint else str(error)) from error
        self._control(Command.RESET)
        self._control(Command.REPORT_INTERVAL, self._description.report_interval_n)
        return self._identity

    def identity(self) -> DeviceIdentity:
        """Identify the device again.

        :raises DeviceError: it was reset since the handshake.
        """
        return self._check_boot(self._request_identity(anew=True))

    def configure(self, **settings: Any) -> None:
        """Set every field of the device's configuration, and check that each was applied.

        :raises ConfigurationError: there is no such setting, or a value is out of its range.
        :raises DeviceRefused: a field was not applied; names the field, the value sent and the value set.
        """
        self._apply(self._as_opened.changed(f"device {self.name}", settings))

    def suit(self, poles: Sequence[complex]) -> None:
        """Choose the settings by the poles of the plant, for ``prepare`` to apply; errors as ``configure``."""
        self._describe(self._description.suited(poles))

    def prepare(self, channels: Mapping[str, Channel], period_s: float) -> None:  # noqa: ARG002
        """Set the code of zero input; errors as ``configure``."""
        self._apply(dataclasses.replace(self.estimator, force_zero=channels["u"].zero))

    def _apply(self, estimator: EstimatorConfig) -> None:
        self._describe(estimator)
        for key, value in estimator.settings():
            wanted = float(np.float32(value))  # as the device holds it
            answer = self._talk.ask(Configure(self._talk.next_seq(), key, wanted), Configured)
            if answer.key != key or answer.result != Result.APPLIED or answer.value != wanted:
                cure = ""
                if estimator.is_wide:
                    cause = "the program's order needs it: " if estimator.orders == "program" else ""
                    cure = f"; {cause}compile the device with {estimator.room}, or give it a lower order in [estimator]"
                raise DeviceRefused(
                    f"device {self.name}: {key.name.lower()} = {value:g} was not applied:"
                    f" {_word(Result, answer.result)}, it has {answer.value:g}{cure}"
                )

    def _describe(self, estimator: EstimatorConfig) -> None:
        """Take settings that are to be applied. A device of this machine is started anew if they need another build."""
        described = dataclasses.replace(self._description, estimator=estimator)
        is_other = described.program != self._description.program
        self._description = described
        if is_other:
            self._talk.link.close()
            self._talk = Conversation(described.open_link(), self.name, described.timeout_s)
            self._files = described.files()
            if self._listener is not None:
                self._talk.link.listen(self._listener)
            self.recover()

    def pace(self, period_s: float) -> Pace:
        """Pace of a run in real time, with a sample every ``period_s`` on the link's clock.

        :raises ConfigurationError: the line is too slow for it.
        """
        line = self._talk.link.line
        if line is not None:
            check_line(
                line,
                period_s,
                device=self.name,
                parameters=self.parameters,
                report_interval_n=self._description.report_interval_n,
                in_blocks=self._packing().in_blocks,
            )
        return Pace(self._talk.clock, period_s)

    def start(self, pace: Pace | None = None) -> None:
        """Begin a run, whose first sample has the index 0.

        :param pace: no sample is sent before it is due; by default each is sent at once.
        :raises DeviceRefused: the device cannot start.
        """
        if pace is not None:
            pace.restart()
        self._talk.begin_run()
        self._counted = self.status()
        self._run = (self._run + 1) % RUNS
        self._control(Command.START, self._run)
        self._exchange = Exchange(
            self._talk,
            parameters=self.parameters,
            packing=self._packing(),
            run=self._run,
            report_interval_n=self._description.report_interval_n,
            check_device=self._check_device,
            pace=pace,
        )
        self._line_s = self._talk.link.line_s

    def stop(self) -> dict[str, int]:
        """End the run, and return the device's counters of this run by name.

        :raises DeviceError: the device was reset during the run.
        :raises LinkError: a message was lost, or another node sent as the device.
        """
        self._check_device()  # keeps the expected number, so a message lost or forged at the end is noticed
        self._control(Command.STOP)
        self._exchange = None
        before = self._counted  # the estimator's own counters begin with the run
        own = {counter.name.lower() for counter in Counter if counter < Counter.FRAMES_DROPPED}
        return {name: value if name in own else value - before[name] for name, value in self.status().items()}

    def _packing(self) -> Packing:
        """Packing whose samples fit in the device's input buffer, and whose answers fit in that of the line."""
        description, link = self._description, self._talk.link
        in_blocks = description.exchange != "sample" and link.carries_blocks
        window = description.window if description.exchange == "stream" else 1
        if self._identity is not None:
            window = min(window, self._identity.input_blocks)
        if link.unread_n is not None:
            # Estimates and Stepped for each sample of a message, and one Alarm, Diagnosis and Misfit.
            answers_n = (BLOCK_SAMPLES if in_blocks else 1) * (self.parameters + 2) + 3
            window = min(window, link.unread_n // answers_n)
        return Packing(in_blocks=in_blocks, window=max(1, window))

    def status(self) -> dict[str, int]:
        """The device's counters by name."""
        request = Control(self._talk.next_seq(), Command.STATUS, 0)
        deadline_s = self._talk.send(request)
        counters = {}
        for counter in Counter:
            answer = self._talk.answer(request, Status, deadline_s)
            if answer.counter != counter:
                raise DeviceError(f"device {self.name}: expected the counter {counter.name}, received {answer}")
            counters[counter.name.lower()] = answer.value
        return counters

    def _control(self, command: Command, argument: int = 0) -> None:
        answer = self._talk.ask(Control(self._talk.next_seq(), command, argument), Controlled)
        if answer.result != Result.APPLIED:
            raise DeviceRefused(f"device {self.name}: {command.name} was refused: {_word(Result, answer.result)}")

    def _check_device(self) -> None:
        """Check that the device was not reset, and that no message of it was lost."""
        try:
            self._check_boot(self._request_identity())
        except (LinkClosed, LinkTimeout):
            raise
        except LinkError:
            self.identity()  # reports a reset, the more specific cause
            raise

    def _check_boot(self, identity: DeviceIdentity) -> DeviceIdentity:
        """:raises DeviceError: the identity is not that of the handshake."""
        if self._identity is not None and identity != self._identity:
            raise DeviceError(
                f"device {self.name}: it was reset after the handshake"
                f" (boot nonce {self._identity.boot_nonce:#010x} became {identity.boot_nonce:#010x})"
            )
        return identity

    def _request_identity(self, *, anew: bool = False, starting_s: float = 0.0) -> DeviceIdentity:
        """Identity of the device, requested repeatedly until it answers.

        :param anew: skip messages that are still buffered in the line.
        """
        if anew:
            self._talk.begin()
        within_s = starting_s + self._talk.timeout_s
        deadline_s = self._talk.clock() + within_s
        while True:
            try:
                again_s = self._talk.clock() + _HELLO_AGAIN_S
                return self._ask_identity(min(deadline_s, again_s), after_anything=anew)
            except LinkTimeout as error:
                if self._talk.clock() >= deadline_s:
                    if starting_s:
                        raise LinkTimeout(f"{error}; the device had {within_s:g} s to start and answer") from error
                    raise

    def _ask_identity(self, deadline_s: float, *, after_anything: bool) -> DeviceIdentity:
        request = Identify(self._talk.next_seq())
        self._talk.send(request)
        hello = self._talk.answer(request, Hello, deadline_s, after_anything=after_anything)
        if hello.catalogue_hash != CATALOGUE_HASH:
            raise CatalogueMismatch(
                f"device {self.name}: built from catalogue {hello.catalogue_hash:#010x}, this harness"
                f" from {CATALOGUE_HASH:#010x}: build both from the same analogrig.dbc"
            )
        firmware = self._talk.answer(request, Firmware, deadline_s, after_anything=after_anything)
        return DeviceIdentity(
            firmware=_word(FirmwareId, firmware.firmware_id),
            catalogue_hash=hello.catalogue_hash,
            boot_nonce=firmware.boot_nonce,
            theta_max=hello.theta_max,
            input_blocks=firmware.input_blocks,
        )

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        """Feed blocks of samples without a pause, and yield the answers to each.

        :raises LinkTimeout: the device does not answer any more.
        :raises LinkError: the line failed, or lost a message of the device.
        :raises DeviceError: an answer is not the expected one, or the device was reset.
        :raises ValueError: arrays differ in length, samples have been fed before, or no run has been started.
        :raises TimeLimitReached: after yielding all answers that came in time, those of the last block in part.
        """
        if self._exchange is None:
            raise ValueError("no run has been started")
        return self._exchange.play(blocks)


def _word(kind: type[enum.IntEnum], value: int) -> str:
    """Name of a value, or its number if it has no name."""
    return kind(value).name if value in kind.__members__.values() else f"number {value}"
