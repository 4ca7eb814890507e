"""The device under test: handshake, configuration, samples in and estimates out.

The device never speaks without being asked, so every exchange is a question and its answers, and what is not as it
should be is an error, never a guess.
"""

from __future__ import annotations

import dataclasses
import enum
import secrets
import struct
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.devices.devices import DeviceDescription, recorded, trusted
from analogrig.errors import (
    CatalogueMismatch,
    ConfigurationError,
    DeviceError,
    DeviceRefused,
    LinkClosed,
    LinkError,
    LinkTimeout,
    TimeLimitReached,
)
from analogrig.identity import DeviceFile
from analogrig.links.link import CanListener, Link
from analogrig.protocol.catalogue import (
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
from analogrig.protocol.conversation import Conversation
from analogrig.protocol.estimator_config import EstimatorConfig
from analogrig.protocol.exchange import Exchange, Packing, RaisedAlarm, Replies, most_answers
from analogrig.protocol.pace import Pace, check_line
from analogrig.trust import Trust

_HELLO_AGAIN_S = 0.25
"""A board that resets when its port is opened does not hear the first call."""


@dataclass(frozen=True)
class Identity:
    """Who a device says it is."""

    firmware: str
    catalogue_hash: int
    boot_nonce: int
    """Another number after every boot."""
    theta_max: int
    """The most parameters that this build can estimate."""
    input_blocks: int
    """So many blocks of samples can wait in its input."""


__all__ = ["Dut", "Identity", "RaisedAlarm", "Replies", "Stretch", "connect", "open_dut", "reopen_dut"]

Stretch = tuple[int, NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_]]
"""Index of the first sample, force, displacement, missing."""


