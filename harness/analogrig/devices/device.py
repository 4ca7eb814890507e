"""Interface of a device under test: blocks of samples go in, answers come out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

from analogrig.answers import Answers, Samples
from analogrig.datasheet import Datasheet
from analogrig.devices.description import DeviceDescription
from analogrig.errors import ConfigurationError, DeviceRefused
from analogrig.identity import DeviceFile
from analogrig.protocol.pace import Pace
from analogrig.run import Channel

if TYPE_CHECKING:
    from analogrig.links.link import CanListener
    from analogrig.links.wire_faults import FaultyLine


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

        Messages that carry physical units need them, and so does the code of zero force.
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
