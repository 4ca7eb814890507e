"""Runs of a device in a CAN log, whatever its messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from analogrig.answers import Answers
from analogrig.devices.device import Causes
from analogrig.links.link import Identifier


@dataclass
class CapturedRun(ABC):
    """Run in a CAN log."""

    samples: dict[int, tuple[int, int, bool]] = field(default_factory=dict)
    """Code of the input, code of the output, and True if sent as missing; by sample index."""
    counters: dict[str, int] = field(default_factory=dict)
    """Counters of the device, as far as the log holds them."""
    faults: list[str] = field(default_factory=list)
    """Reasons that the run is not valid."""

    @property
    @abstractmethod
    def extent(self) -> int:
        """Number of samples up to the last one in the log."""

    @abstractmethod
    def device(self, path: Path) -> Mapping[str, Any]:
        """Description of the device, for the record; ``path`` is the log, for errors.

        :raises ConfigurationError: the log holds settings that no device can have.
        """

    @abstractmethod
    def answers(self, path: Path) -> Answers:
        """Answers to all ``extent`` samples; errors as ``device``."""

    @abstractmethod
    def capture_faults(self, path: Path) -> Iterator[str]:
        """Reasons that the log cannot be complete, or cannot be proved to be."""


class CaptureDecoding(Protocol):
    """Decoded log."""

    @property
    def runs(self) -> Sequence[CapturedRun]:
        """Runs in the log, some perhaps without samples."""

    @property
    def known(self) -> Collection[Identifier]:
        """Identifiers of the messages of harness and device."""

    @property
    def carriers(self) -> Mapping[str, str]:
        """Signals whose scales a DBC of the user states, by u and y; empty for our own catalogue."""

    @property
    def causes(self) -> Causes:
        """Causes of lost samples and unused frames."""

    @property
    def line(self) -> Mapping[str, int]:
        """Traffic other than intact messages of harness and device: counts by name."""