class Dut:
    """Device under test behind a link: configured by ``configure``, fed by ``Bench.play``, a context manager.

    Methods raise LinkError if the link fails or the device does not answer in time, and DeviceError for a wrong answer.
    Every message names the device, the expected answer and the actual one.
    """

    def __init__(self, link: Link, description: DeviceDescription) -> None:
        """Take over ``link``; nothing is sent yet."""
        self._description = description
        self._talk = Conversation(link, description.name, description.timeout_s)
        self._identity: Identity | None = None
        self._run = secrets.randbelow(RUNS)
        """Id of the last run: samples that the line has kept since an earlier connection have hardly the next one."""
        self._exchange: Exchange | None = None
        self._counted: Mapping[str, int] = {}
        self._line_s = 0.0

    @property
    def name(self) -> str:
        return self._description.name

    @property
    def link_name(self) -> str:
        return self._talk.link.name

    @property
    def link_counters(self) -> dict[str, int]:
        """What the line has shown since it was opened that was no message of the device, by name."""
        return dict(self._talk.link.counters)

    @property
    def line_s(self) -> float:
        """How long a line of the described speed would have taken for the samples; 0.0: none is described."""
        return self._talk.link.line_s - self._line_s

    @property
    def line(self) -> dict[str, int]:
        """How samples go: its bit rates (``Line.rates``), as far as they are known; ``samples_per_message`` and
        ``window``, the most messages that may be unanswered."""
        line, packing = self._talk.link.line, self._packing()
        rates = {} if line is None else line.rates()
        return {**rates, "samples_per_message": packing.per_message, "window": packing.window}

    def limit(self, left_s: float) -> None:
        """Wait no longer than ``left_s`` from now, whatever is asked; ``math.inf`` removes the limit.

        After that, every method that waits for the device raises ``TimeLimitReached``.
        """
        self._talk.limit_s = self._talk.clock() + left_s

    @property
    def estimator(self) -> EstimatorConfig:
        """How its estimator is configured."""
        return self._description.estimator

    @property
    def parameters(self) -> int:
        """Elements of theta."""
        return self._description.estimator.parameters

    def description(self) -> Mapping[str, Any]:
        """Description and identity in plain values, for the record."""
        table = self._description.as_table()
        return table if self._identity is None else {**table, "identity": dataclasses.asdict(self._identity)}

    def files(self) -> tuple[DeviceFile, ...]:
        """Library, program or firmware that it runs on this machine, if it does."""
        program = self._description.program
        return () if program is None else (DeviceFile.of(self.name, program),)

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
        :raises ConfigurationError: the line does not carry the messages of the described exchange.
        """
        if self._description.exchange == "block" and not self._talk.link.carries_blocks:
            raise ConfigurationError(
                f"device {self.name}: exchange: a block has 64 bytes, which a frame of classic CAN does not carry: say"
                " sample or stream, or use CAN FD (fd)"
            )
        self._identity = self._identify(starting_s=self._description.starting_s)
        self._control(Command.RESET)
        self._control(Command.REPORT_INTERVAL, self._description.report_interval_n)
        return self._identity

    def identity(self) -> Identity:
        """Ask again who is there.

        :raises DeviceError: not who answered the handshake: it was reset meanwhile.
        """
        return self._same(self._identify())

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

    def pace(self, period_s: float) -> Pace:
        """For a run with a sample every ``period_s``, on the clock of the line.

        :raises ConfigurationError: that does not fit the line.
        """
        line = self._talk.link.line
        if line is not None:
            check_line(self._description, line, period_s, in_blocks=self._packing().in_blocks)
        return Pace(self._talk.clock, period_s)

    def start(self, pace: Pace | None = None) -> None:
        """Begin a run; its first sample has the index 0. With a ``pace`` none is sent before it is due.

        :raises DeviceRefused: the device cannot.
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
            is_there=self._is_there,
            pace=pace,
        )
        self._line_s = self._talk.link.line_s

    def stop(self) -> dict[str, int]:
        """End the run and return the device's counters by name, as far as they have counted in this run.

        :raises DeviceError: the device was reset during the run.
        :raises LinkError: a message was lost, or somebody else spoke as the device.
        """
        self._is_there()  # without forgetting what was heard: who spoke as the device is found out by the next message
        self._control(Command.STOP)
        self._exchange = None
        return {name: value - self._before_run(name) for name, value in self.status().items()}

    def _before_run(self, counter: str) -> int:
        """What it had counted when the run began; the estimator's own begin with the run."""
        return 0 if Counter[counter.upper()] < Counter.FRAMES_DROPPED else self._counted[counter]

    def _packing(self) -> Packing:
        """No more is on its way than the device can hold, nor on its way back than the line can."""
        description, link = self._description, self._talk.link
        in_blocks = description.exchange != "sample" and link.carries_blocks
        window = description.window if description.exchange == "stream" else 1
        if self._identity is not None:
            window = min(window, self._identity.input_blocks)
        if link.unread_n is not None:
            window = min(window, link.unread_n // most_answers(in_blocks, self.parameters))
        return Packing(in_blocks=in_blocks, window=max(1, window))

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

    def _control(self, command: Command, argument: int = 0) -> None:
        answer = self._talk.ask(Control(self._talk.next_seq(), command, argument), Controlled)
        if answer.result != Result.APPLIED:
            raise DeviceRefused(f"device {self.name}: {command.name} was refused: {_word(Result, answer.result)}")

    def _is_there(self) -> None:
        """That the device is who it was, and has said nothing that was not heard."""
        try:
            self._same(self._call())
        except (LinkClosed, LinkTimeout):
            raise
        except LinkError:
            self.identity()  # if it was reset, that is why
            raise

    def _same(self, identity: Identity) -> Identity:
        if self._identity is not None and identity != self._identity:
            raise DeviceError(
                f"device {self.name}: it was reset after the handshake"
                f" (boot nonce {self._identity.boot_nonce:#010x} became {identity.boot_nonce:#010x})"
            )
        return identity

    def _identify(self, *, starting_s: float = 0.0) -> Identity:
        """Whatever is in the line from before."""
        self._talk.begin()
        return self._call(after_anything=True, starting_s=starting_s)

    def _call(self, *, after_anything: bool = False, starting_s: float = 0.0) -> Identity:
        """Ask who is there until there is an answer; what came before the first question does not matter."""
        within_s = starting_s + self._talk.timeout_s
        deadline_s = self._talk.clock() + within_s
        while True:
            try:
                again_s = self._talk.clock() + _HELLO_AGAIN_S
                return self._ask_identity(min(deadline_s, again_s), after_anything=after_anything)
            except LinkTimeout as error:
                if self._talk.clock() >= deadline_s:
                    if starting_s:
                        raise LinkTimeout(f"{error}; it had {within_s:g} s to start and answer") from error
                    raise

    def _ask_identity(self, deadline_s: float, *, after_anything: bool) -> Identity:
        request = Identify(self._talk.next_seq())
        self._talk.send(request)
        hello = self._talk.answer(request, Hello, deadline_s, after_anything=after_anything)
        if hello.catalogue_hash != CATALOGUE_HASH:
            raise CatalogueMismatch(
                f"device {self.name}: it speaks catalogue {hello.catalogue_hash:#010x}, this harness"
                f" {CATALOGUE_HASH:#010x}: build both from the same analogrig.dbc"
            )
        firmware = self._talk.answer(request, Firmware, deadline_s, after_anything=after_anything)
        return Identity(
            firmware=_word(FirmwareId, firmware.firmware_id),
            catalogue_hash=hello.catalogue_hash,
            boot_nonce=firmware.boot_nonce,
            theta_max=hello.theta_max,
            input_blocks=firmware.input_blocks,
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

        :raises LinkTimeout: the device answers no more.
        :raises LinkError: the line failed, or lost a message of the device.
        :raises DeviceError: an answer is not the one that was due, or the device was reset.
        :raises ValueError: the arrays differ in length, or the samples have been fed before.
        """
        (replies,) = self.play([(first_index, force, displacement, missing)])
        return replies

    def play(self, stretches: Iterable[Stretch]) -> Iterator[Replies]:
        """As ``feed`` for one stretch of samples after the other, without a pause between them.

        :raises TimeLimitReached: after the answers to all samples that were answered in time, the last stretch in part.
        """
        exchange = self._running()
        waiting: deque[tuple[int, int]] = deque()
        try:
            for first, force, displacement, missing in stretches:
                waiting.append((len(force), first + len(force)))
                exchange.enter(first, force, displacement, missing)
                while waiting and exchange.ready >= waiting[0][0]:
                    yield exchange.take(*waiting.popleft())
            exchange.finish()
        except TimeLimitReached:
            yield from _answered(exchange, waiting)
            raise
        yield from _answered(exchange, waiting)

    def _running(self) -> Exchange:
        """:raises ValueError: there is no run."""
        if self._exchange is None:
            raise ValueError("no run has been started")
        return self._exchange


def _answered(exchange: Exchange, waiting: Iterable[tuple[int, int]]) -> Iterator[Replies]:
    """Answers to stretches (samples, end), the last one in part if not all of its samples were answered."""
    for n, end in waiting:
        answered = min(n, exchange.ready)
        yield exchange.take(answered, end - n + answered)


def open_dut(
    name: str, *, allow: Trust | Iterable[str] = (), listener: CanListener | None = None, **changes: Any
) -> Dut:
    """Open a device by name: connected, configured and ready to start. Use it in a ``with`` statement.

    :param name: ``host``, ``inproc[:LIBRARY]``, ``qemu-m4[:ELF]``, ``serial:URL``, ``can:INTERFACE/CHANNEL``, a shipped
        name or a .toml file; ``?key=value`` appended to a name overrides fields of the description.
    :param allow: libraries, firmware, ports and buses that a file may name (``analogrig.trust``).
    :param listener: receives every frame of a CAN bus from its opening on.
    :param changes: override fields of the description; None leaves a field as described.
    :raises ConfigurationError: no such device, its description is wrong, or a file names what is not allowed.
    :raises LinkError: the device cannot be reached.
    :raises DeviceError: it refuses the configuration, or was built from another catalogue.
    """
    return connect(_changed(trusted(name, Trust.of(allow)), changes), listener)


def reopen_dut(
    description: Mapping[str, Any],
    file: str,
    *,
    allow: Trust | Iterable[str] = (),
    listener: CanListener | None = None,
    **changes: Any,
) -> Dut:
    """A device as in a record of ``Dut.description()`` that ``file`` holds; parameters and errors as ``open_dut``."""
    described = recorded(description).placed(Path(file).parent)
    Trust.of(allow).check(described.things, file)
    return connect(_changed(described, changes), listener)


def _changed(description: DeviceDescription, changes: Mapping[str, Any]) -> DeviceDescription:
    """:raises ConfigurationError: a value is out of range, or such a device has none."""
    wanted = {key: value for key, value in changes.items() if value is not None}
    for key in wanted.keys() - {each.name for each in dataclasses.fields(description)}:
        raise ConfigurationError(f"device {description.name}: a device of the kind {description.kind} has no {key}")
    try:
        return dataclasses.replace(description, **wanted)
    except ValueError as error:
        raise ConfigurationError(f"device {description.name}: {error}") from error


def connect(description: DeviceDescription, listener: CanListener | None = None) -> Dut:
    """Reach the device, shake hands, configure it; errors as ``open_dut``."""
    link = description.open()
    if listener is not None:
        link.listen(listener)
    dut = Dut(link, description)
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
        hint = description.hint(dut.link_name)
        if not hint:
            raise
        raise LinkTimeout(f"{error}; {hint}") from error


def _float32(value: float) -> float:
    """The nearest number that the device can hold."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def _word(kind: type[enum.IntEnum], value: int) -> str:
    """The name of a value, or its number if it has none."""
    return kind(value).name if value in kind.__members__.values() else f"number {value}"
