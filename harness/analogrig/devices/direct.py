"""Device without messages: the C estimator in this process, whole blocks at a time."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from analogrig.answers import Answers, RaisedAlarm, Samples
from analogrig.catalogue import Trigger
from analogrig.datasheet import Datasheet
from analogrig.devices.catalogue_description import CatalogueDescription, suited
from analogrig.devices.device import Device
from analogrig.devices.estimator import Estimator, EstimatorOutput
from analogrig.estimator_config import EstimatorConfig
from analogrig.protocol.pace import Pace
from analogrig.run import Channel


class DirectDevice(Device):
    """Estimator of a device of our catalogue that has the capability ``blocks``, without its line.

    Its answers are those of ``CatalogueDevice`` to the bit. It lacks what other messages carry: the diagnoses,
    the misfits, the flags RESTARTED and IDLE, and the counters of messages.
    """

    def __init__(self, description: CatalogueDescription, *, alarms_only: bool = False) -> None:
        """Load and configure the estimator.

        :param alarms_only: omit the estimates, which take a twentieth of the time: theta has no columns.
        :raises ConfigurationError: the estimator refuses its configuration.
        :raises LinkError: the library was not built.
        """
        super().__init__(description)
        self._description: CatalogueDescription = description
        self._as_opened = description.estimator
        self._alarms_only = alarms_only
        self._next_index = 0
        self._order: int | None = None
        """Order for which the settings were chosen last: to choose them takes as long as to play a thousand samples."""
        self.configure()

    @property
    def datasheet(self) -> Datasheet:
        return self._datasheet

    def description(self) -> Mapping[str, Any]:
        return self._table

    def recover(self) -> None:
        self._estimator.restart()

    def configure(self, **settings: Any) -> None:
        self._order = None
        self._apply(self._as_opened.changed(f"device {self.name}", settings))

    def suit(self, order: int) -> None:
        if order == self._order:
            return
        estimator = suited(self._description, order)
        if estimator != self._description.estimator:
            self._apply(estimator)
        self._order = order

    def prepare(self, channels: Mapping[str, Channel], period_s: float) -> None:  # noqa: ARG002
        zero = channels["u"].zero
        if zero != self._description.estimator.force_zero:
            self._apply(dataclasses.replace(self._description.estimator, force_zero=zero))

    def _apply(self, estimator: EstimatorConfig) -> None:
        self._description = dataclasses.replace(self._description, estimator=estimator)
        self._estimator = Estimator(estimator, library=self._description.estimator_library)
        self._trigger = Trigger[estimator.trigger.replace("-", "_").upper()]
        # Runs share the table: to write it anew for each takes as long as to play a thousand samples.
        self._table = self._description.as_table()
        self._datasheet = dataclasses.replace(Datasheet.recorded(self._table), misfits=False)
        if self._alarms_only:
            self._datasheet = dataclasses.replace(self._datasheet, theta_n=0, model=None)
        self._table["datasheet"] = self._datasheet.as_table()

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        self._estimator.restart()
        self._next_index = 0

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        for block in blocks:
            if skipped_n := block.skipped_after(self._next_index):
                nothing = np.zeros(skipped_n, np.uint16)
                self._estimator.run(nothing, nothing, np.zeros(skipped_n, np.bool_), with_theta=False)
            self._next_index = block.first + len(block)
            steps = self._estimator.run(block.u, block.y, block.valid, with_theta=not self._alarms_only)
            yield self._answers(steps, block.first)

    def play_records(self, records: Sequence[Samples]) -> Iterator[tuple[Answers, Mapping[str, int]]]:
        u, y, valid = (np.stack([getattr(each, name) for each in records]) for name in ("u", "y", "valid"))
        for steps, counters in self._estimator.run_records(u, y, valid, with_theta=not self._alarms_only):
            yield self._answers(steps), counters

    def _answers(self, steps: EstimatorOutput, first: int = 0) -> Answers:
        """Answers to a block from sample ``first`` on."""
        statistics = steps.statistic[steps.alarms].tolist()
        return Answers(
            flags=steps.flags,
            alarms=tuple(
                RaisedAlarm(first + index, self._trigger, statistic)
                for index, statistic in zip(steps.alarms.tolist(), statistics, strict=True)
            ),
            theta=steps.theta,
            innovation=steps.innovation,
            statistic=steps.statistic,
        )

    def stop(self) -> Mapping[str, int]:
        return self._estimator.counters
