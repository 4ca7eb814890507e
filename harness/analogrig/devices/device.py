"""Interface of every kind of device: its description, which a device file states, and the device that it opens."""

from __future__ import annotations

import contextlib
import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self
from urllib.parse import unquote

from analogrig import config
from analogrig.answers import AlarmIs, Answers, Samples
from analogrig.datasheet import Datasheet
from analogrig.devices.pace import Pace
from analogrig.errors import ConfigurationError, DeviceError, DeviceRefused
from analogrig.estimator_config import EstimatorConfig
from analogrig.identity import DeviceFile
from analogrig.links.line import CanLine, SerialLine
from analogrig.run import Channel
from analogrig.trust import Thing
from analogrig.wording import number_of

if TYPE_CHECKING:
    import can

    from analogrig.devices.captured import CaptureDecoding
    from analogrig.links.link import CanListener
    from analogrig.links.wire_faults import FaultyLine

__all__ = ["KEEPS_MEMORY", "MOST_TIMEOUTS", "Causes", "Stated"]
"""Names for packages beside the core."""

KEEPS_MEMORY = "a state left from before the record"
"""Entry of ``Datasheet.cannot_tell`` of a device whose memory outlives a record."""

LONGEST_TIMEOUT_S = 3600.0

MOST_LOST = 2**31

MOST_TIMEOUTS = 10
"""Time-outs after which a run is given up."""

MOST_BAUD = 100_000_000
MOST_BITRATE = 20_000_000

