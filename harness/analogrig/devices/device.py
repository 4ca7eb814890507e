"""Interface of a device under test: blocks of samples go in, replies come out."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Self

from analogrig.devices.description import DeviceDescription
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from analogrig.identity import DeviceFile
from analogrig.protocol.exchange import Replies, Stretch
from analogrig.protocol.pace import Pace


class Device(ABC):
    """Device under test, fed by ``Bench.play``; a context manager.

    ``Dut`` is one behind a link, ``DirectDevice`` one without messages. Methods raise LinkError or DeviceError if the
    device fails. The properties of the link are those of a device that has none.
    """

    def __init__(self, description: DeviceDescription) -> None:
        self._description = description
        self._files = description.files()

    @property
    def name(self) -> str:
        return self._description.name

    @property
    def link_name(self) -> str:
        return "none"

    @property
    def link_counters(self) -> dict[str, int]:
        """Counters of the line since it was opened, by name (``Link.counters``)."""
        return {}

    @property
    def line_s(self) -> float:
        """Time that the samples and answers of this run take at the line's speed [s]; 0.0 if it is unknown."""
        return 0.0

    @property
    def line(self) -> dict[str, int]:
        """Bit rates of the line, if known, with ``samples_per_message`` and ``window`` of the packing."""
        return {}

    @property
    def estimator(self) -> EstimatorConfig:
        """Configuration of its estimator."""
        return self._description.estimator

    @property
    def parameters(self) -> int:
        """Number of elements of theta."""
        return self._description.estimator.parameters

    def description(self) -> Mapping[str, Any]:
        """Description in plain values, for the record."""
        return self._description.as_table()

    def files(self) -> tuple[DeviceFile, ...]:
        """Library, program or firmware that the device runs on this machine, if any, as it was when it was loaded."""
        return self._files

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027 - without a link there is nothing to release
        """Release the device, and end it if it was started for this."""

    def limit(self, left_s: float) -> None:  # noqa: B027 - without a link there is nothing to wait for
        """Set a time limit ``left_s`` from now; ``math.inf`` removes it.

        After it, every method that waits for the device raises ``TimeLimitReached``.
        """

    @abstractmethod
    def handshake(self) -> object:
        """Bring the device to a defined state, from any state."""

    @abstractmethod
    def configure(self, estimator: EstimatorConfig | None = None) -> None:
        """Set the configuration of the estimator; by default the described one."""

    def set_force_zero(self, code: float) -> None:
        """Set the code that means zero force; errors as ``configure``."""
        self.configure(dataclasses.replace(self.estimator, force_zero=code))

    def pace(self, period_s: float) -> Pace:  # noqa: ARG002
        """Pace of a run in real time, with a sample every ``period_s``.

        :raises ConfigurationError: the device cannot take samples at this rate.
        """
        raise ConfigurationError(f"device {self.name}: has no line, and therefore no real time")

    @abstractmethod
    def start(self, pace: Pace | None = None) -> None:
        """Begin a run, whose first sample has the index 0.

        :param pace: no sample is sent before it is due; by default each is sent at once.
        """

    @abstractmethod
    def play(self, stretches: Iterable[Stretch]) -> Iterator[Replies]:
        """Feed several stretches of samples without a pause, and yield the answers to each.

        The device takes skipped indices as missing samples.
        """

    @abstractmethod
    def stop(self) -> Mapping[str, int]:
        """End the run, and return the device's counters of this run by name."""
