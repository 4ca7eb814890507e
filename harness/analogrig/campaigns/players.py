"""Rigs and devices that a worker has open, each once, and how a case is played on them."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from analogrig.bench import Bench, raise_if_interrupted
from analogrig.campaigns.plan import Case, device_as_planned, open_table
from analogrig.campaigns.trials import Trials, are_possible
from analogrig.devices.description import DeviceDescription
from analogrig.devices.dut import Dut, connect
from analogrig.errors import AnalogrigError, RigError
from analogrig.rigs.emulator import is_emulated
from analogrig.rigs.rig import Rig
from analogrig.run import Run

Held = TypeVar("Held")

Table = Mapping[str, Any]
"""Description of a rig or a device, as plain values."""


class _Kept(Generic[Held]):
    """Cache of the most recently opened rigs or devices, by description: a worker gets cells in turn."""

    MOST = 64

    def __init__(self, opened: Callable[[Table], AbstractContextManager[Held]]) -> None:
        self._opened = opened
        self._held: dict[str, tuple[Held, ExitStack]] = {}

    def get(self, table: Table) -> Held:
        """Return the open object for this description; open it first if necessary."""
        key = _key(table)
        if key not in self._held:
            while len(self._held) >= self.MOST:
                self._close(next(iter(self._held)))
            with ExitStack() as stack:
                held = stack.enter_context(self._opened(table))
                self._held[key] = held, stack.pop_all()
        return self._held[key][0]

    def drop(self, table: Table) -> None:
        """Close the device so that the next trial reopens it."""
        if _key(table) in self._held:
            self._close(_key(table))

    def close(self) -> None:
        while self._held:
            self._close(next(iter(self._held)))

    def _close(self, key: str) -> None:
        with contextlib.suppress(AnalogrigError):
            self._held.pop(key)[1].close()


def _key(table: Table) -> str:
    return json.dumps(table, sort_keys=True)


@dataclass
class _OpenRig:
    """Open rig, with the in-process trials of each device; None: the device is not played in this process."""

    rig: Rig
    trials: dict[str, Trials | None] = field(default_factory=dict)


@contextlib.contextmanager
def _open_rig(table: Table) -> Iterator[_OpenRig]:
    with open_table(table) as rig:
        yield _OpenRig(rig)


def _trials(rig: Rig, device: DeviceDescription) -> Trials | None:
    return Trials(rig, device) if is_emulated(rig) and are_possible(rig, device) else None


def _open_device(table: Table) -> Dut:
    return connect(device_as_planned(table))


class Players(threading.local):
    """Open rigs and devices of one thread."""

    def __init__(self) -> None:
        self._rigs, self._devices = _Kept(_open_rig), _Kept(_open_device)

    def trials(self, case: Case) -> Trials | None:
        """In-process trials for a case; None if the case is not played in this process.

        :raises ConfigurationError: the device refuses its configuration, or is another build than was planned.
        :raises LinkError: its library cannot be loaded.
        :raises RigError: the rig cannot be had.
        """
        opened, key = self._rigs.get(case.rig), _key(case.device)
        if key not in opened.trials:
            opened.trials[key] = _trials(opened.rig, device_as_planned(case.device))
        return opened.trials[key]

    def play(self, case: Case) -> Run:
        """Play a case in this process or on a bench. After an invalid run the device is reopened.

        :raises ConfigurationError, RigError: as ``trials``, or the case cannot be played.
        :raises LinkError, DeviceError: the device cannot be had.
        :raises KeyboardInterrupt: the user ended it.
        """
        trials = self.trials(case)
        return self._play_on_bench(case) if trials is None else trials.run(case.scenario, case.seed)

    def _play_on_bench(self, case: Case) -> Run:
        try:
            run = Bench(self._rigs.get(case.rig).rig, self._devices.get(case.device)).play(case.scenario, case.seed)
        except BaseException as error:
            self._devices.drop(case.device)
            if isinstance(error, RigError):
                self._rigs.drop(case.rig)
            raise
        if run.conditions.faults:
            self._devices.drop(case.device)
        return raise_if_interrupted(run)

    def close(self) -> None:
        """Close everything that this thread has opened."""
        self._devices.close()
        self._rigs.close()