Capability = Literal["blocks", "configure", "faults", "identify", "in-process", "pace"]
"""Capability of a device beyond taking samples and raising alarms:

``blocks``      ``direct`` opens it without messages, with the same answers
``configure``   settings can be changed by name
``faults``      faults can be injected into its line
``identify``    it can tell whether it was reset
``in-process``  it runs in this process: a time-out costs no time, a crash ends the process
``pace``        samples can be sent in real time
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
    place_key: ClassVar[str] = ""
    """Field that the part of a name after the colon sets; empty: there is no such part."""
    no_place: ClassVar[str] = ""
    """Error for a name without that part, with {name} and {kind}; empty: the field has a default."""
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"most_lost_n": (0, MOST_LOST)}
    """Least and largest value of numbers, by their fields. Those of base classes hold as well."""
    state_types: ClassVar[tuple[type[int | str], ...]] = ()
    """Types of the states that ``alarm_is`` may name; none if the alarm is true or false."""
    decodes_logs: ClassVar[bool] = False
    """True if ``log_decoder`` reads CAN logs with messages of the device's own."""
    name: str
    description: str = ""
    """One line for people."""
    most_lost_n: int = 0
    """Largest number of samples lost on the way to the device. Beyond it the run is INCONCLUSIVE."""
    timeout_s: float = 10.0
    """Time-out of all answers to one message."""
    alarm_is: AlarmIs = "event"
    """``event``: every answer with an alarm is one. ``level``: the device holds its alarm, and only the first of a row
    is one. An array of states, such as ["FAULT", 3]: those that stand for an alarm, of which the first of a row is
    one."""

    def __post_init__(self) -> None:
        if not 0.0 < self.timeout_s <= LONGEST_TIMEOUT_S:
            raise ValueError(f"timeout_s must be more than 0 and at most {LONGEST_TIMEOUT_S:g}, not {self.timeout_s:g}")
        if self.alarm_is == ():
            raise ValueError('alarm_is must be "event", "level", or an array of the states that stand for an alarm')
        if unknown := [state for state in self.states if type(state) not in self.state_types]:
            known = " or ".join({int: "numbers", str: "words"}[each] for each in self.state_types)
            cure = f"its states are {known}" if known else 'its alarm is true or false: use "level"'
            raise ValueError(f"alarm_is: a device of the kind {self.kind} has no state {unknown[0]!r}: {cure}")
        if getattr(self, "settings", None) and "configure" not in self.capabilities:
            raise ValueError(f"settings: a device of the kind {self.kind} has none")
        for kind in type(self).__mro__:
            for name, (low, high) in vars(kind).get("ranges", {}).items():
                if (value := getattr(self, name)) is not None and not low <= value <= high:
                    raise ValueError(f"{name} must be {low:.10g} to {high:.10g}, not {value:.10g}")

    @classmethod
    def from_name(cls, name: str, rest: str) -> Self:
        """Device with the command-line name ``name``; ``rest`` is its part after the kind.

        :raises ConfigurationError: ``rest`` is not a colon, a place and KEY=VALUE pairs of this kind.
        """
        place, _, query = rest.partition("?")
        if place == ":" and not cls.no_place:
            raise ConfigurationError(
                f"device {name!r}: nothing follows the colon: pass {cls.kind} for the default, or {cls.kind}:WHICH"
            )
        place, query = cls._split_query(name, place.removeprefix(":"), query)
        table = {"name": name, **cls._place(name, place)}
        for word in filter(None, query.split("&")):
            key, equals, text = word.partition("=")
            if not (key and equals):
                raise ConfigurationError(f"{name}: {word!r} is not KEY=VALUE")
            if (key := unquote(key)) in table:
                raise ConfigurationError(f"{name}: {key} is given twice")
            table[key] = _value(cls, key, unquote(text))
        if cls.collects:
            names = {field.name for field in dataclasses.fields(cls)}
            others = {key: table.pop(key) for key in list(table) if key not in names}
            table[cls.collects] = others
        return config.build(cls, table, name)

    @classmethod
    def _split_query(cls, name: str, place: str, query: str) -> tuple[str, str]:  # noqa: ARG003
        """Place with those KEY=VALUE pairs that belong to it, and the others."""
        return place, query

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:
        """Fields given by the part of a name between the colon and the question mark."""
        if place and not cls.place_key:
            raise ConfigurationError(f"{name}: a device of the kind {cls.kind} has no {place!r}")
        if not place and cls.no_place:
            raise ConfigurationError(cls.no_place.format(name=name, kind=cls.kind))
        return {cls.place_key: place} if place else {}

    @property
    def states(self) -> tuple[int | str, ...]:
        """States that stand for an alarm; empty if the alarm is a number, which is an alarm unless it is 0."""
        return self.alarm_is if isinstance(self.alarm_is, tuple) else ()

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

    def log_decoder(
        self,
        channels: Mapping[str, Channel],  # noqa: ARG002
        frames: Iterable[can.Message],  # noqa: ARG002
        *,
        most_n: int,  # noqa: ARG002
    ) -> CaptureDecoding:
        """Decode a CAN log with messages of the device's own. Nothing is opened.

        :param channels: scales of ``u`` and ``y``.
        :param most_n: largest number of samples in a run; another run begins after it.
        :raises ConfigurationError: the description does not fit its DBC, or this kind of device has no such messages.
        """
        raise ConfigurationError(f"device {self.name}: a device of the kind {self.kind} has no messages of its own")

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
        tables = {key: value.as_table() for key in table if hasattr(value := getattr(self, key), "as_table")}
        return {key: value for key, value in (table | tables).items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class Stated:
    """Figures of a device that its owner states."""

    datasheet: Datasheet = field(default_factory=Datasheet)
    """Figures that the owner states. What the device itself reports replaces them when it is opened."""
    settings: Mapping[str, bool | int | float | str] = field(default_factory=dict)
    """Settings of its estimator by name, if the kind has the capability ``configure``."""
    estimator: EstimatorConfig | None = None
    """Configuration of est.c that the device runs, by its owner's claim. ``analogrig replay --compare`` and a shipped
    property check the claim against the bundled library."""

    def known_datasheet(self) -> Datasheet:
        """Data sheet, as far as it is known before the device is opened."""
        return self.datasheet


@dataclass(frozen=True, kw_only=True)
class SerialRate:
    """Speed of a line of bytes."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"baud": (1, MOST_BAUD)}
    baud: int | None = None
    """Baud rate of the line [bit/s]. If there is no real line, the run reports the time that this one would take."""

    def serial_line(self) -> SerialLine | None:
        """Speed of the line, if it is stated."""
        return None if self.baud is None else SerialLine(self.baud)


@dataclass(frozen=True, kw_only=True)
class CanRates:
    """Bit rates of a CAN bus."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = dict.fromkeys(("bitrate", "data_bitrate"), (1, MOST_BITRATE))
    bitrate: int | None = None
    """Bit rate of the bus [bit/s]. If there is no real bus, the run reports the time that this one would take."""
    data_bitrate: int | None = None
    """Bit rate of the data phase of CAN FD [bit/s]; None if it is ``bitrate``."""
    fd: bool = False
    """True if bus and device support CAN FD, whose frames carry up to 64 bytes."""

    def check_rates(self) -> None:
        """:raises ValueError: the rates do not go together."""
        if self.data_bitrate is not None and not (self.fd and self.bitrate is not None):
            raise ValueError("data_bitrate is for CAN FD: set fd = true and bitrate as well")

    def can_line(self) -> CanLine | None:
        """Bit rates, if they are stated."""
        return None if self.bitrate is None else CanLine(self.bitrate, self.data_bitrate)


@dataclass(frozen=True, kw_only=True)
class AdaptedDescription(Stated, DeviceDescription):
    """Description of a device with a protocol of its own."""


_MOST_CAUSES = 200
"""Causes that are kept; a hostile sender must not fill the memory."""


@dataclass
class _Cause:
    noun: str
    loses: bool
    place: str
    detail: str
    n: int = 0


class Causes:
    """Tally of causes in the order of their first occurrence.

    Each text names a cause without the values that vary: those of its first occurrence are its detail.
    """

    def __init__(self) -> None:
        self.place: Callable[[], str] = str
        """Function that returns the place of the current frame: ``frame 12 at 3.500000 s``, ``sample 12``."""
        self._found: dict[str, _Cause] = {}
        self._facts: dict[str, tuple[str, bool]] = {}

    def add(
        self, text: str, *, noun: str = "frame", place: str = "", detail: str = "", loses: bool = False, n: int = 1
    ) -> None:
        """Count occurrences of a cause; ``loses`` if frames or samples were lost by it."""
        if text not in self._found:
            if len(self._found) >= _MOST_CAUSES:
                return
            self._found[text] = _Cause(noun, loses, place or self.place(), detail)
        self._found[text].n += n

    def state(self, key: str, text: str, *, loses: bool) -> None:
        """Set the sentence of a finding on the whole traffic, which replaces an earlier one with this key."""
        self._facts[key] = text, loses

    @property
    def losses(self) -> tuple[str, ...]:
        """Sentences on causes that lost frames or samples; findings on the whole traffic come first."""
        return self._sentences(loses=True)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on the others."""
        return self._sentences(loses=False)

    def _sentences(self, *, loses: bool) -> tuple[str, ...]:
        sentences = [text for text, it_loses in self._facts.values() if it_loses == loses]
        for text, cause in self._found.items():
            if cause.loses == loses:
                place = cause.place if cause.n == 1 else f"{number_of(cause.n, cause.noun)} from {cause.place} on"
                sentences.append(f"{text} ({place}{': ' if cause.detail else ''}{cause.detail})")
        return tuple(sentences)


class Device(ABC):
    """Device under test, fed by ``Bench.play``; a context manager.

    ``start``, ``play`` and ``recover`` make a device. The other members have defaults, which suit a device without a
    line, without settings and without counters. Callers ask ``datasheet`` for what it reports and its description for
    its ``capabilities``, never for its class. Every method may raise LinkError (the device cannot be reached, or does
    not answer in time) or DeviceError (it answers wrongly). The error names the device and, in ``play``, the sample.
    """

    def __init__(self, description: DeviceDescription) -> None:
        self._description = description
        self._files = description.files()
        self.causes = Causes()
        """Causes of lost samples and of unused frames since it was opened."""

    @property
    def name(self) -> str:
        """Name on the command line or in its file. It begins every error message."""
        return self._description.name

    @property
    def datasheet(self) -> Datasheet:
        """Quantities that it reports and figures that are stated about it; final once ``recover`` has returned."""
        return self._description.known_datasheet()

    def description(self) -> Mapping[str, Any]:
        """Description in plain values, for the record; the device can be opened from it again (``recorded``)."""
        return {**self._description.as_table(), "datasheet": self.datasheet.as_table()}

    @property
    def holds_alarms(self) -> bool:
        """True if its alarm is a level or a state: only the first alarm of a row is one."""
        return self._description.alarm_is != "event"

    def files(self) -> tuple[DeviceFile, ...]:
        """Library, program or firmware that the device runs on this machine, if any, as it was when it was loaded."""
        return self._files

    # ----------------------------------------------------------------------------------------------------- before a run

    @abstractmethod
    def recover(self) -> object:
        """Bring the device to a defined state, from any state; nothing from before can reach the next run.

        A child process that has failed is started anew.
        """

    def configure(self, **settings: Any) -> None:
        """Set the described settings, with ``settings`` instead of those of the same names, for the next runs.

        :raises DeviceRefused: a setting was not applied; names it. A device without the capability ``configure``
            refuses every setting.
        """
        if settings:
            raise DeviceRefused(f"device {self.name}: has no setting {next(iter(settings))}")

    def suit(self, poles: Sequence[complex]) -> None:  # noqa: B027 - few devices model the plant
        """Take the poles of the plant in z before ``prepare``; none for one that is not linear.

        A device that leaves its orders to the program chooses its settings.
        """

    def prepare(self, channels: Mapping[str, Channel], period_s: float) -> None:  # noqa: B027 - few devices need it
        """Take the scales of the channels ``u`` and ``y``, and the machine time between samples, before ``start``.

        Messages that carry physical units need them, and so does the code of zero input.
        """

    def pace(self, period_s: float) -> Pace:  # noqa: ARG002
        """Pace of a run in real time, with a sample every ``period_s``.

        :raises ConfigurationError: the device cannot take samples at this rate.
        """
        raise ConfigurationError(f"device {self.name}: cannot be played in real time")

    # ------------------------------------------------------------------------------------------------------------ a run

    @abstractmethod
    def start(self, pace: Pace | None = None) -> None:
        """Begin a record, whose first sample has the index 0; the same samples then have the same answers.

        :param pace: no sample is sent before it is due; by default each is sent at once.
        """

    @abstractmethod
    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        """Feed blocks of samples without a pause, and yield the answers to each block, in order.

        It may take several blocks before it yields. A block without samples demands the answers to all before it.
        A sample lost on the way has the flag LOST, a missing one MISSING.

        :raises LinkTimeout, LinkClosed, DeviceError: names the sample; the answers yielded before are valid.
        :raises TimeLimitReached: after all answers that came in time; the last block may be answered in part.
        """

    def stop(self) -> Mapping[str, int]:
        """End the record, and return the device's counters of it by name.

        :raises DeviceError: the record is not valid, for example because the device was reset.
        """
        return {}

    def play_records(self, records: Sequence[Samples]) -> Iterator[tuple[Answers, Mapping[str, int]]]:
        """Feed whole records of one length, and yield the answers to each, with the counters of ``stop``."""
        for samples in records:
            self.start()
            (answers,) = self.play([samples])
            yield answers, self.stop()

    def limit(self, left_s: float) -> None:  # noqa: B027 - a device that answers at once has nothing to wait for
        """Set a time limit ``left_s`` from now; ``math.inf`` removes it.

        After it, every method that waits for the device raises ``TimeLimitReached``.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027 - a device in this process has nothing to release
        """Release the device, and end it if it was started for this. May be called twice, and after any error."""

    # --------------------------------------------------------------------------------------------------------- its line

    @property
    def link_name(self) -> str:
        """Name of the line: ``pty``, ``memory``; ``none`` without one."""
        return "none"

    @property
    def link_counters(self) -> Mapping[str, int]:
        """Counters of the line since it was opened, by name."""
        return {}

    @property
    def losses(self) -> tuple[str, ...]:
        """Causes that lost samples or frames, as ``Conditions.losses``."""
        return self.causes.losses

    @property
    def remarks(self) -> tuple[str, ...]:
        """The other causes, as ``Conditions.remarks``."""
        return self.causes.remarks

    @property
    def line_s(self) -> float:
        """Time that the samples and answers of this record take at the line's speed [s]; 0.0 if it is unknown."""
        return 0.0

    @property
    def line(self) -> Mapping[str, int]:
        """Bit rates of the line, if known, with ``samples_per_message`` and ``window`` of the packing."""
        return {}

    @property
    def faulty_line(self) -> FaultyLine[Any, Any] | None:
        """Line that applies faults to its frames; None if the device was opened without line faults."""
        return None

    def listen(self, listener: CanListener) -> None:  # noqa: B027 - few lines carry CAN frames
        """Report all CAN frames to the listener from now on; a line without any ignores it."""


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
